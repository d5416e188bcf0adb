"""Predictors: what every member of the registry keeps, each exact where its model is, the filter ahead under noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.config import FlightConfig
from august_jax.tracking.predictors import PREDICTORS, FiniteDifference, Kalman, predict_next

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


def by_name(name):
    return PREDICTORS[name].for_flight(FlightConfig(slot_s=SLOT))


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_every_predictor_waits_where_it_knows_one_place(name):
    made = predict_next(by_name(name), jnp.array([[12.0, 20.0, 11.0]]))
    np.testing.assert_allclose(made.position, [12.0, 20.0, 11.0])
    assert np.all(np.diag(made.covariance) > 1.0)  # a speed of 5 m/s is unknown for 0.2 s


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_every_predictor_continues_a_line(name):
    """After seconds of constant velocity, to the centimetre; what has learned that flights turn, to a decimetre. The
    world's origin makes no difference."""
    line = np.arange(20.0)[:, None] * SLOT * [3.0, -1.0, 0.5]
    made = predict_next(by_name(name), jnp.asarray(line[:-1], jnp.float32)).position
    np.testing.assert_allclose(made, line[-1], atol=0.1 if name == "lstm" else 0.02)
    moved = predict_next(by_name(name), jnp.asarray(line[:-1] + [5.0, 6.0, 3.0], jnp.float32)).position
    np.testing.assert_allclose(moved - made, [5.0, 6.0, 3.0], atol=1e-3)


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_every_predictor_keeps_its_state_s_shape(name):
    """So that a flight is one scan, jitted and mapped."""
    predictor = by_name(name)
    state = predictor.start(jnp.zeros(3))
    ahead, _ = predictor.predict(state)
    shapes = [
        jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), each)
        for each in (state, ahead, predictor.update(ahead, jnp.ones(3)))
    ]
    assert shapes[0] == shapes[1] == shapes[2]
    flights = jnp.asarray(np.stack([smooth_flight(seed, 6) for seed in range(2)]), jnp.float32)
    mapped = jax.jit(jax.vmap(lambda past: predict_next(predictor, past).position))(flights)
    np.testing.assert_allclose(mapped[1], predict_next(predictor, flights[1]).position, atol=1e-4)


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_bad_histories_are_named(unchecked, name):
    for history, words in ((jnp.zeros((0, 3)), r"\(0, 3\)"), (jnp.zeros(3), r"\(3,\)")):
        with pytest.raises(ValueError, match=f"positions: .*{words}"):
            predict_next(by_name(name), history)


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_whole_numbers_are_places_too(unchecked, name):
    """Of which a predictor makes no whole ones."""
    places = [[3, 6, 2], [4, 6, 2], [5, 5, 3], [6, 5, 3]]
    by_whole, by_real = (predict_next(by_name(name), jnp.array(places, kind)) for kind in (jnp.int32, jnp.float32))
    np.testing.assert_array_equal(by_whole.position, by_real.position)
    first = [by_name(name).start(jnp.array(places[0], kind)) for kind in (jnp.int32, jnp.float32)]
    assert jax.tree.map(lambda leaf: leaf.dtype, first[0]) == jax.tree.map(lambda leaf: leaf.dtype, first[1])


def difference(positions):
    return predict_next(FiniteDifference(), jnp.asarray(positions)).position


def test_differences_are_half_a_slot_late():
    path = parabola(10)
    np.testing.assert_allclose(difference([[0.0, 0, 0], [1.0, 2, 3]]), [2.0, 4.0, 6.0])
    # The second-order miss of the paper's gains is |q''| t^2 / 2.
    miss = difference(path[:3]) - path[3]
    np.testing.assert_allclose(miss, -(SLOT**2) / 2 * 2 * np.array([0.2, 0.4, -0.3]), atol=1e-5)


def test_gains_are_the_kinematic_prediction():
    past = np.random.default_rng(0).normal(size=(5, 3))
    q3, q2, q1 = past[-3:]
    velocity, acceleration = (q1 - q2) / SLOT, (q1 - 2 * q2 + q3) / SLOT**2
    wanted = q1 + velocity * SLOT + acceleration * SLOT**2 / 2
    np.testing.assert_allclose(difference(past), wanted, rtol=1e-4)


def test_filter_follows_constant_acceleration():
    path = parabola(40)
    made = predict_next(Kalman(SLOT, noise_m=0.01), jnp.asarray(path[:-1], jnp.float32))
    np.testing.assert_allclose(made.position, path[-1], atol=2e-3)  # the prior pulls a little after 8 s


def test_filter_halves_the_error_of_the_differences():
    """Smooth flights, 5 cm noise on every estimate, errors after the first second."""
    rng = np.random.default_rng(3)
    members = {"finite_difference": FiniteDifference(), "kalman": Kalman(SLOT, noise_m=0.05)}
    tracks = np.stack([smooth_flight(seed) for seed in range(40)])
    seen = jnp.asarray(tracks + 0.05 * rng.normal(size=tracks.shape), jnp.float32)
    root = {}
    for name, member in members.items():
        made = jax.jit(jax.vmap(lambda past: predict_next(member, past).position))(seen[:, :-1])  # noqa: B023
        root[name] = np.sqrt(np.mean(np.sum((made - tracks[:, -1]) ** 2, axis=-1)))
    assert root["kalman"] < 0.6 * root["finite_difference"]


def test_innovations_have_the_stated_covariance():
    """Normalised squared innovations average to 3, the number of axes."""
    rng = np.random.default_rng(4)
    tracks = np.stack([smooth_flight(seed, slots=20) for seed in range(60)])
    seen = jnp.asarray(tracks + 0.05 * rng.normal(size=tracks.shape), jnp.float32)
    ahead = jax.jit(jax.vmap(lambda past: predict_next(Kalman(SLOT, noise_m=0.05), past)))(seen[:, :-1])
    innovation = np.asarray(seen[:, -1] - ahead.position)
    squares = np.einsum("na,na->n", innovation, np.linalg.solve(ahead.covariance, innovation[..., None])[..., 0])
    # 60 chi-squares of 3 degrees: standard error 0.32; white jerk is a rough model of this flight.
    assert 2.0 < np.mean(squares) < 4.5


def test_two_points_are_nearly_their_line():
    path = parabola(2)
    made = predict_next(Kalman(SLOT), jnp.asarray(path, jnp.float32))
    np.testing.assert_allclose(made.position, 2 * path[1] - path[0], atol=0.05)  # the prior of 5 m/s hardly bends it


def test_a_covariance_weighs_the_axes():
    """An axis that is measured badly is believed less: the update moves along the other two."""
    filter_ = Kalman(SLOT)
    state, _ = filter_.predict(filter_.start(jnp.zeros(3)))
    moved = filter_.update(state, jnp.ones(3), jnp.diag(jnp.array([1e-4, 1e4, 1e-4]))).mean[0]
    np.testing.assert_allclose(moved, [1.0, 0.0, 1.0], atol=1e-2)
