"""The matched filter of a single point: closed forms, a slow twin, and what the region of interest bounds."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.config import override, preset
from august_jax.physics import AntennaArray, PlanarArray
from august_jax.schemes import SCHEMES, Setting, Slots, polar
from august_jax.signal import Coefficients, Subspace, project

PLANAR = PlanarArray(16, 4, 3e9)
PLACES = np.random.default_rng(3).uniform(-0.4, 0.4, (30, 3)) * [1.0, 0.0, 1.0]
LOOSE = AntennaArray(PLACES + [0.3, 0.2, -0.1], np.tile([0.0, 0.0, 1.0], (30, 1)), 3e9)
"""Thirty antennas anywhere in a square, beside the origin."""
ONE, EIGHT = (3e9,), tuple(np.linspace(2.95e9, 3.05e9, 8).tolist())
REACH = 0.8


def echo_of(place, array, tones, gain=3e-7 - 2e-7j):
    """H (F, N, N) of a point, in double precision: spherical waves there and back."""
    far = np.linalg.norm(place - np.asarray(array.positions, float), axis=1)
    waves = [np.exp(2j * np.pi * tone / 299_792_458.0 * far) for tone in tones]
    return np.stack([gain * np.outer(wave, wave) for wave in waves])


def noisy(rng, channel, snr_db, count):
    """``count`` echoes under white noise, so many dB below an antenna pair's echo."""
    parts = rng.normal(size=(2, count, *channel.shape)) * np.sqrt(0.5 * np.mean(np.abs(channel) ** 2))
    return (channel + 10.0 ** (-snr_db / 20.0) * (parts[0] + 1j * parts[1])).astype(np.complex64)


@cache
def filtered(name, tones):
    array = {"planar": PLANAR, "loose": LOOSE}[name]
    find = partial(polar.locate, array=array, frequencies_hz=tones, reach_m=REACH, nearest_m=3.0)
    return jax.jit(jax.vmap(find))


def towards(places, array=PLANAR):
    """Unit vectors and distances from the array's middle."""
    offset = np.asarray(places, float) - np.asarray(array.positions, float).mean(axis=0)
    far = np.linalg.norm(offset, axis=-1)
    return offset / far[..., None], far


def drawn(rng, count, distance, miss=0.4):
    """Places about one in the array's half space, and predictions that miss them."""
    sight = np.array([0.5, 0.75, 0.35]) / np.linalg.norm([0.5, 0.75, 0.35])
    places = distance * sight + rng.uniform(-0.3, 0.3, (count, 3))
    return places, (places + rng.uniform(-miss, miss, (count, 3))).astype(np.float32)


@pytest.mark.parametrize(
    "name, tones", [("planar", ONE), pytest.param("planar", EIGHT, marks=pytest.mark.slow), ("loose", EIGHT)]
)
def test_a_point_is_found_where_it_is(name, tones):
    """From H and, of a planar array, from its coefficients; at any level and phase."""
    array = {"planar": PLANAR, "loose": LOOSE}[name]
    places, predicted = drawn(np.random.default_rng(0), 12, 5.0)
    channels = np.stack([echo_of(place, array, tones) for place in places]).astype(np.complex64)
    find = filtered(name, tones)
    found = [find(channels, predicted), find(1e3j * channels, predicted)]
    if name == "planar":
        subspace = Subspace(array, tones)
        found.append(find(jax.vmap(lambda h, q: project(h, q, subspace))(channels, predicted), predicted))
    true, far = towards(places, array)
    for each in found:
        direction, distance = towards(each.position, array)
        # single precision: 1e-4 of the resolution, which is 0.13
        np.testing.assert_allclose(direction, true, atol=2e-4)
        # one tone bends so little that rounding moves it by a centimetre; the band tells the range by its phase
        np.testing.assert_allclose(distance, far, atol=0.03 if tones == ONE else 2e-3)
        off, off_grid = (np.linalg.norm(sight - true, axis=-1) for sight in (direction, towards(each.grid, array)[0]))
        assert np.all(off <= off_grid + 2e-4)  # refined, it is no worse than its grid


def cramer_rao(place, array, tones, snr_db):
    """Standard deviations of (u_x, u_z, r) under white noise where the complex gain is unknown, by differences."""

    def channel(theta):
        x, z, far = theta
        return echo_of(far * np.array([x, np.sqrt(1.0 - x**2 - z**2), z]), array, tones, 1.0).ravel()

    theta, steps = polar_of(place), 1e-6 * np.eye(3)
    slopes = [(channel(theta + step) - channel(theta - step)) / 2e-6 for step in steps]
    slopes = np.stack([*slopes, channel(theta), 1j * channel(theta)], axis=1)
    information = 2.0 * 10.0 ** (snr_db / 10.0) * np.real(slopes.conj().T @ slopes)
    return np.sqrt(np.diag(np.linalg.inv(information)))[:3]


def polar_of(places):
    """(u_x, u_z, r) of places about the origin."""
    direction, far = towards(places)
    return np.stack([direction[..., 0], direction[..., 2], far], axis=-1)


@pytest.mark.parametrize("tones, snr_db", [pytest.param(ONE, 10.0, marks=pytest.mark.slow), (EIGHT, -5.0)])
def test_under_noise_it_errs_as_the_cramer_rao_bound_says(tones, snr_db):
    """300 echoes tell a standard deviation to 4 %; over seeds and SNRs the ratios were 0.91 to 1.09."""
    place = np.array([1.1, 2.2, 0.7])
    predicted = np.tile(np.float32(place + [0.1, -0.12, 0.15]), (300, 1))
    channels = noisy(np.random.default_rng(1), echo_of(place, PLANAR, tones), snr_db, 300)
    found = filtered("planar", tones)(channels, predicted)
    errors = polar_of(found.position) - polar_of(place)
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / cramer_rao(place, PLANAR, tones, snr_db)
    assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio


def test_it_is_the_maximum_that_a_slow_search_finds():
    """|b^H H conj(b)| written out in double precision, everywhere in the region, of two points' echo under noise."""
    predicted = np.float32([2.0, 3.0, 1.2])
    echo = echo_of(predicted + [0.25, 0.1, -0.2], PLANAR, ONE) + 0.4j * echo_of(predicted + [-0.3, 0, 0.3], PLANAR, ONE)
    (channel,) = noisy(np.random.default_rng(2), echo, 0.0, 1)
    found = filtered("planar", ONE)(channel[None], predicted[None])

    def height(places):
        far = np.linalg.norm(places[..., None, :] - PLANAR.positions, axis=-1)
        waves = np.exp(-1j * PLANAR.wavenumber * far)
        return np.abs(np.einsum("...m,mn,...n->...", waves, channel[0].astype(complex), waves, optimize=True))

    sight, far = towards(predicted)
    chord, steps = REACH / far, np.linspace(-1.0, 1.0, 81)
    x, z, away = np.meshgrid(
        sight[0] + chord * steps, sight[2] + chord * steps, far + REACH * steps[::8], indexing="ij"
    )
    directions = np.stack([x, np.sqrt(1.0 - x**2 - z**2), z], axis=-1)
    heights = np.where(np.linalg.norm(directions - sight, axis=-1) <= chord, height(away[..., None] * directions), 0.0)
    best = np.unravel_index(np.argmax(heights), heights.shape)
    reached = height(np.asarray(found.position, float))[0]
    assert heights.max() <= reached * (1.0 + 1e-5) and heights.max() > 0.99 * reached
    # no farther from the slow grid's best than its spacing, which is 0.005
    np.testing.assert_allclose(towards(found.position)[0][0], directions[best], atol=0.006)


@pytest.mark.parametrize(
    "predicted", [[0.3, 4.0, 0.5], [4.0, 0.8, 3.0], [3.0, -4.0, 2.0], [0.0, 0.5, 4.0], [0.4, 0.6, 0.3]]
)
def test_nothing_leaves_the_region(predicted):
    """Pure noise leads anywhere: level with the array, behind it, straight above, and nearer than s too."""
    predicted = np.tile(np.float32(predicted), (16, 1))
    noise = noisy(np.random.default_rng(4), np.ones((1, PLANAR.count, PLANAR.count)), -20.0, 16)
    for found in filtered("planar", ONE)(noise, predicted)[:2]:
        (sight, far), (direction, distance) = towards(predicted), towards(found)
        assert np.isfinite(found).all()
        assert np.all(np.linalg.norm(direction - sight, axis=-1) <= np.minimum(REACH / far, 1.0) + 1e-5)
        assert np.all(distance <= far + REACH + 1e-4)
        assert np.all(distance >= np.maximum(far - REACH, 0.1 * far) - 1e-4)
        assert np.all(direction[:, 1] * sight[:, 1] > 0.0)


@pytest.mark.slow
def test_slopes_are_finite_and_those_of_differences():
    """Of log |S|^2 over the place, at the prediction itself, too, and of what is found over the prediction."""
    (place,), (predicted,) = drawn(np.random.default_rng(5), 1, 5.0)
    channel = jnp.asarray(echo_of(place, PLANAR, EIGHT), jnp.complex64)
    response = polar._response(channel, jnp.asarray(predicted), PLANAR, EIGHT)

    def height(where):
        return jnp.log(jnp.abs(polar.matched(response, where)) ** 2)

    slope, bend = jax.jit(jax.grad(height)), jax.jit(jax.hessian(height))
    for where in (jnp.asarray(predicted), jnp.asarray(place + [0.05, -0.03, 0.04], jnp.float32)):
        assert np.isfinite(bend(where)).all()
        steps = 2e-3 * np.eye(3, dtype=np.float32)
        differences = [(height(where + step) - height(where - step)) / 4e-3 for step in steps]
        np.testing.assert_allclose(slope(where), differences, rtol=0.02, atol=0.02 * np.abs(differences).max())

    def found(predicted, channel):
        return polar.locate(channel, predicted, PLANAR, EIGHT, reach_m=REACH, nearest_m=4.0).position

    assert np.isfinite(jax.jit(jax.jacfwd(found))(jnp.asarray(predicted), channel)).all()


def test_the_schemes_share_a_direction_and_hear_either_form():
    config = override(preset("smoke"), ["array.nx=8"])
    array, subspace = PlanarArray.from_config(config.array), Subspace.from_config(config.array)
    places, predicted = drawn(np.random.default_rng(6), 4, 8.0)
    channels = np.stack([echo_of(place, array, ONE) for place in places]).astype(np.complex64)
    coefficients = jax.vmap(lambda h, q: project(h, q, subspace))(channels, predicted)
    setting, key = Setting(config, None, None, jax.random.key(0)), jax.random.key(1)
    answers = {
        (name, whole): SCHEMES[name].prepare(setting)(key, Slots(predicted, None, heard, None)).position
        for name in ("polar", "polar_angles")
        for whole, heard in ((True, channels), (False, coefficients))
    }
    for name in ("polar", "polar_angles"):
        np.testing.assert_allclose(answers[name, True], answers[name, False], atol=1e-4)
    whole, angles = (towards(answers[name, True]) for name in ("polar", "polar_angles"))
    np.testing.assert_allclose(whole[0], angles[0], atol=1e-6)
    np.testing.assert_allclose(angles[1], np.linalg.norm(predicted, axis=1), rtol=1e-6)
    with pytest.raises(ValueError, match="slots: heard is None, where the scheme 'polar' looks for a point"):
        SCHEMES["polar"].prepare(setting)(key, Slots(predicted, None, None, None))


def test_a_prediction_in_whole_numbers_is_one(unchecked):
    channel = echo_of(np.array([1.1, 4.2, 1.3]), PLANAR, ONE)
    whole, real = (
        polar.locate(channel, np.array([1, 4, 1], kind), PLANAR, ONE, reach_m=REACH).position for kind in ("i4", "f4")
    )
    np.testing.assert_array_equal(whole, real)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"channel": np.zeros((1, 9, 9), np.complex64)}, r"channel: got a channel of shape \(1, 9, 9\).*\(1, 64, 64\)"),
        ({"frequencies_hz": EIGHT}, r"channel: got a channel of shape \(1, 64, 64\).*\(8, 64, 64\)"),
        (
            {"channel": Coefficients(np.zeros((1, 7, 7), np.complex64), np.zeros(3))},
            r"got coefficients of .*\(1, 15, 15\)",
        ),
        (
            {"channel": Coefficients(np.zeros((1, 15, 15), np.complex64), np.zeros(3)), "array": LOOSE},
            "channel: got coefficients, which only a planar array's subspace has; give H itself",
        ),
        ({"reach_m": 0.0}, "reach_m: got 0 m, which leaves nothing to look at"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    given = {"channel": np.zeros((1, 64, 64), np.complex64), "array": PLANAR, "frequencies_hz": ONE, "reach_m": REACH}
    with pytest.raises(ValueError, match=message):
        polar.locate(predicted=np.float32([1.0, 4.0, 1.0]), **(given | change))
