"""Predictors: exact where their model is, and the filter ahead of the differences under noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.tracking import predictors
from august_jax.tracking.predictors import finite_difference, kalman

SLOT = 0.2


def parabola(slots):
    t = SLOT * np.arange(slots)[:, None]
    return np.array([12.0, 20.0, 11.0]) + t * [3.0, -1.0, 0.5] + t**2 * [0.2, 0.4, -0.3]


def smooth_flight(seed, slots=30):
    """Acceleration that forgets in 1.2 s, 0.8 m/s^2 strong, integrated in steps of 10 ms."""
    rng = np.random.default_rng(seed)
    step, every = 0.01, 20
    a, v, q, track = np.zeros(3), rng.normal(size=3) * 2, np.array([20.0, 20.0, 15.0]), []
    for n in range(slots * every):
        if n % every == 0:
            track.append(q)
        a = a - a / 1.2 * step + 0.8 * np.sqrt(2 * step / 1.2) * rng.normal(size=3)
        v = v + a * step
        q = q + v * step
    return np.array(track)


def test_differences_continue_lines_and_repeat_points():
    path = parabola(10)
    line = np.array([[0.0, 0, 0], [1.0, 2, 3]])
    np.testing.assert_allclose(finite_difference(jnp.asarray(line)), [2.0, 4.0, 6.0])
    np.testing.assert_allclose(finite_difference(jnp.asarray(line[:1])), line[0])
    # Backward differences are half a slot late: the second-order miss of the paper's gains is |q''| t^2 / 2.
    miss = finite_difference(jnp.asarray(path[:3])) - path[3]
    np.testing.assert_allclose(miss, -SLOT**2 / 2 * 2 * np.array([0.2, 0.4, -0.3]), atol=1e-5)


def test_gains_are_the_kinematic_prediction():
    q3, q2, q1 = np.random.default_rng(0).normal(size=(3, 3))
    velocity, acceleration = (q1 - q2) / SLOT, (q1 - 2 * q2 + q3) / SLOT**2
    wanted = q1 + velocity * SLOT + acceleration * SLOT**2 / 2
    np.testing.assert_allclose(finite_difference(jnp.asarray(np.stack([q3, q2, q1]))), wanted, rtol=1e-4)


def test_filter_follows_constant_acceleration():
    path = parabola(40)
    made = kalman(jnp.asarray(path[:-1], jnp.float32), slot_s=SLOT, noise_m=0.01)
    np.testing.assert_allclose(made.position, path[-1], atol=2e-3)  # the prior pulls a little after 8 s


def test_filter_halves_the_error_of_the_differences():
    """Smooth flights, 5 cm noise on every estimate, errors after the first second."""
    rng = np.random.default_rng(3)
    errors = {"finite_difference": [], "kalman": []}
    filtered = jax.jit(lambda past: kalman(past, slot_s=SLOT, noise_m=0.05).position)
    for seed in range(40):
        track = smooth_flight(seed)
        seen = jnp.asarray(track + 0.05 * rng.normal(size=track.shape), jnp.float32)
        errors["finite_difference"].append(np.sum((finite_difference(seen[:-1]) - track[-1]) ** 2))
        errors["kalman"].append(np.sum((filtered(seen[:-1]) - track[-1]) ** 2))
    root = {name: np.sqrt(np.mean(values)) for name, values in errors.items()}
    assert root["kalman"] < 0.6 * root["finite_difference"]


def test_innovations_have_the_stated_covariance():
    """Normalised squared innovations average to 3, the number of axes."""
    rng = np.random.default_rng(4)
    made = jax.jit(lambda past: kalman(past, slot_s=SLOT, noise_m=0.05))
    squares = []
    for seed in range(60):
        track = smooth_flight(seed, slots=20)
        seen = jnp.asarray(track + 0.05 * rng.normal(size=track.shape), jnp.float32)
        ahead = made(seen[:-1])
        innovation = np.asarray(seen[-1] - ahead.position)
        squares.append(innovation @ np.linalg.solve(ahead.covariance, innovation))
    # 60 chi-squares of 3 degrees: standard error 0.32; white jerk is a rough model of this flight.
    assert 2.0 < np.mean(squares) < 4.5


@pytest.mark.parametrize("count", [1, 2])
def test_short_histories(count):
    path = parabola(count)
    made = kalman(jnp.asarray(path, jnp.float32), slot_s=SLOT)
    if count == 1:
        np.testing.assert_allclose(made.position, path[0])
        assert made.covariance[0, 0] > 1.0  # 5 m/s unknown for 0.2 s
    else:
        # Two points: nearly their line, which the prior of 5 m/s hardly bends.
        np.testing.assert_allclose(made.position, 2 * path[1] - path[0], atol=0.05)


def test_filter_by_hand_is_the_filter_at_once():
    seen = jnp.asarray(smooth_flight(1, slots=8), jnp.float32)
    state = predictors.kalman_start(seen[0], noise_m=0.03)
    for position in seen[1:]:
        state = predictors.kalman_update(predictors.kalman_predict(state, slot_s=SLOT), position, noise_m=0.03)
    state = predictors.kalman_predict(state, slot_s=SLOT)
    made = kalman(seen, slot_s=SLOT, noise_m=0.03)
    np.testing.assert_allclose(state.mean[0], made.position, atol=1e-4)
    np.testing.assert_allclose(predictors.innovation_covariance(state, noise_m=0.03), made.covariance, rtol=1e-4)


def test_a_covariance_weighs_the_axes():
    """An axis that is measured badly is believed less: the update moves along the other two."""
    state = predictors.kalman_predict(predictors.kalman_start(jnp.zeros(3)), slot_s=SLOT)
    noise = jnp.diag(jnp.array([1e-4, 1e4, 1e-4]))
    moved = predictors.kalman_update(state, jnp.ones(3), noise_m=noise).mean[0]
    np.testing.assert_allclose(moved, [1.0, 0.0, 1.0], atol=1e-2)


def test_bad_input_is_named():
    for function in (finite_difference, lambda positions: kalman(positions, slot_s=SLOT)):
        with pytest.raises(ValueError, match=r"\(0, 3\)"):
            function(jnp.zeros((0, 3)))
        with pytest.raises(ValueError, match=r"\(3,\)"):
            function(jnp.zeros(3))
