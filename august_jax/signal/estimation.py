"""What the base station receives and what it makes of it: echo, SNR and four channel estimators (paper, Section II-B).

Y = H X + N with N circular white, E|N|^2 = sigma^2 an entry. Every estimate is symmetrised, (H + H^T)/2, because a
reciprocal channel is symmetric. The estimators, by name:

* ``ls``: the paper prints Y X^H (X X^H)^{-1}. The codebook of a sector is numerically singular (condition number 1e13
  and more), so the inverse is taken on the singular values of X above a tenth of the largest; how many those are is
  returned as the rank.
* ``ridge``: Y X^H (X X^H + r I)^{-1}. With the pilots' mean gain on the illuminated directions,
  g = tr((X X^H)^2)/tr(X X^H), and the echo's energy E = ||Y||^2 - ||N||^2, the error is about
  E r^2/g^3 + 2 sigma^2 N_b/r (bias plus noise, for a spectrum that falls by a factor e every two modes); its minimum is
  r = g (sigma^2 N_b/E)^{1/3}.
* ``dft``: plain least squares from unitary pilots of the same power, which light all directions alike.
* ``lmmse_roi``: linear MMSE for a cloud of independent isotropic scatterers that fills the region's box about the
  prediction, H = sum_q a_q g_q g_q^T, a_q ~ CN(0, p w_q) on a Gauss-Legendre grid of nodes q with weights w_q (which
  integrates the covariance of the region exactly enough), p from the echo's energy. In the region's subspace
  (:mod:`august_jax.signal.roi`), c_q = U^H g_q, Z = U^H Y, B = U^T X:

      M_qr = (c_q^H c_r)(c_q^H conj(B) B^T c_r),   (sigma^2 diag(1/(p w)) + M) a = [c_q^H Z B^H conj(c_q)]_q,

      A = sum_q a_q c_q c_q^T,

  one Hermitian solve of 27 unknowns. U has orthonormal columns, so the noise in Z is as white as in Y.

:func:`observe` and :func:`observe_roi` are one base station at work: beams at the predicted position, pilots, power,
noise, estimate. With several tones each gets the same beams and pilots and an equal share of the power, and the SNR is
that of all tones together.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.config import ArrayConfig, RegionConfig, SignalConfig
from august_jax.constants import SPEED_OF_LIGHT
from august_jax.physics.array import PlanarArray
from august_jax.signal import beams, roi

ESTIMATORS = ("ls", "ridge", "dft", "lmmse_roi")
NODES_PER_AXIS = 3
"""Quadrature nodes along each edge of the region's box; four and five change the error by less than 1 dB."""


class Estimate(NamedTuple):
    """An estimated channel.

    Attributes:
        channel: (N_b, N_b) complex, symmetric.
        rank: directions of the pilots that the estimate uses, int32; below N_b where it truncated.
    """

    channel: jax.Array
    rank: jax.Array


class Region(NamedTuple):
    """Where ``lmmse_roi`` expects scatterers, and how one tone sees them.

    Attributes:
        predicted: centre of the box, q_pre (3,) [m].
        half_width_m: half the edge of the box [m].
        positions: array elements (N_b, 3) [m].
        wavenumber: k of the tone [rad/m].
        basis: P (N_b, K) of :func:`august_jax.signal.roi.legendre_basis`.
    """

    predicted: jax.Array
    half_width_m: float
    positions: jax.Array | np.ndarray
    wavenumber: jax.Array | float
    basis: jax.Array | np.ndarray


class Observation(NamedTuple):
    """What the base station knows after one slot.

    Attributes:
        channel: H_est (F, N_b, N_b) complex, symmetric.
        snr_db: realised 10 log10(||HX||^2/||N||^2) over all tones, of the pilots that were sent.
        snr_estimate_db: what the receiver makes of it from ||Y||^2 and sigma^2 (:func:`estimate_snr`).
        power_dbm: transmit power P_s over all tones [dBm].
        rank: as in :class:`Estimate`, (F,).
    """

    channel: jax.Array
    snr_db: jax.Array
    snr_estimate_db: jax.Array
    power_dbm: jax.Array
    rank: jax.Array


class RegionObservation(NamedTuple):
    """As :class:`Observation`, with the estimate as coefficients A (F, K, K) in the region's subspace."""

    coefficients: jax.Array
    snr_db: jax.Array
    snr_estimate_db: jax.Array
    power_dbm: jax.Array
    rank: jax.Array


def echo(key: jax.Array, channel: jax.Array, pilots: jax.Array, noise_w) -> tuple[jax.Array, jax.Array]:
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
    noise = jnp.sqrt(noise_w) * _white_noise(key, clean.shape)
    return clean + noise, energy(clean) / energy(noise)


def energy(array: jax.Array) -> jax.Array:
    """Squared Frobenius norm over the last two axes."""
    return jnp.sum(jnp.real(array) ** 2 + jnp.imag(array) ** 2, axis=(-2, -1))


def estimate_snr(received: jax.Array, noise_w) -> jax.Array:
    """SNR (linear) that a receiver can know, (||Y||^2 - E||N||^2)/E||N||^2, floored at the spread of ||N||^2.

    Args:
        received: Y (..., N_b, L) [sqrt(W)].
        noise_w: sigma^2 [W].
    """
    count = received.shape[-2] * received.shape[-1]
    return _snr_above_noise(energy(received) / noise_w, count)


def _snr_above_noise(received_energy, entries: int) -> jax.Array:
    """:func:`estimate_snr` from ||Y||^2/sigma^2 of so many entries."""
    return jnp.maximum(received_energy / entries - 1.0, 1.0 / np.sqrt(entries))


def estimate(
    name: str, received: jax.Array, pilots: jax.Array, *, noise_w=None, region: Region | None = None
) -> Estimate:
    """Channel estimate of one tone.

    Args:
        name: ``ls``, ``ridge``, ``dft`` or ``lmmse_roi``.
        received: Y (N_b, L) [sqrt(W)].
        pilots: X (N_b, L) [sqrt(W)]; for ``dft`` with X X^H proportional to the identity.
        noise_w: sigma^2 [W]; needed by ``ridge`` and ``lmmse_roi``.
        region: needed by ``lmmse_roi``.

    Raises:
        ValueError: an unknown name, shapes that do not fit, or a missing argument.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"name: unknown estimator {name!r}; choose one of {', '.join(ESTIMATORS)}")
    if received.ndim != 2 or received.shape != pilots.shape:
        raise ValueError(
            f"received: got shape {received.shape} for pilots of shape {pilots.shape}; both must be (N_b, L), "
            "map over more axes with jax.vmap"
        )
    if noise_w is None and name in ("ridge", "lmmse_roi"):
        raise ValueError(f"noise_w: {name} needs the noise power in W; pass noise_w=")
    if region is None and name == "lmmse_roi":
        raise ValueError("region: lmmse_roi needs the region of interest; pass region=Region(...)")
    if name == "ls":
        return least_squares(received, pilots)
    if name == "ridge":
        return ridge(received, pilots, noise_w)
    if name == "dft":
        return orthogonal_least_squares(received, pilots)
    return lmmse_roi(received, pilots, noise_w, region)


def least_squares(received: jax.Array, pilots: jax.Array, *, rcond: float = 0.1) -> Estimate:
    """Y X^+ on the singular values of X above ``rcond`` times the largest, symmetrised."""
    left, values, right = jnp.linalg.svd(pilots, full_matrices=False)
    kept = values > rcond * values[0]
    inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
    channel = ((received @ right.conj().T) * inverse) @ left.conj().T
    return Estimate(_symmetrise(channel), jnp.sum(kept, dtype=jnp.int32))


def ridge(received: jax.Array, pilots: jax.Array, noise_w) -> Estimate:
    """Y X^H (X X^H + r I)^{-1}, r as in the module's docstring, symmetrised."""
    count = pilots.shape[0]
    gram = pilots @ pilots.conj().T
    signal = estimate_snr(received, noise_w) * noise_w * received.size
    gain = energy(gram) / energy(pilots)
    regulariser = gain * jnp.cbrt(noise_w * count / signal)
    # Dividing by the gain keeps float32 away from the squares of milliwatts.
    system = gram / gain + (regulariser / gain) * jnp.eye(count, dtype=gram.dtype)
    cross = received @ pilots.conj().T / gain
    channel = jnp.linalg.solve(system.T, cross.T).T
    return Estimate(_symmetrise(channel), jnp.asarray(count, jnp.int32))


def orthogonal_least_squares(received: jax.Array, pilots: jax.Array) -> Estimate:
    """Y X^H / (||X||^2/N_b): least squares where X X^H is a multiple of the identity, symmetrised."""
    count = pilots.shape[0]
    channel = received @ pilots.conj().T * (count / energy(pilots))
    return Estimate(_symmetrise(channel), jnp.asarray(count, jnp.int32))


def lmmse_roi(received: jax.Array, pilots: jax.Array, noise_w, region: Region) -> Estimate:
    """Linear MMSE over the region (see the module's docstring); symmetric by construction."""
    scale = jnp.sqrt(noise_w)
    waves = roi.subspace(region.predicted, region.positions, region.wavenumber, region.basis)
    coefficients = roi_coefficients(waves.conj().T @ received / scale, waves.T @ pilots / scale, region)
    channel = waves @ coefficients @ waves.T
    return Estimate(channel, jnp.asarray(pilots.shape[0], jnp.int32))


def roi_coefficients(reduced_echo: jax.Array, reduced_pilots: jax.Array, region: Region) -> jax.Array:
    """Linear MMSE estimate of A from Z = A B + N with white noise of unit power.

    Args:
        reduced_echo: Z = U^H Y / sigma (K, L).
        reduced_pilots: B = U^T X / sigma (K, L).
        region: the box, the array and the tone.

    Returns:
        A (K, K) complex, symmetric.
    """
    offsets, weights = _box_nodes()
    nodes = region.predicted + region.half_width_m * jnp.asarray(offsets, region.predicted.dtype)
    positions = jnp.asarray(region.positions, region.predicted.dtype)
    # Path lengths to the nodes less those to the prediction: the phases of U are already taken out.
    differences = jax.vmap(roi.path_differences, (None, 0))(positions, nodes)
    angle = region.wavenumber * (differences - roi.path_differences(positions, region.predicted))
    basis = jnp.asarray(region.basis)
    waves = jax.lax.complex(jnp.cos(angle) @ basis, jnp.sin(angle) @ basis).T  # c_q as columns (K, Q)
    cross = reduced_echo @ reduced_pilots.conj().T
    gains = (reduced_pilots @ reduced_pilots.conj().T).conj()
    gram = (waves.conj().T @ waves) * (waves.conj().T @ gains @ waves)
    matched = jnp.sum(waves.conj() * (cross @ waves.conj()), axis=0)
    signal = estimate_snr(reduced_echo, 1.0) * reduced_echo.size
    root = jnp.asarray(np.sqrt(weights), angle.dtype)
    received = jnp.sum(root**2 * jnp.real(jnp.diagonal(gram)))
    prior = signal / received
    # Rounding in the Gram matrix acts like noise; beyond some 35 dB it outweighs the noise in float32.
    floor = 1.0 + jnp.finfo(angle.dtype).eps * signal
    system = prior * root[:, None] * gram * root + floor * jnp.eye(root.size, dtype=gram.dtype)
    amplitudes = prior * root * jnp.linalg.solve(system, root * matched)
    return (waves * amplitudes) @ waves.T


def observe(
    key: jax.Array,
    channel: jax.Array,
    predicted: jax.Array,
    *,
    array: ArrayConfig,
    signal: SignalConfig,
    region: RegionConfig,
    snr_db=None,
    power_dbm=None,
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

    Returns:
        :class:`Observation`.

    Raises:
        ValueError: shapes that do not fit, or not exactly one of ``snr_db`` and ``power_dbm``.
    """
    _check(channel, predicted, array, snr_db, power_dbm)
    if signal.estimator == "lmmse_roi":
        seen = observe_roi(key, channel, predicted, array=array, signal=signal, region=region, snr_db=snr_db,
                           power_dbm=power_dbm)
        planar, wavenumbers, basis = _geometry(array)
        lift = jax.vmap(roi.lift, (0, None, None, 0, None))
        return Observation(lift(seen.coefficients, predicted, planar.positions, wavenumbers, basis), *seen[1:])

    planar, _, _ = _geometry(array)
    noise_w = beams.dbm_to_watt(signal.noise_dbm)
    symbols = signal.symbols or array.count
    key_pilots, key_unitary, key_noise = jax.random.split(key, 3)
    codebook = beams.roi_codebook(array.nx, array.nz, beams.direction_angles(predicted), _radians(signal),
                                  mirror=signal.mirror_beams)
    drawn = beams.pilot_symbols(key_pilots, array.count, symbols, signal.pilots)
    sent = beams.pilots(codebook, drawn, 1.0 / channel.shape[0])
    if power_dbm is None:
        power_w = _power_for(snr_db, jnp.sum(energy(channel @ sent)), noise_w, channel.shape[0] * array.count * symbols)
    else:
        power_w = beams.dbm_to_watt(power_dbm)
    if signal.estimator == "dft":
        sent = beams.pilots(jnp.eye(array.count, dtype=sent.dtype),
                            beams.pilot_symbols(key_unitary, array.count, symbols), 1.0 / channel.shape[0])
    # In units of the noise: echoes of 1e-15 W have squares that float32 cannot hold.
    sent = sent * jnp.sqrt(power_w / noise_w)
    clean = channel @ sent
    noise = _white_noise(key_noise, clean.shape)
    received = clean + noise
    estimates = jax.vmap(lambda each: estimate(signal.estimator, each, sent, noise_w=1.0))(received)
    snr = jnp.sum(energy(clean)) / jnp.sum(energy(noise))
    known = _snr_above_noise(jnp.sum(energy(received)), received.size)
    return Observation(estimates.channel, _decibels(snr), _decibels(known), beams.watt_to_dbm(power_w), estimates.rank)


def observe_roi(
    key: jax.Array,
    channel: jax.Array,
    predicted: jax.Array,
    *,
    array: ArrayConfig,
    signal: SignalConfig,
    region: RegionConfig,
    snr_db=None,
    power_dbm=None,
) -> RegionObservation:
    """:func:`observe` in the region's subspace: the same arguments, the coefficients A (F, K, K) instead of H_est.

    ``lmmse_roi`` never leaves the subspace here: Y enters its estimate through U^H Y alone, whose noise is white, and
    unitary pilots with S S^H = L I are undone exactly by Y S^H / sqrt(L), whose noise is white again. So only the K N_b
    numbers that matter are drawn; the rest of ||N||^2, a sum of thousands of squares, is drawn as the Gaussian that it
    is close to. The share of ||HX||^2 outside the subspace, some 1e-6, is left out of the SNR.
    """
    _check(channel, predicted, array, snr_db, power_dbm)
    planar, wavenumbers, basis = _geometry(array)
    over_tones = jax.vmap(roi.project, (0, None, None, 0, None))
    if signal.estimator != "lmmse_roi":
        seen = observe(key, channel, predicted, array=array, signal=signal, region=region, snr_db=snr_db,
                       power_dbm=power_dbm)
        return RegionObservation(over_tones(seen.channel, predicted, planar.positions, wavenumbers, basis), *seen[1:])

    tones, count = channel.shape[0], array.count
    noise_w = beams.dbm_to_watt(signal.noise_dbm)
    symbols = signal.symbols or count
    factors = beams.codebook_factors(array.nx, array.nz, beams.direction_angles(predicted), _radians(signal),
                                     mirror=signal.mirror_beams)
    sent = jax.vmap(lambda k: _reduced_beams(predicted, planar, k, basis, factors))(wavenumbers)
    if signal.pilots == "unitary":
        # X X^H = (P_s/F)(L/N_b) W W^H whatever S is, because ||W S||^2 = L ||W||^2 = L N_b.
        sent = sent * np.sqrt(symbols / (count * tones))
    else:
        key, key_pilots = jax.random.split(key)
        drawn = beams.pilot_symbols(key_pilots, count, symbols, signal.pilots)
        codebook = beams.roi_codebook(array.nx, array.nz, beams.direction_angles(predicted), _radians(signal),
                                      mirror=signal.mirror_beams)
        sent = sent @ drawn * jnp.sqrt(symbols / (tones * energy(codebook @ drawn)))
    clean = over_tones(channel, predicted, planar.positions, wavenumbers, basis) @ sent
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
    coefficients = jax.vmap(
        lambda seen, pilots, k: roi_coefficients(
            seen, pilots, Region(predicted, region.scale_m, planar.positions, k, basis)
        )
    )(received, amplitude * sent, wavenumbers)
    snr = amplitude**2 * jnp.sum(energy(clean)) / (jnp.sum(parts**2) + rest_energy)
    known = _snr_above_noise(jnp.sum(energy(received)) + rest_energy, entries)
    rank = jnp.full(tones, count, jnp.int32)
    return RegionObservation(coefficients, _decibels(snr), _decibels(known), beams.watt_to_dbm(power_w), rank)


def _reduced_beams(predicted, planar: PlanarArray, wavenumber, basis: np.ndarray, factors) -> jax.Array:
    """U^T W (K, N_b), axis by axis: several times fewer operations than with W itself."""
    waves = roi.subspace(predicted, planar.positions, wavenumber, basis).reshape(planar.nx, planar.nz, -1)
    along_x, along_z = factors
    columns = jnp.einsum("abk,bj->kaj", waves, along_z)
    return jnp.einsum("kaj,aij->kij", columns, along_x).reshape(-1, planar.count)


def _geometry(array: ArrayConfig) -> tuple[PlanarArray, np.ndarray, np.ndarray]:
    """The array, the wavenumber of each tone (F,) [rad/m] and the region's basis P."""
    wavenumbers = 2.0 * np.pi * np.asarray(array.frequencies_hz) / SPEED_OF_LIGHT
    return (PlanarArray(array.nx, array.nz, array.frequency_hz), wavenumbers.astype(np.float32),
            roi.legendre_basis(array.nx, array.nz))


def _radians(signal: SignalConfig) -> tuple[float, float]:
    azimuth, elevation = np.deg2rad(signal.beam_width_deg)
    return float(azimuth), float(elevation)


def _decibels(ratio) -> jax.Array:
    return 10.0 * jnp.log10(ratio)


def _power_for(snr_db, echo_energy_per_watt, noise_w, entries: int) -> jax.Array:
    """P_s [W] at which the echo's energy is the SNR times the expected energy of the noise."""
    return 10.0 ** (jnp.asarray(snr_db) / 10.0) * (noise_w / echo_energy_per_watt) * entries


def _box_nodes() -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes (Q, 3) of the cube [-1, 1]^3 and their weights (Q,), which add up to one."""
    places, weights = np.polynomial.legendre.leggauss(NODES_PER_AXIS)
    nodes = np.stack(np.meshgrid(places, places, places, indexing="ij"), axis=-1).reshape(-1, 3)
    products = np.einsum("i,j,k->ijk", weights, weights, weights).reshape(-1) / 8.0
    return nodes, products


def _white_noise(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Circular Gaussian entries of unit power, complex64."""
    parts = np.float32(np.sqrt(0.5)) * jax.random.normal(key, (2, *shape), jnp.float32)
    return jax.lax.complex(parts[0], parts[1])


def _symmetrise(channel: jax.Array) -> jax.Array:
    return 0.5 * (channel + channel.T)


def _check(channel, predicted, array: ArrayConfig, snr_db, power_dbm) -> None:
    wanted = (len(array.frequencies_hz), array.count, array.count)
    if channel.shape != wanted:
        raise ValueError(
            f"channel: got shape {channel.shape}; the array has {wanted[0]} tone(s) and {wanted[1]} antennas and wants "
            f"{wanted}; map over samples with jax.vmap"
        )
    if predicted.shape != (3,):
        raise ValueError(f"predicted: got shape {predicted.shape}; give one position (3,) in metres")
    if (snr_db is None) == (power_dbm is None):
        raise ValueError("snr_db, power_dbm: give exactly one of the two, the SNR in dB or the transmit power in dBm")
