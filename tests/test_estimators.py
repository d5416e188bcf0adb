"""Estimators: the laws that all of them obey, their definitions, their error in the sector, one station at work."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.config import ArrayConfig, RegionConfig, SignalConfig
from august_jax.physics.array import PlanarArray
from august_jax.signal import beams, estimators, roi, station
from august_jax.signal.estimators import ESTIMATORS, Region, estimate_channel
from august_jax.signal.noise import estimate_snr
from august_jax.signal.roi import Subspace

ARRAY = ArrayConfig()
REGION = RegionConfig()
COUNT = 24
BOXES = {"paper": ((10, 30), (10, 30), (10, 20)), "near": ((3, 7), (4, 8), (2, 5))}


@cache
def scenes(box, array=ARRAY):
    """Sums of 40 random point echoes within 0.35 m, predicted with an error of up to 0.5 m along each axis."""
    rng = np.random.default_rng(0)
    planar = PlanarArray(array.nx, array.nz, array.frequency_hz)
    channels, predictions = [], []
    for _ in range(COUNT):
        centre = np.array([rng.uniform(*span) for span in BOXES[box]])
        parts = centre + rng.uniform(-1, 1, (40, 3)) * [0.25, 0.25, 0.1]
        amplitude = 1e-7 * (rng.normal(size=40) + 1j * rng.normal(size=40))
        tones = []
        for frequency in array.frequencies_hz:
            k = planar.wavenumber * frequency / array.frequency_hz
            wave = np.exp(1j * k * np.linalg.norm(parts[:, None] - planar.positions, axis=-1))
            tones.append((wave.T * amplitude) @ wave)
        channels.append(np.stack(tones))
        predictions.append(centre + rng.uniform(-0.5, 0.5, 3))
    return jnp.asarray(np.array(channels), jnp.complex64), jnp.asarray(np.array(predictions), jnp.float32)


@cache
def compiled(function, estimator, pilots, array):
    """One program serves every box and SNR: compiling costs more than all the runs together."""
    signal = SignalConfig(estimator=estimator, pilots=pilots)

    def one(key, channel, predicted, snr_db):
        return function(key, channel, predicted, array=array, signal=signal, region=REGION, snr_db=snr_db)

    return jax.jit(jax.vmap(one))


def observed(box, estimator, snr_db, function=station.observe, array=ARRAY, pilots="unitary"):
    channels, predictions = scenes(box, array)
    levels = jnp.broadcast_to(jnp.float32(snr_db), COUNT)
    run = compiled(function, estimator, pilots, array)
    return channels, predictions, run(jax.random.split(jax.random.key(7), COUNT), channels, predictions, levels)


def nmse_db(estimate, true):
    axes = tuple(range(1, true.ndim))
    return 10 * np.log10(np.mean(np.sum(np.abs(estimate - true) ** 2, axes) / np.sum(np.abs(true) ** 2, axes)))


@pytest.mark.parametrize(
    ("box", "estimator", "wanted"),
    [
        ("paper", "ls", -18),
        ("paper", "ridge", -20),
        ("paper", "dft", -11),
        ("paper", "lmmse_roi", -46),
        ("near", "lmmse_roi", -40),
        ("near", "ls", -18),
    ],
)
def test_error_of_the_estimators_at_20_db(box, estimator, wanted):
    """Within 2 dB of the figures found with NumPy in double precision on other draws of the same scenes."""
    true, _, seen = observed(box, estimator, 20.0)
    assert abs(nmse_db(seen.estimated_channel, true) - wanted) < 2.0
    np.testing.assert_allclose(
        seen.estimated_channel, jnp.swapaxes(seen.estimated_channel, -1, -2), rtol=1e-4, atol=1e-10
    )


def test_gaussian_pilots_do_as_well_for_the_same_power():
    true, _, gaussian = observed("near", "lmmse_roi", 20.0, pilots="gaussian")
    _, _, unitary = observed("near", "lmmse_roi", 20.0)
    # The energy that 64 Gaussian symbols put into the few lit directions spreads by some tenths of a dB.
    np.testing.assert_allclose(jnp.mean(gaussian.power_dbm - unitary.power_dbm), 0.0, atol=0.5)
    np.testing.assert_allclose(gaussian.snr_db, 20.0, atol=0.3)
    assert abs(nmse_db(gaussian.estimated_channel, true) - nmse_db(unitary.estimated_channel, true)) < 2.0


def test_truncation_is_reported():
    _, _, seen = observed("paper", "ls", 20.0)
    assert np.all(seen.rank < 20) and np.all(seen.rank > 5)
    _, _, seen = observed("paper", "dft", 20.0)
    assert np.all(seen.rank == 64)


@pytest.mark.parametrize("estimator", ["ls", "lmmse_roi"])
def test_requested_snr_is_realised(estimator):
    _, _, seen = observed("near", estimator, 12.0)
    # ||N||^2 of 4096 entries spreads by 1/64, 0.07 dB.
    np.testing.assert_allclose(seen.snr_db, 12.0, atol=0.3)
    assert np.ptp(seen.snr_db) > 0.0


@pytest.mark.parametrize("estimator", ["ridge", "lmmse_roi"])
def test_the_receiver_s_own_snr_is_near_the_realised_one(estimator):
    for level, tolerance in ((0.0, 0.6), (20.0, 0.3)):  # at 0 dB what H X and N have in common weighs more
        _, _, seen = observed("near", estimator, level)
        np.testing.assert_allclose(seen.snr_estimate_db, seen.snr_db, atol=tolerance)
        assert jnp.max(jnp.abs(seen.snr_estimate_db - seen.snr_db)) > 1e-4  # it cannot know the noise


def test_power_and_snr_are_two_ways_to_say_one_thing():
    channels, predictions, seen = observed("near", "ridge", 17.0)
    said = partial(station.observe, array=ARRAY, signal=SignalConfig(estimator="ridge"), region=REGION)
    again = jax.jit(lambda key, power: said(key, channels[0], predictions[0], power_dbm=power))(
        jax.random.split(jax.random.key(7), COUNT)[0], seen.power_dbm[0]
    )
    np.testing.assert_allclose(again.snr_db, seen.snr_db[0], atol=1e-3)
    np.testing.assert_allclose(
        again.estimated_channel, seen.estimated_channel[0], atol=1e-3 * float(jnp.max(jnp.abs(channels[0])))
    )


def test_dft_pilots_get_the_power_of_the_sector_pilots():
    """They light everything alike, so that the same power buys some 12 dB less echo."""
    _, _, sector = observed("paper", "ls", 20.0)
    _, _, everywhere = observed("paper", "dft", 20.0)
    np.testing.assert_allclose(everywhere.power_dbm, sector.power_dbm, atol=1e-3)
    assert 9 < float(jnp.mean(sector.snr_db - everywhere.snr_db)) < 15


def test_reduced_observation_has_the_statistics_of_the_explicit_one():
    """Power, SNR and error of the short cut against echo and estimator written out with Y, X and N."""
    channels, predictions, reduced = observed("near", "lmmse_roi", 15.0)
    planar = PlanarArray(ARRAY.nx, ARRAY.nz, ARRAY.frequency_hz)
    basis = roi.legendre_basis(ARRAY.nx, ARRAY.nz)

    def explicit(key, channel, predicted, power_dbm):
        key_pilots, key_noise = jax.random.split(key)
        book = beams.roi_codebook(ARRAY.nx, ARRAY.nz, beams.direction_angles(predicted), (np.pi / 6, np.pi / 6))
        noise_w = beams.dbm_to_watt(-120.0)
        sent = beams.pilots(book, beams.pilot_symbols(key_pilots, 64, 64), beams.dbm_to_watt(power_dbm))
        received, snr = station.echo(key_noise, channel[0], sent, noise_w)
        region = Region(predicted, REGION.scale_m, planar.positions, planar.wavenumber, basis)
        made = estimate_channel("lmmse_roi", received, sent, noise_w=noise_w, region=region)
        return made.channel[None], 10 * jnp.log10(snr), 10 * jnp.log10(estimate_snr(received, noise_w))

    keys = jax.random.split(jax.random.key(3), COUNT)
    made, snr, known = jax.jit(jax.vmap(explicit))(keys, channels, predictions, reduced.power_dbm)
    np.testing.assert_allclose(snr.mean(), reduced.snr_db.mean(), atol=0.1)  # 0.07 dB a draw, 24 draws
    np.testing.assert_allclose(known.mean(), reduced.snr_estimate_db.mean(), atol=0.1)
    assert abs(nmse_db(made, channels) - nmse_db(reduced.estimated_channel, channels)) < 1.5  # 24 draws of each


def test_observe_region_is_the_projection_of_observe():
    _, predictions, seen = observed("near", "lmmse_roi", 15.0)
    *_, reduced = observed("near", "lmmse_roi", 15.0, function=station.observe_region)
    for n in range(3):
        projected = roi.project(seen.estimated_channel[n], predictions[n], Subspace.from_config(ARRAY)).values
        scale = float(jnp.max(jnp.abs(projected)))
        np.testing.assert_allclose(reduced.coefficients.values[n], projected, atol=1e-4 * scale)
        np.testing.assert_array_equal(reduced.coefficients.centre[n], predictions[n])
    np.testing.assert_allclose(reduced.snr_db, seen.snr_db, atol=1e-4)


def test_region_estimate_against_a_slow_bayesian_twin():
    """The estimate is the Gaussian posterior mean of vec(H) under the covariance sum_q p w_q vec(gg^T) vec(gg^T)^H."""
    array = PlanarArray(4, 2, 3e9)
    rng = np.random.default_rng(2)
    predicted, half = np.array([3.0, 4.0, 2.0]), 0.75
    sent = rng.normal(size=(8, 8)) + 1j * rng.normal(size=(8, 8))
    received = 30 * (rng.normal(size=(8, 8)) + 1j * rng.normal(size=(8, 8)))
    places, weights = np.polynomial.legendre.leggauss(estimators.NODES_PER_AXIS)
    atoms, shares = [], []
    for x, wx in zip(places, weights):
        for y, wy in zip(places, weights):
            for z, wz in zip(places, weights):
                point = predicted + half * np.array([x, y, z])
                wave = np.exp(1j * array.wavenumber * np.linalg.norm(point - array.positions, axis=-1))
                atoms.append(np.outer(wave, wave))
                shares.append(wx * wy * wz / 8)
    echoes = np.array([(atom @ sent).ravel() for atom in atoms]).T
    energy = np.sum(np.abs(received) ** 2) - received.size
    power = energy / np.sum(np.array(shares) * np.sum(np.abs(echoes) ** 2, axis=0))
    prior = power * np.array(shares)
    covariance = (echoes * prior) @ echoes.conj().T + np.eye(echoes.shape[0])
    amplitudes = prior * (echoes.conj().T @ np.linalg.solve(covariance, received.ravel()))
    slow = np.tensordot(amplitudes, np.array(atoms), 1)
    region = Region(
        jnp.asarray(predicted, jnp.float32), half, array.positions, array.wavenumber, roi.legendre_basis(4, 2, 8)
    )
    fast = estimators.lmmse_roi(jnp.asarray(received, jnp.complex64), jnp.asarray(sent, jnp.complex64), 1.0, region)
    # All eight functions of a 4 x 2 array: no truncation; float32 solve of condition number 1e4.
    np.testing.assert_allclose(fast.channel, slow, atol=2e-3 * np.abs(slow).max())


LAWS = Subspace(PlanarArray(4, 2, 3e9), (3e9,), 8)
PLACE = np.array([3.0, 4.0, 2.0])
EXACT = {"ls": 1e-5, "dft": 1e-5, "ridge": 2e-3, "lmmse_roi": 3e-2}
"""Relative error without noise: of a solve, of a regulariser that a noise of -90 dB asks for, and of the many-scatterer
prior, whose Gram matrix float32 knows to 35 dB; others must do as well as the last."""


@cache
def law_setting():
    """Orthogonal pilots and the channel of three scatterers at nodes of the region's grid, 4 x 2 antennas."""
    offsets, _ = estimators._box_nodes()
    parts = PLACE + 0.5 * offsets[[0, 13, 22]]
    waves = np.exp(1j * LAWS.array.wavenumber * np.linalg.norm(parts[:, None] - LAWS.array.positions, axis=-1))
    channel = jnp.asarray(np.einsum("qn,qm,q->nm", waves, waves, [1.0, 0.5j, -0.7 + 0.2j]), jnp.complex64)
    sent = beams.pilot_symbols(jax.random.key(0), 8, 8)
    region = Region(jnp.asarray(PLACE, jnp.float32), 0.5, LAWS.positions, LAWS.array.wavenumber, LAWS.basis)
    noise = jax.random.normal(jax.random.key(1), (8, 8), jnp.complex64)
    return channel, sent, region, noise


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimator_is_exact_without_noise(name):
    channel, sent, region, _ = law_setting()
    made = estimate_channel(name, channel @ sent, sent, noise_w=1e-9, region=region)
    assert np.linalg.norm(made.channel - channel) < EXACT.get(name, 3e-2) * np.linalg.norm(channel)
    assert made.rank == 8


def by_singular_values(received, pilots):
    """Least squares as it is written: Y X^+ on the singular values of X above a tenth of the largest."""
    left, values, right = np.linalg.svd(np.asarray(pilots, complex), full_matrices=False)
    kept = values > 0.1 * values[0]
    channel = (np.asarray(received) @ right[kept].conj().T / values[kept]) @ left[:, kept].conj().T
    return 0.5 * (channel + channel.T), kept.sum()


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("shape", [(16, 4), (5, 3), (6, 1), (1, 1)])
def test_least_squares_is_that_of_the_singular_values(shape, mirror):
    """Both eigenproblems against the singular value decomposition, all over the sphere, in estimate and in rank."""
    count = shape[0] * shape[1]
    rng = np.random.default_rng(1)
    runs = [jax.jit(run) for run in (ESTIMATORS["ls"].run, ESTIMATORS["ls"].run_beams)]
    for azimuth, elevation, width in rng.uniform([0.1, -1.2, 2.0], [3.0, 1.2, 120.0], (12, 3)):
        widths = (np.deg2rad(width), 0.7 * np.deg2rad(width))
        codebook = beams.roi_codebook(*shape, (azimuth, elevation), widths, mirror=mirror)
        symbols = beams.pilot_symbols(jax.random.key(int(1e6 * azimuth)), count, count + 3)
        sent = beams.pilots(codebook, symbols, 3e12)
        received = jnp.asarray(rng.normal(size=sent.shape) + 1j * rng.normal(size=sent.shape), jnp.complex64)
        values = np.linalg.svd(np.asarray(sent, np.complex128), compute_uv=False) / np.linalg.norm(sent, 2)
        if np.abs(values - 0.1).min() < 1e-4:
            continue  # on the edge of the cut rounding decides
        slow, rank = by_singular_values(received, sent)
        for made in (run(received, sent) for run in runs):
            assert made.rank == rank
            assert np.linalg.norm(made.channel - slow) < 1e-4 * np.linalg.norm(slow)


@pytest.mark.parametrize("pilots", ["unitary", pytest.param("gaussian", marks=pytest.mark.slow)])
def test_least_squares_has_a_gradient_where_eigenvalues_meet(pilots):
    """In the echo's gain, which sets the power, and in the place that the beams point to: against differences."""
    channels, predictions = scenes("paper")
    signal = SignalConfig(estimator="ls", pilots=pilots)

    @jax.jit
    def told(gain, place):
        seen = station.observe(
            jax.random.key(3), gain * channels[0], place, array=ARRAY, signal=signal, region=REGION, snr_db=10.0
        )
        return jnp.sum(jnp.abs(1e7 * seen.estimated_channel) ** 2)

    by_gain, by_place = jax.grad(told, (0, 1))(1.0, predictions[0])
    step, along = 1e-2, jnp.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(
        by_gain, (told(1.0 + step, predictions[0]) - told(1.0 - step, predictions[0])) / (2 * step), rtol=1e-2
    )
    moved = (told(1.0, predictions[0] + step * along) - told(1.0, predictions[0] - step * along)) / (2 * step)
    np.testing.assert_allclose(by_place @ along, moved, rtol=3e-2)


@pytest.mark.parametrize("pilots", ["unitary", "gaussian"])
def test_the_station_s_least_squares_is_that_of_what_it_sent(pilots, monkeypatch):
    """Gaussian symbols have no persymmetric Gram matrix: the station must not take the short way for them."""
    channels, predictions = scenes("paper")
    signal = SignalConfig(estimator="ls", pilots=pilots)
    options = {"array": ARRAY, "signal": signal, "region": REGION, "snr_db": 20.0}
    quick = station.observe(jax.random.key(3), channels[0], predictions[0], **options)
    monkeypatch.setitem(ESTIMATORS, "ls", replace(ESTIMATORS["ls"], run_beams=None))
    slow = station.observe(jax.random.key(3), channels[0], predictions[0], **options)
    assert (quick.rank == slow.rank).all()
    error = np.linalg.norm(quick.estimated_channel - slow.estimated_channel)
    assert error < 1e-4 * np.linalg.norm(slow.estimated_channel)


AGAIN = """
import os
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
import jax, jax.numpy as jnp
from august_jax.config import ArrayConfig, RegionConfig, SignalConfig
from august_jax.signal import observe
options = {"signal": SignalConfig(estimator="ls"), "region": RegionConfig(), "snr_db": 20.0}
options["array"] = ArrayConfig(nx=8, nz=4)
run = jax.jit(jax.vmap(lambda key, channel, place: observe(key, channel, place, **options)))
keys, places = jax.random.split(jax.random.key(0), 12), jnp.linspace(10.0, 20.0, 36).reshape(12, 3)
channels = 1e-7 * jax.random.normal(keys[0], (12, 1, 32, 32), jnp.complex64)
for _ in range(200):
    jax.block_until_ready(run(keys, channels, places))
"""


def test_estimate_and_statistics_do_not_wait_for_each_other():
    """Two batched decompositions of one program must come to an end on two cores, where left alone they hang within
    twenty calls."""
    alone = {name: value for name, value in os.environ.items() if name not in ("PJRT_NPROC", "NPROC")}
    subprocess.run([sys.executable, "-c", AGAIN], env=alone, check=True, timeout=120)


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimate_is_symmetric(name):
    channel, sent, region, noise = law_setting()
    made = estimate_channel(name, channel @ sent + noise, sent, noise_w=1.0, region=region).channel
    np.testing.assert_allclose(made, made.T, atol=1e-5 * np.abs(made).max())


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimate_follows_the_echo_s_gain(name):
    """A gain on the echo and its square on the noise's power leave a gain on the estimate: no unit is preferred."""
    channel, sent, region, noise = law_setting()
    received, gain = channel @ sent + noise, 3e-4 * np.exp(0.7j)
    plain = estimate_channel(name, received, sent, noise_w=1.0, region=region).channel
    scaled = estimate_channel(name, gain * received, sent, noise_w=abs(gain) ** 2, region=region).channel
    np.testing.assert_allclose(scaled / gain, plain, atol=2e-4 * np.abs(plain).max())


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimate_follows_the_pilots_power(name):
    """Pilots and echo twice as strong, over the same channel, leave a smaller error of the same channel."""
    channel, sent, region, noise = law_setting()
    errors = [
        np.linalg.norm(
            estimate_channel(name, channel @ (gain * sent) + noise, gain * sent, noise_w=1.0, region=region).channel
            - channel
        )
        for gain in (1.0, 8.0)
    ]
    assert errors[1] < 0.6 * errors[0]


def test_snr_is_estimated_from_the_received_energy():
    channels, predictions = scenes("near")
    book = beams.roi_codebook(16, 4, beams.direction_angles(predictions[0]), (np.pi / 6, np.pi / 6))
    sent = beams.pilots(book, beams.pilot_symbols(jax.random.key(0), 64, 64), 1e-3)
    noise_w = float(jnp.mean(jnp.abs(channels[0, 0] @ sent) ** 2)) / 10.0
    received, realised = station.echo(jax.random.key(1), channels[0, 0], sent, noise_w)
    np.testing.assert_allclose(realised, 10.0, rtol=0.06)  # 4096 noise entries: 1.6 %
    np.testing.assert_allclose(estimate_snr(received, noise_w), realised, rtol=0.06)
    assert estimate_snr(jnp.zeros((64, 64), jnp.complex64), noise_w) > 0.0


def test_tones_share_the_power_and_the_snr():
    array = replace(ARRAY, nx=8, nz=2, tones_hz=(2.95e9, 3.0e9, 3.05e9))
    channels, predictions, seen = observed("near", "lmmse_roi", 20.0, array=array)
    assert seen.estimated_channel.shape == (COUNT, 3, 16, 16)
    np.testing.assert_allclose(seen.snr_db, 20.0, atol=0.5)  # 768 noise entries: 0.16 dB
    assert nmse_db(seen.estimated_channel, channels) < -25
    one = PlanarArray(8, 2, 3e9)
    book = beams.roi_codebook(8, 2, beams.direction_angles(predictions[0]), (np.pi / 6, np.pi / 6))
    sent = beams.pilots(book, jnp.eye(16), beams.dbm_to_watt(seen.power_dbm[0]) / 3)
    echoes = float(jnp.sum(jnp.abs(channels[0] @ sent) ** 2))
    np.testing.assert_allclose(echoes / (3 * one.count**2 * 1e-15), 100.0, rtol=1e-3)


def test_estimate_improves_with_power_up_to_float32():
    levels = np.repeat([0.0, 15.0, 30.0, 60.0], COUNT // 4)
    true, _, seen = observed("near", "lmmse_roi", levels)
    errors = [
        nmse_db(seen.estimated_channel[levels == level], true[levels == level]) for level in (0.0, 15.0, 30.0, 60.0)
    ]
    assert errors[0] > errors[1] + 8 and errors[1] > errors[2] + 8
    assert errors[3] < errors[2]


@pytest.mark.parametrize("look", [station.observe, station.observe_region])
def test_a_prediction_in_whole_numbers_is_one(unchecked, look):
    """Its own type would round the region's nodes and the antennas' places away."""
    channel = 1e-7 * jax.random.normal(jax.random.key(2), (1, 64, 64), jnp.complex64)
    given = {"array": ARRAY, "signal": SignalConfig(), "region": REGION, "snr_db": 10.0}
    by_whole, by_real = (
        look(jax.random.key(0), channel + channel.swapaxes(1, 2), jnp.array([5, 6, 3], kind), **given)
        for kind in (jnp.int32, jnp.float32)
    )
    for whole, real in zip(jax.tree.leaves(by_whole), jax.tree.leaves(by_real), strict=True):
        np.testing.assert_array_equal(whole, real)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"channel": jnp.zeros((64, 64), jnp.complex64)}, r"\(1, 64, 64\)"),
        ({"predicted": jnp.zeros((2, 3))}, r"\(2, 3\)"),
        ({"power_dbm": 20.0}, "exactly one"),
        ({"snr_db": None}, "exactly one"),
    ],
)
def test_bad_observation_is_named(unchecked, change, words):
    arguments = {
        "channel": jnp.zeros((1, 64, 64), jnp.complex64),
        "predicted": jnp.ones(3),
        "array": ARRAY,
        "signal": SignalConfig(),
        "region": REGION,
        "snr_db": 10.0,
    } | change
    with pytest.raises(ValueError, match=words):
        station.observe(jax.random.key(0), arguments.pop("channel"), arguments.pop("predicted"), **arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("mmse",), "mmse"), *(((name,), each.needs[0]) for name, each in ESTIMATORS.items() if each.needs)],
)
def test_bad_estimate_is_named(unchecked, arguments, words):
    with pytest.raises(ValueError, match=words):
        estimate_channel(*arguments, jnp.zeros((4, 4), jnp.complex64), jnp.zeros((4, 4), jnp.complex64))
    with pytest.raises(ValueError, match=r"\(4, 5\)"):
        estimate_channel("ls", jnp.zeros((4, 5), jnp.complex64), jnp.zeros((4, 4), jnp.complex64))
