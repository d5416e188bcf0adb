"""One base station at work: beams at the predicted position, pilots, power, noise, estimate (paper, Section II).

Y = H X + N with N circular white, E|N|^2 = sigma^2 an entry. With several tones each gets the same beams and pilots and
an equal share of the power, and the SNR is that of all tones together. :func:`observe` answers with the estimated
channel, :func:`observe_region` with its coefficients in the region's field subspace, at a fraction of the cost;
:func:`observe_for` with what the networks of a configuration are told.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from august_jax.arrays import Array, ArrayLike
from august_jax.config import ArrayConfig, Config, RegionConfig, SignalConfig
from august_jax.physics.array import PlanarArray
from august_jax.physics.checks import check_finite, settled
from august_jax.signal import beams, roi
from august_jax.signal.estimators import ESTIMATORS, Region, roi_coefficients
from august_jax.signal.noise import energy, snr_above_noise, white_noise
from august_jax.signal.roi import Coefficients, Subspace


class Statistics(NamedTuple):
    """All that an echo says about a channel in the region's subspace, A = U^H H conj(U), in K^2 numbers a tone.

    The noise in U^H Y is white, so that A enters Y through U^H Y = A B + N alone, B = U^T X. With B = C Q^H, C lower
    triangular and Q of orthonormal columns,

        Z = U^H Y Q = A C + N',

    whose noise is white again; what is left of U^H Y is noise. Both are in units of the noise, E|N'|^2 = 1 an entry.

    Attributes:
        received: Z of each tone (F, K, K) complex64.
        pilots: C of each tone (F, K, K) complex64 [m]; A is in [1/m].
        centre: the point (3,) [m] about which A is taken.
    """

    received: Complex[Array, "*batch tones orders orders"]
    pilots: Complex[Array, "*batch tones orders orders"]
    centre: Float[Array, "*batch 3"]


class Observation(NamedTuple):
    """What the base station knows after one slot.

    Attributes:
        estimated_channel: H_est (F, N_b, N_b) complex, symmetric.
        snr_db: realised 10 log10(||HX||^2/||N||^2) over all tones, of the pilots that were sent.
        snr_estimate_db: what the receiver makes of it from ||Y||^2 and sigma^2 (`august_jax.signal.estimate_snr`).
        power_dbm: transmit power P_s over all tones [dBm].
        rank: directions of the pilots that the estimate uses, of each tone (F,).
        statistics: what the echo says, of which the estimate is one reading.
    """

    estimated_channel: Complex[Array, "*batch tones antennas antennas"]
    snr_db: Float[Array, "*batch"]
    snr_estimate_db: Float[Array, "*batch"]
    power_dbm: Float[Array, "*batch"]
    rank: Int[Array, "*batch tones"]
    statistics: Statistics

    @property
    def heard(self) -> Array:
        """What networks are told: the estimated channel."""
        return self.estimated_channel


class RegionObservation(NamedTuple):
    """As :class:`Observation`, with the estimate as coefficients in the region's subspace."""

    coefficients: Coefficients
    snr_db: Float[Array, "*batch"]
    snr_estimate_db: Float[Array, "*batch"]
    power_dbm: Float[Array, "*batch"]
    rank: Int[Array, "*batch tones"]
    statistics: Statistics

    @property
    def heard(self) -> Coefficients:
        """What networks are told: the coefficients."""
        return self.coefficients


def echo(
    key: jax.Array,
    channel: Complex[Array, "antennas antennas"],
    pilots: Complex[Array, "antennas symbols"],
    noise_w: ArrayLike,
) -> tuple[Complex[jax.Array, "antennas symbols"], Float[jax.Array, ""]]:
    """Received signal Y = H X + N.

    Args:
        key: random key of the noise.
        channel: H (N_b, N_b).
        pilots: X (N_b, L) [sqrt(W)].
        noise_w: sigma^2, noise power of one antenna and symbol [W].

    Returns:
        Y (N_b, L) [sqrt(W)] and the realised SNR ||H X||^2/||N||^2 (linear).
    """
    clean = channel @ pilots
    noise = jnp.sqrt(noise_w) * white_noise(key, clean.shape)
    return clean + noise, energy(clean) / energy(noise)


def observe(
    key: jax.Array,
    channel: Complex[Array, "tones antennas antennas"],
    predicted: Float[Array, "3"],
    *,
    array: ArrayConfig,
    signal: SignalConfig,
    region: RegionConfig,
    snr_db: ArrayLike | None = None,
    power_dbm: ArrayLike | None = None,
) -> Observation:
    """One slot at the base station: the true channel in, the estimated one out.

    Args:
        key: random key of pilots and noise.
        channel: H (F, N_b, N_b) complex, one slice a tone of ``array.frequencies_hz``.
        predicted: q_pre (3,) [m]; the beams point there.
        array, signal, region: configuration (static under jit). The scatterers of ``lmmse_roi`` fill the cube of half
            edge ``region.scale_m``, where the target's parts are.
        snr_db: set the power so that ||H X||^2 is this times the expected ||N||^2, X being the region's pilots; the
            pilots of ``dft`` then get the same power.
        power_dbm: P_s [dBm], instead of ``snr_db``.

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite, or not exactly one of ``snr_db`` and
            ``power_dbm``.
    """
    predicted = jnp.asarray(settled("predicted", predicted))
    _check(channel, predicted, array, snr_db, power_dbm)
    if signal.estimator == "lmmse_roi":  # formed in the subspace, where it lives
        seen = observe_region(
            key, channel, predicted, array=array, signal=signal, region=region, snr_db=snr_db, power_dbm=power_dbm
        )
        lifted = roi.lift(seen.coefficients, Subspace.from_config(array))
        return Observation(lifted, *seen[1:])

    noise_w = beams.dbm_to_watt(signal.noise_dbm)
    symbols = signal.symbols or array.count
    key_pilots, key_unitary, key_noise = jax.random.split(key, 3)
    drawn = beams.pilot_symbols(key_pilots, array.count, symbols, signal.pilots)
    sent = beams.pilots(codebook(predicted, array, signal), drawn, 1.0 / channel.shape[0])
    if power_dbm is None:
        power_w = _power_for(snr_db, jnp.sum(energy(channel @ sent)), noise_w, channel.shape[0] * array.count * symbols)
    else:
        power_w = beams.dbm_to_watt(power_dbm)
    estimator = ESTIMATORS[signal.estimator]
    if estimator.uniform_pilots:
        sent = beams.pilots(
            jnp.eye(array.count, dtype=sent.dtype),
            beams.pilot_symbols(key_unitary, array.count, symbols),
            1.0 / channel.shape[0],
        )
    # In units of the noise: echoes of 1e-15 W have squares that float32 cannot hold.
    sent = sent * jnp.sqrt(power_w / noise_w)
    clean = channel @ sent
    noise = white_noise(key_noise, clean.shape)
    received = clean + noise
    subspace = Subspace.from_config(array)
    run = estimator.run_beams if estimator.run_beams and signal.pilots == "unitary" else estimator.run

    def estimated(each: jax.Array, k: jax.Array):
        box = Region(predicted, region.scale_m, subspace.positions, k, subspace.basis)
        return run(each, sent, 1.0, box)

    estimates = jax.vmap(estimated)(received, subspace.wavenumbers)
    snr = jnp.sum(energy(clean)) / jnp.sum(energy(noise))
    known = snr_above_noise(jnp.sum(energy(received)), received.size)
    waves = subspace.waves(predicted)
    statistics = _statistics(
        jnp.swapaxes(waves.conj(), -1, -2) @ received, jnp.swapaxes(waves, -1, -2) @ sent, predicted
    )
    return Observation(
        estimates.channel, _decibels(snr), _decibels(known), beams.watt_to_dbm(power_w), estimates.rank, statistics
    )


def observe_region(
    key: jax.Array,
    channel: Complex[Array, "tones antennas antennas"] | Coefficients,
    predicted: Float[Array, "3"],
    *,
    array: ArrayConfig,
    signal: SignalConfig,
    region: RegionConfig,
    snr_db: ArrayLike | None = None,
    power_dbm: ArrayLike | None = None,
) -> RegionObservation:
    """:func:`observe` in the region's subspace: the same arguments, coefficients about ``predicted`` instead of H_est.

    ``lmmse_roi`` never leaves the subspace here: Y enters its estimate through U^H Y alone, whose noise is white, and
    unitary pilots with S S^H = L I are undone exactly by Y S^H / sqrt(L), whose noise is white again. So only the K N_b
    numbers that matter are drawn; the rest of ||N||^2, a sum of thousands of squares, is drawn as the Gaussian that it
    is close to. The share of ||HX||^2 outside the subspace, some 1e-6, is left out of the SNR.

    So its ``channel`` may come as coefficients about ``predicted``, for example of a table, which never formed H.

    Raises:
        ValueError: as :func:`observe`, or coefficients where the estimator hears the whole channel.
    """
    subspace = Subspace.from_config(array)
    if isinstance(channel, Coefficients):
        _check_coefficients(channel, signal, subspace)
    predicted = jnp.asarray(settled("predicted", predicted))
    _check(channel, predicted, array, snr_db, power_dbm)
    if signal.estimator != "lmmse_roi":
        assert not isinstance(channel, Coefficients)
        seen = observe(
            key, channel, predicted, array=array, signal=signal, region=region, snr_db=snr_db, power_dbm=power_dbm
        )
        projected = roi.project(seen.estimated_channel, predicted, subspace)
        return RegionObservation(projected, *seen[1:])

    tones, count = len(array.frequencies_hz), array.count
    noise_w = beams.dbm_to_watt(signal.noise_dbm)
    symbols = signal.symbols or count
    factors = beams.codebook_factors(
        array.nx, array.nz, beams.direction_angles(predicted), _radians(signal), mirror=signal.mirror_beams
    )
    waves = subspace.waves(predicted)
    sent = jax.vmap(lambda basis: _reduced_beams(basis, subspace.array, factors))(waves)
    if signal.pilots == "unitary":
        # X X^H = (P_s/F)(L/N_b) W W^H whatever S is, because ||W S||^2 = L ||W||^2 = L N_b.
        sent = sent * np.sqrt(symbols / (count * tones))
    else:
        key, key_pilots = jax.random.split(key)
        drawn = beams.pilot_symbols(key_pilots, count, symbols, signal.pilots)
        power = energy(codebook(predicted, array, signal) @ drawn)
        sent = sent @ drawn * jnp.sqrt(symbols / (tones * power))
    reduced = channel if isinstance(channel, Coefficients) else roi.project(channel, predicted, subspace)
    clean = reduced.values @ sent
    entries = tones * count * symbols
    if power_dbm is None:
        power_w = _power_for(snr_db, jnp.sum(energy(clean)), noise_w, entries)
    else:
        power_w = beams.dbm_to_watt(power_dbm)
    amplitude = jnp.sqrt(power_w / noise_w)
    # One draw for everything: each call of the generator costs a second of compilation.
    draws = jax.random.normal(key, (2 * clean.size + 1,))
    parts = np.sqrt(0.5) * draws[:-1].reshape(2, *clean.shape)
    noise = jax.lax.complex(parts[0], parts[1])
    rest = entries - clean.size
    rest_energy = jnp.maximum(rest + np.sqrt(rest) * draws[-1], 0.0)
    received = amplitude * clean + noise
    values = jax.vmap(
        lambda seen, pilots, k: roi_coefficients(
            seen, pilots, Region(predicted, region.scale_m, subspace.positions, k, subspace.basis)
        )
    )(received, amplitude * sent, subspace.wavenumbers)
    snr = amplitude**2 * jnp.sum(energy(clean)) / (jnp.sum(parts**2) + rest_energy)
    known = snr_above_noise(jnp.sum(energy(received)) + rest_energy, entries)
    rank = jnp.full(tones, count, jnp.int32)
    return RegionObservation(
        Coefficients(values, predicted),
        _decibels(snr),
        _decibels(known),
        beams.watt_to_dbm(power_w),
        rank,
        _statistics(received, amplitude * sent, predicted),
    )


def observe_for(
    config: Config,
    key: jax.Array,
    channel: Complex[Array, "tones antennas antennas"] | Coefficients,
    predicted: Float[Array, "3"],
    *,
    snr_db: ArrayLike | None = None,
    power_dbm: ArrayLike | None = None,
) -> Observation | RegionObservation:
    """What the networks of a configuration are told of a slot: coefficients for the encoder ``roi``, else H_est.

    For the encoder ``roi`` and the estimator ``lmmse_roi`` the channel, too, may come as coefficients about
    ``predicted``.
    """
    look: Callable[..., Observation | RegionObservation] = observe_region if config.model.encoder == "roi" else observe
    return look(
        key,
        channel,
        predicted,
        array=config.array,
        signal=config.signal,
        region=config.region,
        snr_db=snr_db,
        power_dbm=power_dbm,
    )


def codebook(
    predicted: Float[Array, "3"], array: ArrayConfig, signal: SignalConfig
) -> Complex[jax.Array, "antennas antennas"]:
    """The beams W (N_b, N_b) of the region about q_pre (3,) [m]; see :func:`~august_jax.signal.beams.roi_codebook`."""
    return beams.roi_codebook(
        array.nx, array.nz, beams.direction_angles(predicted), _radians(signal), mirror=signal.mirror_beams
    )


def _reduced_beams(waves: jax.Array, planar: PlanarArray, factors: tuple[jax.Array, jax.Array]) -> jax.Array:
    """U^T W (K, N_b) of U (N_b, K), axis by axis: several times fewer operations than with W itself."""
    along_x, along_z = factors
    columns = jnp.einsum("abk,bj->kaj", waves.reshape(planar.nx, planar.nz, -1), along_z)
    return jnp.einsum("kaj,aij->kij", columns, along_x).reshape(-1, planar.count)


def _statistics(received: jax.Array, sent: jax.Array, centre: Array) -> Statistics:
    """Of U^H Y and U^T X (F, K, L) in units of the noise."""
    unitary, triangle = jnp.linalg.qr(jnp.swapaxes(sent.conj(), -1, -2))
    return Statistics(received @ unitary, jnp.swapaxes(triangle.conj(), -1, -2), centre)


def _radians(signal: SignalConfig) -> tuple[float, float]:
    azimuth, elevation = np.deg2rad(signal.beam_width_deg)
    return float(azimuth), float(elevation)


def _decibels(ratio: ArrayLike) -> jax.Array:
    return 10.0 * jnp.log10(ratio)


def _power_for(
    snr_db: ArrayLike | None, echo_energy_per_watt: jax.Array, noise_w: ArrayLike, entries: int
) -> jax.Array:
    """P_s [W] at which the echo's energy is the SNR times the expected energy of the noise."""
    return 10.0 ** (jnp.asarray(snr_db) / 10.0) * (noise_w / echo_energy_per_watt) * entries


def _check_coefficients(channel: Coefficients, signal: SignalConfig, subspace: Subspace) -> None:
    if signal.estimator != "lmmse_roi":
        raise ValueError(
            f"channel: got coefficients, but the estimator {signal.estimator!r} hears the whole channel; give H, or "
            "take signal.estimator=lmmse_roi"
        )
    wanted = (len(subspace.frequencies_hz), subspace.orders, subspace.orders)
    if channel.values.shape != wanted:
        raise ValueError(
            f"channel: got coefficients of shape {channel.values.shape}; the array's subspace has {wanted}"
        )


def _check(
    channel: Array | Coefficients,
    predicted: Array,
    array: ArrayConfig,
    snr_db: ArrayLike | None,
    power_dbm: ArrayLike | None,
) -> None:
    wanted = (len(array.frequencies_hz), array.count, array.count)
    if not isinstance(channel, Coefficients) and channel.shape != wanted:
        raise ValueError(
            f"channel: got shape {channel.shape}; the array has {wanted[0]} tone(s) and {wanted[1]} antennas and wants "
            f"{wanted}; map over samples with jax.vmap"
        )
    if predicted.shape != (3,):
        raise ValueError(f"predicted: got shape {predicted.shape}; give one position (3,) in metres")
    if (snr_db is None) == (power_dbm is None):
        raise ValueError("snr_db, power_dbm: give exactly one of the two, the SNR in dB or the transmit power in dBm")
    for name, value in (("channel", channel), ("predicted", predicted), ("snr_db", snr_db), ("power_dbm", power_dbm)):
        check_finite(name, value, "leave that slot out")
