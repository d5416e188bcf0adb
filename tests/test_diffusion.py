"""Noise schedule and samplers, against distributions whose exact noise estimate is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.models.diffusion import Schedule, add_noise, ancestral, dpm, dpm_steps, draw_steps

SCHEDULE = Schedule(200, (1e-4, 0.05))
MEAN = np.array([0.5, -0.3, 0.1])
COVARIANCE = np.array([[0.09, 0.03, 0.0], [0.03, 0.04, -0.01], [0.0, -0.01, 0.01]])


def gaussian(points, step):
    """E[noise | p_s] for p_0 ~ N(MEAN, COVARIANCE): sqrt(1 - abar) (abar C + (1 - abar) I)^-1 (p - sqrt(abar) m)."""
    bar = jnp.asarray(SCHEDULE.alpha_bars, jnp.float32)[step]
    total = bar * COVARIANCE + (1.0 - bar) * jnp.eye(3)
    return jnp.sqrt(1.0 - bar) * jnp.linalg.solve(total, (points - jnp.sqrt(bar) * MEAN)[..., None])[..., 0]


def two_lumps(points, step):
    """The same for p_0 an even mixture of N(+-0.6, 0.1^2) along the first axis and N(0, 0.1^2) along the others."""
    bar = jnp.asarray(SCHEDULE.alpha_bars, jnp.float32)[step]
    variance = bar * 0.01 + (1.0 - bar)
    lumps = jnp.sqrt(bar) * jnp.array([[0.6, 0.0, 0.0], [-0.6, 0.0, 0.0]])
    distance = points[..., None, :] - lumps
    weights = jax.nn.softmax(-0.5 * jnp.sum(distance**2, -1) / variance, axis=-1)
    return jnp.sqrt(1.0 - bar) * jnp.sum(weights[..., None] * distance, axis=-2) / variance


def test_schedule_is_the_running_product():
    bar, bars = 1.0, [1.0]
    for beta in np.linspace(1e-4, 0.05, 200):
        bar *= 1.0 - beta
        bars.append(bar)
    np.testing.assert_allclose(SCHEDULE.alpha_bars, bars, rtol=1e-12)
    assert SCHEDULE.betas[0] == 0.0 and SCHEDULE.betas[200] == 0.05
    ratio = np.exp(2 * SCHEDULE.half_log_snr)
    np.testing.assert_allclose(ratio / (1 + ratio), bars[1:], rtol=1e-9)


def test_noise_has_covariance_one_minus_abar():
    step, count = 60, 40_000
    noise = jax.random.normal(jax.random.key(0), (1, count, 2))
    noisy = np.asarray(add_noise(jnp.ones((1, count, 2)), noise, jnp.array([step]), SCHEDULE))
    bar = SCHEDULE.alpha_bars[step]
    np.testing.assert_allclose(noisy.mean(), np.sqrt(bar), atol=0.01)
    # five standard errors of a variance are 2.5 %; the standard deviation, which the paper prints, is 24 % above it
    np.testing.assert_allclose(noisy.var(), 1.0 - bar, rtol=0.025)


def test_steps_are_uniform_and_spread_over_the_batch():
    steps = np.asarray(draw_steps(jax.random.key(0), 200, SCHEDULE))
    counts = np.bincount(steps, minlength=201)
    assert counts[0] == 0 and counts[1:].max() <= 2
    many = np.concatenate([draw_steps(jax.random.key(seed), 8, SCHEDULE) for seed in range(500)])
    assert many.min() >= 1 and many.max() <= 200
    np.testing.assert_allclose(np.histogram(many, 4, (0.5, 200.5))[0], 1000, rtol=0.05)


@pytest.mark.parametrize("evaluations", [2, 5, 10, 50, 199, 200])
def test_dpm_steps_descend_from_the_last_to_the_first(evaluations):
    steps = dpm_steps(SCHEDULE, evaluations)
    assert len(steps) == evaluations and steps[0] == 200 and steps[-1] == 1 and (np.diff(steps) < 0).all()


def test_ten_dpm_steps_are_about_even_in_log_snr():
    gaps = np.diff(SCHEDULE.half_log_snr[dpm_steps(SCHEDULE, 10) - 1])
    # whole steps near s = 1 are as wide as the even gap itself
    assert gaps.max() < 1.5 * gaps.mean() and gaps.min() > 0.5 * gaps.mean()


@pytest.mark.parametrize("evaluations", [1, 201])
def test_too_few_or_many_dpm_steps_are_refused(evaluations):
    with pytest.raises(ValueError, match=rf"sampler_steps: {evaluations} .*choose 2..200"):
        dpm_steps(SCHEDULE, evaluations)


COUNT = 20_000


def draw(name, denoise):
    sampler = {
        "dpm": lambda key: dpm(key, denoise, (1, COUNT, 3), SCHEDULE, 10),
        "ancestral": lambda key: ancestral(key, denoise, (1, COUNT, 3), SCHEDULE),
    }[name]
    return np.asarray(jax.jit(sampler)(jax.random.key(3)))[0]


def test_dpm_recovers_a_gaussian():
    points = draw("dpm", gaussian)
    # Standard errors of the means are below 0.3 / sqrt(20,000) = 0.002. abar_200 = 0.006 is not zero: the start, a unit
    # normal, lacks 8 % of the mean's weight, which moves the end by 0.011. Ten evaluations err by 8 % in variance.
    np.testing.assert_allclose(points.mean(0), MEAN, atol=0.015)
    np.testing.assert_allclose(np.cov(points.T), COVARIANCE, atol=0.01)


def test_ancestral_follows_its_own_linear_recursion():
    """A Gaussian's noise estimate is affine, so the moments after every step are known; beta~ ends 7 % too narrow."""
    mean, covariance = np.zeros(3), np.eye(3)
    for step in range(200, 0, -1):
        beta, bar, before = SCHEDULE.betas[step], SCHEDULE.alpha_bars[step], SCHEDULE.alpha_bars[step - 1]
        inverse = np.linalg.inv(bar * COVARIANCE + (1.0 - bar) * np.eye(3))
        matrix = (np.eye(3) - beta * inverse) / np.sqrt(1.0 - beta)
        mean = matrix @ mean + beta / np.sqrt(1.0 - beta) * inverse @ (np.sqrt(bar) * MEAN)
        covariance = matrix @ covariance @ matrix.T + (1.0 - before) / (1.0 - bar) * beta * np.eye(3)
    points = draw("ancestral", gaussian)
    # five standard errors of 20,000 points
    np.testing.assert_allclose(points.mean(0), mean, atol=0.011)
    np.testing.assert_allclose(np.cov(points.T), covariance, atol=0.005)
    np.testing.assert_allclose(mean, MEAN, atol=0.002)
    np.testing.assert_allclose(np.diag(covariance), np.diag(COVARIANCE), rtol=0.18)


def test_ten_dpm_evaluations_do_as_well_as_two_hundred_ancestral_steps():
    exact = np.random.default_rng(0).normal(scale=0.1, size=(COUNT, 3))
    exact[:, 0] += np.where(np.arange(COUNT) % 2, 0.6, -0.6)
    distance = {}
    for name in ("dpm", "ancestral"):
        points = draw(name, two_lumps)
        # five standard errors of the share of one lump
        np.testing.assert_allclose((points[:, 0] > 0).mean(), 0.5, atol=0.018)
        # earth mover's distance along each axis
        distance[name] = np.abs(np.sort(points, axis=0) - np.sort(exact, axis=0)).mean(0).max()
    # a standard normal lies 0.5 away; both samplers within 0.03: ten evaluations by discretisation, beta~ by its width
    assert max(distance.values()) < 0.03, distance


def test_one_reverse_step_is_the_exact_posterior():
    """With one known point p_0, the step's mean is the paper's first form of mu~ and its variance beta~."""
    known, schedule = jnp.array([0.3, -0.2, 0.7]), Schedule(2, (0.1, 0.4))

    def oracle(points, step):
        bar = jnp.asarray(schedule.alpha_bars, jnp.float32)[step]
        return (points - jnp.sqrt(bar) * known) / jnp.sqrt(1.0 - bar)

    path = np.asarray(ancestral(jax.random.key(0), oracle, (1, COUNT, 3), schedule, instants=(0, 1, 2)))[:, 0]
    alpha, beta, bar = 0.6, 0.4, 0.9 * 0.6
    mean = np.sqrt(0.9) * beta / (1 - bar) * np.asarray(known) + np.sqrt(alpha) * (1 - 0.9) / (1 - bar) * path[0]
    rest = path[1] - mean
    assert abs(rest.mean()) < 0.005
    np.testing.assert_allclose(rest.var(), (1 - 0.9) / (1 - bar) * beta, rtol=0.03)
    np.testing.assert_allclose(path[2], np.broadcast_to(known, path[2].shape), atol=1e-5)


def test_a_path_holds_the_sampler_s_own_end_and_start():
    end = ancestral(jax.random.key(1), gaussian, (2, 5, 3), SCHEDULE)
    path = ancestral(jax.random.key(1), gaussian, (2, 5, 3), SCHEDULE, instants=(0, 150, 200))
    assert path.shape == (3, 2, 5, 3)
    np.testing.assert_array_equal(path[2], end)
    assert 0.5 < np.std(path[0]) < 1.5
    with pytest.raises(ValueError, match="instants: .* 0..200"):
        ancestral(jax.random.key(1), gaussian, (2, 5, 3), SCHEDULE, instants=(201,))
