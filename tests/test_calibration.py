"""Levels are uniform for posteriors that are right, and for no others: Gaussians whose posterior has a closed form."""

import numpy as np
import pytest

from august_jax.evaluation import calibration

SLOTS, SAMPLES, NOISE = 600, 400, 0.3
CASES = {
    "right": {},
    "too narrow": {"spread": 0.5},
    "too wide": {"spread": 2.0},
    "beside": {"offset": 1.0},
    "prior alone": {"blind": True},
}


def posterior(spread=1.0, offset=0.0, blind=False, seed=0):
    """Truths (n, 3) from a unit Gaussian and samples (n, m, 3) of x | x + noise, wrong in one way or in none.

    The closed form: mean y/(1 + s^2), variance s^2/(1 + s^2). Samples come from a wider Gaussian and bear weights, as
    those of an importance sampler do.
    """
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(SLOTS, 3))
    heard = truth + NOISE * rng.normal(size=truth.shape)
    mean, deviation = heard / (1.0 + NOISE**2), NOISE / np.sqrt(1.0 + NOISE**2)
    if blind:
        mean, deviation = np.zeros_like(mean), 1.0
    mean, deviation = mean + offset * deviation, spread * deviation
    wide = 1.3 * deviation
    samples = mean[:, None] + wide * rng.normal(size=(SLOTS, SAMPLES, 3))
    squares = np.sum((samples - mean[:, None]) ** 2, axis=-1)
    return truth, heard, samples, np.exp(-0.5 * squares * (1.0 / deviation**2 - 1.0 / wide**2))


def levels_of(truth, samples, weights):
    rng = np.random.default_rng(1)
    references = rng.uniform(-3.0, 3.0, truth.shape)
    return {
        "rank": np.array([calibration.rank(s[:, 0], w, t[0]) for s, w, t in zip(samples, weights, truth)]),
        "position": np.array([calibration.position_level(*each) for each in zip(samples, weights, truth)]),
        "distance": np.array([calibration.distance_level(*each) for each in zip(samples, weights, truth, references)]),
    }


@pytest.fixture(scope="module")
def found():
    """Levels by case."""
    levels = {}
    for name, wrong in CASES.items():
        truth, _, samples, weights = posterior(**wrong)
        levels[name] = levels_of(truth, samples, weights)
    return levels


@pytest.mark.parametrize("level", ["rank", "position", "distance"])
def test_levels_of_a_right_posterior_are_uniform(level, found):
    levels = found["right"][level]
    statistic, probability = calibration.uniformity(levels)
    assert probability > 1e-3 and statistic < 28.0  # 9 degrees of freedom
    for credibility in (0.5, 0.9):
        covered, error = calibration.coverage(levels, credibility)
        assert abs(covered - credibility) < 3.5 * error


@pytest.mark.parametrize("level", ["rank", "position", "distance"])
@pytest.mark.parametrize("wrong", ["too narrow", "too wide", "beside"])
def test_wrong_posteriors_are_told_from_right_ones(wrong, level, found):
    assert calibration.uniformity(found[wrong][level])[1] < 1e-4


def test_regions_err_to_the_side_of_the_spread(found):
    narrow, wide = found["too narrow"]["position"], found["too wide"]["position"]
    assert calibration.coverage(narrow, 0.9)[0] < 0.5 < 0.98 < calibration.coverage(wide, 0.9)[0]
    # a truth beside the posterior's middle lies in the outer bins, on one side of them
    counts = calibration.histogram(found["beside"]["rank"])
    assert counts.sum() == SLOTS and counts[0] > 4 * counts[-1]


def test_the_prior_is_calibrated_whatever_it_knows(found):
    """Who answers the prior is right on average: calibration is no measure of accuracy."""
    for levels in found["prior alone"].values():
        assert calibration.uniformity(levels)[1] > 1e-3


def test_a_reference_that_hears_the_echo_finds_who_does_not():
    """Balls about a point may look at the echo: about the noisy position itself the prior's samples are far, the truth
    near, though the prior's ellipsoids cover as they should."""
    truth, heard, samples, weights = posterior(blind=True)
    levels = [calibration.distance_level(s, w, t, y) for s, w, t, y in zip(samples, weights, truth, heard)]
    assert calibration.uniformity(np.array(levels))[1] < 1e-10
    truth, heard, samples, weights = posterior()
    levels = [calibration.distance_level(s, w, t, y) for s, w, t, y in zip(samples, weights, truth, heard)]
    assert calibration.uniformity(np.array(levels))[1] > 1e-3


def test_cones_about_the_mean_normal():
    """Thrust axes from a narrow Gaussian of the sphere, the truth one of them: its level is uniform."""
    rng = np.random.default_rng(3)

    def axes(*shape):
        tilted = np.concatenate([0.2 * rng.normal(size=(*shape, 2)), np.ones((*shape, 1))], axis=-1)
        return tilted / np.linalg.norm(tilted, axis=-1, keepdims=True)

    truth, samples, weights = axes(SLOTS), axes(SLOTS, SAMPLES), rng.uniform(size=(SLOTS, SAMPLES))
    levels = np.array([calibration.normal_level(*each) for each in zip(samples, weights, truth)])
    assert calibration.uniformity(levels)[1] > 1e-3
    away = np.array([0.0, 1.0, 0.0])
    assert calibration.normal_level(samples[0], weights[0], away) == 1.0
    mean = weights[0] @ samples[0]
    assert calibration.normal_level(samples[0], weights[0], mean / np.linalg.norm(mean)) < 0.02


def test_weights_count_as_repeats_do():
    rng = np.random.default_rng(4)
    samples, repeats, truth = rng.normal(size=(50, 3)), rng.integers(0, 4, 50), np.array([0.3, -0.2, 0.5])
    many = np.repeat(samples, repeats, axis=0)
    one, other = repeats.astype(float), np.ones(len(many))
    for function, more in (
        (calibration.position_level, ()),
        (calibration.normal_level, ()),
        (calibration.distance_level, (np.ones(3),)),
    ):
        np.testing.assert_allclose(
            function(samples, one, truth, *more), function(many, other, truth, *more), atol=1e-12
        )
    assert calibration.rank(np.array([1.0, 2.0, 2.0, 3.0]), np.array([1.0, 1.0, 1.0, 5.0]), 2.0) == 0.25
    lone = np.tile(truth, (5, 1))  # all samples alike: the truth there is no farther than they are
    assert calibration.position_level(lone, np.ones(5), truth) == 0.5
    assert calibration.position_level(lone, np.ones(5), truth + 1e-3) == 1.0


def test_errors_of_shares_and_of_means():
    rng = np.random.default_rng(5)
    shares, errors = zip(*[calibration.share(rng.uniform(size=200) < 0.9) for _ in range(400)])
    np.testing.assert_allclose(np.std(shares), np.mean(errors), rtol=0.15)
    assert calibration.share(np.ones(100, bool))[1] > 0.005  # a hundred of a hundred leave room for one
    values = rng.normal(size=400)
    np.testing.assert_allclose(calibration.bootstrap_error(values), values.std(ddof=1) / 20.0, rtol=0.15)
    assert calibration.bootstrap_error(values, np.median) > calibration.bootstrap_error(values)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: calibration.rank(np.zeros(3), np.ones(4), 0.0), "values, weights: got shapes"),
        (lambda: calibration.rank(np.zeros(3), np.array([1.0, -1.0, 2.0]), 0.0), "not negative"),
        (lambda: calibration.rank(np.zeros(3), np.array([1.0, np.nan, 2.0]), 0.0), "not negative"),
        (lambda: calibration.position_level(np.zeros((3, 2)), np.ones(3), np.zeros(3)), r"give \(m, 3\)"),
        (lambda: calibration.coverage(np.zeros(3), 90.0), "credibility: got 90"),
        (lambda: calibration.share(np.zeros(0, bool)), "flags: got none"),
        (lambda: calibration.uniformity(np.zeros(1)), "two or more"),
        (lambda: calibration.bootstrap_error(np.zeros(0)), "values: got none"),
    ],
)
def test_refusals_name_the_argument(call, told, unchecked):
    with pytest.raises(ValueError, match=told):
        call()
