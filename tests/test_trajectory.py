"""Random flights."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from august_jax.config import FlightConfig, preset
from august_jax.constants import GRAVITY
from august_jax.scene.pose import tilt
from august_jax.scene.trajectory import Flight, draw_track, fly, fly_many

LAPTOP = replace(preset("laptop").flight, slots=50)
STYLES = ("smooth", "dynamic", "jump")
LIMITS = {"smooth": (5.0, 3.0), "dynamic": (10.0, 5.66), "jump": (10.0, None)}


@pytest.fixture(scope="module")
def flights() -> dict[str, Flight]:
    keys = jax.random.split(jax.random.key(0), 400)
    return {style: jax.tree.map(np.asarray, fly_many(keys, replace(LAPTOP, style=style))) for style in STYLES}


@pytest.mark.parametrize("style", STYLES)
def test_flights_keep_to_the_box_and_their_limits(flights, style):
    flight = flights[style]
    assert flight.positions.shape == (400, 50, 3) and flight.rotations.shape == (400, 50, 3, 3)
    assert all(np.isfinite(leaf).all() and leaf.dtype == np.float32 for leaf in flight)
    for axis, (low, high) in enumerate(LAPTOP.box_m):
        assert low <= flight.positions[..., axis].min() and flight.positions[..., axis].max() <= high
    speed, acceleration = LIMITS[style]
    assert np.linalg.norm(flight.velocities, axis=-1).max() <= speed * (1 + 1e-5)
    if acceleration:
        # accelerations are differences of float32 velocities over 20 ms
        assert np.linalg.norm(flight.accelerations, axis=-1).max() <= acceleration + 1e-3
    assert np.degrees(tilt(flight.rotations)).max() <= LAPTOP.tilt_deg + 1e-3


@pytest.mark.parametrize("style", STYLES)
def test_positions_cover_the_box(flights, style):
    for axis, (low, high) in enumerate(LAPTOP.box_m):
        share, _ = np.histogram(flights[style].positions[..., axis], 8, (low, high))
        share = share / share.mean()
        assert share.min() > 0.6 and share.max() < 1.6


@pytest.mark.parametrize("style", STYLES)
def test_rotations_are_rotations(flights, style):
    rotations = flights[style].rotations.reshape(-1, 3, 3)
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)


def test_positions_integrate_velocities(flights):
    for style in ("smooth", "dynamic"):
        flight = flights[style]
        step = np.diff(flight.positions, axis=1)
        trapezoid = 0.5 * LAPTOP.slot_s * (flight.velocities[:, 1:] + flight.velocities[:, :-1])
        # the trapezoid over a slot misses at most a_max dt^2 / 4
        assert np.abs(step - trapezoid).max() < LIMITS[style][1] * LAPTOP.slot_s**2 / 4 + 1e-5
    jump = flights["jump"]
    np.testing.assert_allclose(np.diff(jump.positions, axis=1), LAPTOP.slot_s * jump.velocities[:, :-1], atol=1e-5)


def test_acceleration_is_correlated_over_its_time():
    # in a box that no flight of two seconds crosses, the process is alone but for the drag and the rare limits
    wide = replace(LAPTOP, style="smooth", box_m=((-200.0, 200.0),) * 3, slots=11)
    flight = fly_many(jax.random.split(jax.random.key(1), 2000), wide)
    calm = np.abs(flight.positions).max(axis=1) < 75.0  # the outer 30 % lead back
    push = np.asarray(flight.accelerations + 0.2 * flight.velocities).swapaxes(1, 2)[calm]
    assert len(push) > 1500
    assert push.std() == pytest.approx(0.8, rel=0.05)
    correlation = np.mean(push[:, 2] * push[:, 8]) / np.mean(push[:, 2] ** 2)
    assert correlation == pytest.approx(np.exp(-6 * 0.2 / 1.2), abs=0.08)


def test_thrust_follows_the_acceleration(flights):
    flight = flights["smooth"]
    thrust = flight.accelerations + np.array([0, 0, GRAVITY])
    thrust /= np.linalg.norm(thrust, axis=-1, keepdims=True)
    misfit = np.degrees(np.arccos(np.clip(np.sum(thrust * flight.rotations[..., 2], -1), -1, 1)))
    # a lag of 0.12 s, while the acceleration changes by sigma_a sqrt(2 lag / tau): about 2 degrees
    assert np.median(misfit) < 2.5
    assert np.median(misfit) < 0.5 * np.degrees(np.median(tilt(flight.rotations)))


def test_headings_are_free_and_slow(flights):
    yaw = np.arctan2(flights["smooth"].rotations[..., 1, 0], flights["smooth"].rotations[..., 0, 0])
    quarters, _ = np.histogram(yaw[:, 0], 4, (-np.pi, np.pi))
    assert quarters.min() > 60  # 100 expected, standard deviation 8.7
    turn = np.abs(np.angle(np.exp(1j * np.diff(yaw, axis=1)))) / LAPTOP.slot_s
    assert turn.max() < 2.5 and turn.mean() > 0.1


def test_smooth_flights_are_easier_to_predict_than_dynamic_and_jumping_ones(flights):
    def error(flight):
        p = flight.positions
        predicted = 2.5 * p[:, 2:-1] - 2.0 * p[:, 1:-2] + 0.5 * p[:, :-3]
        return np.linalg.norm(predicted - p[:, 3:], axis=-1).mean()

    smooth, dynamic, jump = (error(flights[style]) for style in STYLES)
    assert smooth < 0.05 < dynamic < 0.2 < 0.5 < jump


def test_a_flight_depends_on_its_key_alone(flights):
    keys = jax.random.split(jax.random.key(0), 400)
    style = replace(LAPTOP, style="dynamic")
    alone = fly(keys[7], style)
    # batches of other sizes may round differently; limits and lags damp it
    np.testing.assert_allclose(alone.positions, flights["dynamic"].positions[7], atol=1e-3)
    assert np.abs(flights["dynamic"].positions[7] - flights["dynamic"].positions[8]).max() > 0.1
    inside, stayed = jax.eval_shape(lambda key: draw_track(key, style), keys[7])
    assert inside.rotations.shape == alone.rotations.shape and stayed.shape == ()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"box_m": ((0.0, 1.0), (0.0, 1.0), (2.0, 2.0))}, "flight.box_m.*along z"),
        ({"box_m": ((0.0, 0.2), (0.0, 0.2), (0.0, 0.2)), "style": "jump"}, "flight.box_m.*enlarge the box"),
        ({"style": "aerobatic"}, "flight.style: .*'aerobatic'.*smooth"),
        ({"tilt_deg": 90.0}, "flight.tilt_deg: 90 "),
    ],
)
def test_impossible_flights_are_refused(unchecked, change, message):
    with pytest.raises(ValueError, match=message):
        fly(jax.random.key(0), FlightConfig(**change))
