r"""Slow time: the channels of a craft that moves and whose rotors turn, pulse by pulse, and what Doppler shows of them.

The craft is rigid within a pulse (v/c and the turn within a pulse are neglected), so that a pulse's channel is that of
the pose of its instant. The hull is one factored body, every rotor another that turns about the craft's z by
2 pi f t + phase, f > 0 anticlockwise seen from above:

    H(t) = H_hull(R, q + v t) + sum_i H_i(R R_z(2 pi f_i t + phase_i), q + v t + R c_i).

Between bodies scattering is single: what goes from a rotor to the hull and on to an antenna is left out, while every
body's own coupling is whole. (docs/scattering.md has what that neglects.)

Signs: time runs as e^{-jwt}, H as e^{+jk(r_t + r_r)}. A craft that comes nearer, r = r0 - v t, has H ~ e^{-2jkvt};
with the carrier that is e^{-j(w + 2kv)t}, a higher frequency. So a shift of nu Hz is the factor e^{-2 pi j nu t},
spectra are sums over e^{+2 pi j nu t}, and approaching is positive: nu = 2 v/lambda (monostatic). A tip of radius a has
shifts up to 2 (2 pi f a) cos(elevation)/lambda either way; B blades alike repeat B f times a second, so that a rotor's
lines are the multiples of B f. (Chen, The Micro-Doppler Effect in Radar, chapters 2 and 3.) Range: H over tones turns
as e^{+4 pi j f r/c}.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact

from august_jax.arrays import Array, ArrayLike
from august_jax.constants import SPEED_OF_LIGHT
from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body.body import Body, body_channel, judge_contrast
from august_jax.physics.body.table import Table, check_contrast_range, check_place, table_channel
from august_jax.physics.checks import (
    check_contrast,
    check_finite,
    check_frequency,
    check_nearest,
    check_pose,
    is_concrete,
)
from august_jax.physics.parameters import rotation_from_vector

_TOGETHER = 32
"""Pulses of which the channels are in flight."""


class Spinning(NamedTuple):
    """A rotor on a craft.

    Attributes:
        body: the rotor, factored or tabulated about its own centre; z is its axis.
        centre_m: where that is in the craft's frame (3,) [m].
        rate_hz: turns a second about the craft's z, positive anticlockwise seen from above.
        phase_rad: how far it has turned at t = 0 [rad].
    """

    body: Body | Table
    centre_m: Float[Array, "3"] | Sequence[float]
    rate_hz: ArrayLike
    phase_rad: ArrayLike = 0.0


class DopplerMap(NamedTuple):
    """A picture over Doppler and a second axis.

    Attributes:
        doppler_hz: shifts (V,) [Hz], growing; approaching is positive.
        across: the second axis: ranges [m] of :func:`range_doppler`, times [s] of :func:`spectrogram` (A,).
        values: complex amplitudes (V, A) in the unit of the series: a line of amplitude a is a at its place.
    """

    doppler_hz: Float[np.ndarray, " v"]
    across: Float[np.ndarray, " a"]
    values: Complex[np.ndarray, "v a"]


def slow_time_channels(
    hull: Body | Table,
    rotors: Sequence[Spinning],
    array: PlanarArray | AntennaArray,
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    times_s: Float[Array, " pulses"],
    contrast: ArrayLike,
    *,
    velocity_m_s: Float[Array, "3"] | Sequence[float] = (0.0, 0.0, 0.0),
    receiver: PlanarArray | AntennaArray | None = None,
) -> Complex[jax.Array, "pulses *tones receive transmit"]:
    """Channels of a craft at instants of slow time.

    Args:
        hull: the craft without rotors, factored in its own frame; or a table, of it and of each rotor as wanted, which
            is faster and errs by steps of the size of ``table.errors`` where the nearest direction of its grid changes:
            they spread as far below the hull's line over all shifts.
        rotors: what turns on it; factored for the same tones.
        array: the antennas, transmitting and, without ``receiver``, receiving.
        rotation: craft axes to world axes (3, 3), held.
        translation: the craft's origin at t = 0 (3,) [m].
        times_s: the pulses' instants (T,) [s].
        contrast: chi of all bodies, a scalar or one value a tone (F,).
        velocity_m_s: of the craft in the world (3,) [m/s].
        receiver: the antennas that receive, where they are not those that transmit.

    Returns:
        H [1/m] (T, N_b, N_b), or (T, F, N_b, N_b) for bodies of F tones; complex64. Differentiable in everything but
        the bodies.

    Raises:
        ValueError: as :func:`august_jax.physics.body_channel` and :func:`august_jax.physics.table_channel`; bodies of
            different tones; times that are no list.
    """
    bodies = [hull, *(rotor.body for rotor in rotors)]
    if any((each.frequencies_hz, each.single) != (hull.frequencies_hz, hull.single) for each in bodies):
        raise ValueError(
            "rotors: they were factored for other frequencies than the hull; factor all for the same tones"
        )
    if np.ndim(times_s) != 1:
        raise ValueError(f"times_s: got shape {np.shape(times_s)}; give (T,) in s")
    check_finite("times_s", times_s, "give the pulses' instants in s")
    if np.shape(velocity_m_s) != (3,):
        raise ValueError(f"velocity_m_s: got shape {np.shape(velocity_m_s)}; give (3,) in m/s")
    check_finite("velocity_m_s", velocity_m_s, "give a velocity (3,) in m/s")
    check_pose(hull.frequencies_hz, array, receiver, rotation, translation)
    tones = len(hull.frequencies_hz)
    check_contrast(contrast, ((), (tones,)), f"a scalar or ({tones},), one value a tone")
    for each in bodies:
        if isinstance(each, Table):
            check_contrast_range(each, contrast)
        elif is_concrete(contrast):
            judge_contrast(each, contrast)
    # places in double precision where they can be: k v t is many turns
    exact = is_concrete((translation, velocity_m_s, times_s))
    ops = np if exact else jnp
    places = ops.asarray(translation) + ops.asarray(times_s)[:, None] * ops.asarray(velocity_m_s)
    ends = [end for end in (array, receiver) if end is not None]
    paths = [places, *(_carried(places, rotation, rotor.centre_m) for rotor in rotors)]
    if exact and is_concrete((ends, rotation, rotors)) and len(places):
        for each, path in zip(bodies, paths, strict=True):
            _check_paths(each, array, receiver, rotation, path, ends)
    turn = jnp.asarray(rotation, jnp.float32)
    still = is_concrete(velocity_m_s) and not np.any(np.asarray(velocity_m_s))
    if still:
        place, phase = _rounded(hull, array, receiver, places[:1])
        alone = _channel(hull, array, turn, place[0], contrast, receiver) * phase[0]
        total = jnp.broadcast_to(alone, (len(places), *alone.shape))
    else:
        turns = jnp.broadcast_to(turn, (len(places), 3, 3))
        total = _moved(hull, array, receiver, turns, *_rounded(hull, array, receiver, places), contrast)
    for rotor, path in zip(rotors, paths[1:], strict=True):
        # whole turns are taken out first, in double precision where that can be
        sure = np if is_concrete((times_s, rotor.rate_hz)) else jnp
        whole = sure.asarray(times_s) * rotor.rate_hz
        angles = jnp.asarray(2.0 * np.pi * (whole - sure.floor(whole)) + rotor.phase_rad, jnp.float32)
        turns = jnp.einsum("ab,tbc->tac", turn, about_z(angles))
        total = total + _moved(
            rotor.body, array, receiver, turns, *_rounded(rotor.body, array, receiver, path), contrast
        )
    return total


def _carried(places, rotation, centre):
    """Where a craft at places (T, 3) carries a point of its frame (T, 3), in double precision where that can be."""
    if isinstance(places, np.ndarray) and is_concrete((rotation, centre)):
        return places + np.asarray(rotation, np.float64) @ np.asarray(centre, np.float64)
    return jnp.asarray(places) + jnp.asarray(rotation, jnp.float32) @ jnp.asarray(centre, jnp.float32)


def _rounded(body, array, receiver, places):
    """Places (T, 3) in single precision, and the phases (T, 1, 1), or (T, F, 1, 1), that rounding them took: one of the
    last bits of a kilometre is 0.01 rad at 10 GHz, another at every pulse, which spreads over all shifts.

    Where places or antennas are traced nobody knows what was rounded, and the phases are one.
    """
    single = jnp.asarray(places, jnp.float32)
    ends = array, array if receiver is None else receiver
    if not (isinstance(places, np.ndarray) and is_concrete(ends)):
        return single, jnp.ones((len(single), *(1,) * (2 if body.single else 3)), jnp.complex64)
    farther = 0.0
    for end in ends:
        centre = np.asarray(end.positions, np.float64).mean(axis=0)
        true, taken = places - centre, np.asarray(single) - centre.astype(np.float32)
        farther = farther + np.sum((true - taken) * true, axis=-1) / np.maximum(np.linalg.norm(true, axis=-1), 1e-12)
    phases = np.exp(1j * np.array([wavenumber(tone) for tone in body.frequencies_hz]) * farther[:, None])
    return single, jnp.asarray(phases[:, 0, None, None] if body.single else phases[..., None, None], jnp.complex64)


def _channel(body, array, rotation, place, contrast, receiver):
    channel = table_channel if isinstance(body, Table) else body_channel
    return channel(body, array, rotation, place, contrast, receiver=receiver)


def _check_paths(body, array, receiver, rotation, path, ends):
    """Refuse a path (T, 3) that leads out of what the body knows: at its nearest, and for a table at its farthest, and
    where it sees the antennas lowest and highest (turning about z changes none of these)."""
    for end in ends:
        away = np.asarray(end.positions, np.float64).mean(axis=0) - path
        gaps = np.linalg.norm(away, axis=-1)
        if not isinstance(body, Table):
            check_nearest(body.nearest_m, end, path[np.argmin(gaps)], "translation")
            continue
        heights = away @ np.asarray(rotation, np.float64)[:, 2] / np.maximum(gaps, 1e-12)
        for row in {each(values) for values in (gaps, heights) for each in (np.argmin, np.argmax)}:
            check_place(body, array, receiver, rotation, path[row])


def about_z(angles_rad: Float[Array, "*shape"]) -> Float[jax.Array, "*shape 3 3"]:
    """Rotations about z by angles [rad], anticlockwise seen from above."""
    vectors = jnp.asarray(angles_rad)[..., None] * jnp.array([0.0, 0.0, 1.0])
    return jnp.vectorize(rotation_from_vector, signature="(n)->(n,n)")(vectors)


@jax.jit
def _moved(body, array, receiver, turns, places, phases, contrast):
    def one(pose):
        return _channel(body, array, pose[0], pose[1], contrast, receiver) * pose[2]

    return jax.lax.map(one, (turns, places, phases), batch_size=_TOGETHER)


def doppler_spectrum(
    series: Inexact[np.ndarray, "t *rest"], interval_s: float, *, window: bool = True
) -> tuple[Float[np.ndarray, " t"], Complex[np.ndarray, "t *rest"]]:
    """The spectrum of a series of slow time over its first axis; approaching is positive.

    Args:
        series: one value a pulse (T, ...).
        interval_s: from pulse to pulse [s]; shifts beyond half of its inverse fold.
        window: Hann's, which keeps the hull's line out of the rotors'; else none.

    Returns:
        shifts (T,) [Hz], growing, and amplitudes (T, ...): a line e^{-2 pi j nu t} of amplitude 1 is 1 at nu.
    """
    series = np.asarray(series)
    count = len(_pulses("series", series, interval_s))
    weights = np.hanning(count + 2)[1:-1] if window else np.ones(count)
    weights = weights.reshape(count, *[1] * (series.ndim - 1)) / weights.sum()
    spectrum = np.fft.ifft(weights * series, axis=0) * count  # e^{+2 pi j nu t}
    return np.fft.fftshift(np.fft.fftfreq(count, interval_s)), np.fft.fftshift(spectrum, axes=0)


def range_doppler(
    channels: Inexact[np.ndarray, "t f"],
    interval_s: float,
    frequencies_hz: Sequence[float] | Float[np.ndarray, " f"],
    *,
    finer: int = 4,
) -> DopplerMap:
    """Over Doppler and range, from one entry of channels at evenly spaced tones.

    Args:
        channels: (T, F).
        interval_s: from pulse to pulse [s].
        frequencies_hz: F tones [Hz], evenly spaced, at least two.
        finer: samples a range cell of c/(2 F df).

    Returns:
        ranges from 0 to c/(2 df), beyond which they fold.

    Raises:
        ValueError: tones that are fewer or not evenly spaced.
    """
    tones = np.asarray(frequencies_hz, float)
    if np.shape(channels)[1:] != tones.shape or len(tones) < 2:
        raise ValueError(f"frequencies_hz: got {len(tones)} for channels of shape {np.shape(channels)}; give (T, F)")
    step = np.diff(tones)
    if not np.allclose(step, step[0], rtol=1e-6) or step[0] <= 0.0:
        raise ValueError("frequencies_hz: are not evenly spaced, the lowest first; take np.linspace(low, high, F)")
    shifts, spectrum = doppler_spectrum(channels, interval_s)
    weights = np.hanning(len(tones) + 2)[1:-1]
    count = finer * len(tones)
    profile = np.fft.fft(spectrum * weights / weights.sum(), n=count, axis=1)  # e^{-4 pi j f r/c}
    return DopplerMap(shifts, np.arange(count) * SPEED_OF_LIGHT / (2.0 * step[0] * count), profile)


def spectrogram(series: Inexact[np.ndarray, " t"], interval_s: float, *, window_s: float, hop_s: float) -> DopplerMap:
    """Doppler over slow time: the micro-Doppler picture.

    Args:
        series: one value a pulse (T,).
        interval_s: from pulse to pulse [s].
        window_s: length of Hann's window [s]: a fraction of a turn shows flashes, several turns show lines.
        hop_s: from window to window [s].

    Raises:
        ValueError: a window of fewer than four pulses, or longer than the series.
    """
    series = np.asarray(series)
    _pulses("series", series, interval_s)
    length, hop = round(window_s / interval_s), max(1, round(hop_s / interval_s))
    if not 4 <= length <= len(series):
        raise ValueError(f"window_s: {window_s:g} s are {length} pulses of {len(series)}; give 4 or more, at most all")
    starts = np.arange(0, len(series) - length + 1, hop)
    parts = series[starts[:, None] + np.arange(length)].T  # (length, windows)
    shifts, values = doppler_spectrum(parts, interval_s)
    return DopplerMap(shifts, (starts + 0.5 * (length - 1)) * interval_s, values)


def doppler_shift(speed_m_s: ArrayLike, frequency_hz: float) -> ArrayLike:
    """2 v/lambda [Hz] of a speed towards a monostatic radar [m/s]; of a rotor's tip 2 pi f a cos(elevation) is one."""
    return 2.0 * speed_m_s * check_frequency("frequency_hz", frequency_hz) / SPEED_OF_LIGHT


def blade_flash_rate(blades: int, rate_hz: float) -> float:
    """How often a second the echo of a rotor of equal blades repeats: blades |rate| [Hz]."""
    return blades * abs(rate_hz)


def _pulses(name: str, series: np.ndarray, interval_s: float) -> np.ndarray:
    if series.ndim == 0 or len(series) < 4:
        raise ValueError(f"{name}: got shape {series.shape}; give at least four pulses along the first axis")
    if not 0.0 < interval_s < np.inf:
        raise ValueError(f"interval_s: got {interval_s!r}; give a positive time in s")
    return series
