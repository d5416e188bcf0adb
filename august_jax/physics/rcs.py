r"""Scattering matrix and radar cross-section of a craft: what it sends back of a plane wave.

Under e^{-jwt} a plane wave of unit field p that comes from the direction t (unit vector from the craft to the
transmitter) is p e^{-jk t.r} in the craft's frame. Far away, in the direction u, the scattered field is
e^{jkr}/r times F, with

    q.F = (k^2/4 pi) sum_n q e^{-jk u.r_n} . D_n E_n = (1/4 pi) k^2 E'_q^T P,

E_n the total field and D_n the polarisability of cell n, E'_q the plane wave q e^{-jk u.r} in cells: the bilinear form
of :mod:`august_jax.physics.mom` with plane waves in the place of the antennas' fields. So it is reciprocal, and a
factored body answers it as it answers antennas. Power per solid angle over the power per area of the wave is |q.F|^2;
a radar cross-section is 4 pi times it (IEEE Std 686). The scattering matrix holds

    S_qp = sqrt(4 pi) q.F [m],    sigma_qp = |S_qp|^2 [m^2],

for q and p of the horizontal and the vertical of the receiver's and of the transmitter's direction: the unit vectors of
growing azimuth and of growing elevation. (Knott, Shaeffer and Tuley, Radar Cross Section, chapter 3.)

A channel says the same of an antenna far away: a dipole of moment p at t r sends (e^{jkr}/4 pi r) p e^{-jk t.r'} to the
place r' near the craft, so that H = e^{jk(r_t + r_r)} q.F/(4 pi r_t r_r): :func:`seen_from`. A table, which knows
antennas up to a distance, answers by it: what two crossed dipoles there see.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, wavenumber
from august_jax.physics.body.body import Body, in_modes, judge_contrast
from august_jax.physics.body.table import Table, check_contrast_range, table_channel
from august_jax.physics.cells import Cells
from august_jax.physics.checks import (
    check_cells,
    check_contrast,
    check_frequency,
    edges_and_fills,
    is_concrete,
    settled,
    settled_cells,
    warn_of_coarse_cells,
)
from august_jax.physics.mom import interaction_matrix, solve_dense, weighted_fields

POLARISATIONS = ("H", "V")
"""Of rows (received) and columns (sent) of a scattering matrix."""
_TOGETHER = 128


def looking(azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> Float[jax.Array, "*shape 3"]:
    """Unit vectors from the craft towards azimuths and elevations [degrees] in its frame: x ahead, z up."""
    azimuth, elevation = jnp.broadcast_arrays(jnp.deg2rad(azimuth_deg), jnp.deg2rad(elevation_deg))
    flat = jnp.cos(elevation)
    return jnp.stack([flat * jnp.cos(azimuth), flat * jnp.sin(azimuth), jnp.sin(elevation)], axis=-1)


def polarisations(directions: Float[Array, "*shape 3"]) -> Float[jax.Array, "*shape 2 3"]:
    """The horizontal and the vertical of directions: growing azimuth, growing elevation; at a pole azimuth 0 is
    meant."""
    x, y, z = jnp.moveaxis(jnp.asarray(directions), -1, 0)
    flat = jnp.hypot(x, y)
    pole = flat < 1e-7
    safe = jnp.where(pole, 1.0, flat)
    cosine, sine = jnp.where(pole, 1.0, x / safe), jnp.where(pole, 0.0, y / safe)
    horizontal = jnp.stack([-sine, cosine, jnp.zeros_like(z)], axis=-1)
    vertical = jnp.stack([-z * cosine, -z * sine, flat], axis=-1)
    return jnp.stack([horizontal, vertical], axis=-2)


def scattering_matrix(
    craft: Body | Table | Cells,
    receive: Float[Array, "looks 3"],
    contrast: ArrayLike,
    *,
    transmit: Float[Array, "looks 3"] | Float[Array, "3"] | None = None,
    frequency_hz: float | None = None,
) -> Complex[jax.Array, "*tones looks 2 2"]:
    """S [m] of a craft, for each direction of the receiver.

    Args:
        craft: a factored body; a table, the fastest, which says what antennas at its farthest distance r see, for a
            craft of the size D some D^2/(wavelength r) from plane waves; or, for a coupled solve of its own, cells (N
            of them cost N^3).
        receive: unit vectors from the craft to the receiver, in the craft's frame (D, 3).
        contrast: chi, scalar; of a body or a table of F tones also (F,), of cells also (N,), one value a cell.
        transmit: to the transmitter (D, 3) or (3,); None is where the receiver is (monostatic).
        frequency_hz: of cells; a body or a table has its own.

    Returns:
        (D, 2, 2), or (F, D, 2, 2) for a body of several tones; complex64. Rows receive H and V, columns send H and V.
        Differentiable in directions and contrast.

    Raises:
        ValueError: directions that are not finite or no unit vectors, a contrast of another shape, a frequency where
            none belongs or none where one does, malformed cells; what lies outside a table's range, or a stack of
            tables.

    Warns as :func:`body_channel` does of contrasts that cells or the reduction are not made for.
    """
    receive = _directions("receive", receive)
    if receive.ndim != 2 or not len(receive):
        raise ValueError(f"receive: got shape {receive.shape}; give unit vectors (D, 3), one or more")
    ways = (receive,)  # one where both ends are
    if transmit is not None:
        ways += (jnp.broadcast_to(_directions("transmit", transmit), receive.shape),)
    of_cells = isinstance(craft, Cells)
    values = craft.count if isinstance(craft, Cells) else len(craft.frequencies_hz)
    check_contrast(contrast, ((), (values,)), f"a scalar or ({values},), one value a {'cell' if of_cells else 'tone'}")
    chi = settled("contrast", contrast)
    if not isinstance(craft, Cells):
        if frequency_hz is not None:
            raise ValueError(
                f"frequency_hz: got {frequency_hz:g}; a body has its own, {craft.frequencies_hz}: leave it out"
            )
        if isinstance(craft, Table):
            check_contrast_range(craft, contrast)
            _check_ways(craft, ways)
            return _of_table(craft, ways, chi)
        if is_concrete(contrast):
            judge_contrast(craft, contrast)
        return _of_body(craft, ways, chi)
    if frequency_hz is None:
        raise ValueError("frequency_hz: got None; cells need the frequency [Hz] that they are asked at")
    k = wavenumber(check_frequency("frequency_hz", frequency_hz))
    check_cells(craft)
    if is_concrete((craft, contrast)):
        warn_of_coarse_cells(*edges_and_fills(craft), contrast, k)
    return _of_cells(settled_cells(craft), ways, chi, k)


def dbsm(matrix: Inexact[Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Radar cross-section [dB over 1 m^2] of entries of a scattering matrix [m]; no less than -300."""
    return 20.0 * jnp.log10(jnp.maximum(jnp.abs(matrix), 1e-15))


def seen_from(
    channel: Complex[Array, "*shape"], receive_m: ArrayLike, transmit_m: ArrayLike, frequency_hz: float
) -> Complex[jax.Array, "*shape"]:
    """The entries of S [m] that channels [1/m] of antennas so far away [m] say.

    They are those of plane waves only far away, beyond about 2 D^2/wavelength for a craft of the size D. Moments that
    are not across the line of sight count with the part that is.
    """
    there, back = np.asarray(transmit_m, np.float64), np.asarray(receive_m, np.float64)  # a path of many turns
    factor = (4.0 * np.pi) ** 1.5 * there * back * np.exp(-1j * wavenumber(frequency_hz) * (there + back))
    return channel * jnp.asarray(factor, jnp.complex64)


def _directions(name: str, directions):
    found = settled(name, directions)
    if found.shape[-1:] != (3,) or found.ndim not in (1, 2):
        raise ValueError(f"{name}: got shape {found.shape}; give unit vectors (D, 3)")
    if is_concrete(found):
        lengths = np.linalg.norm(np.asarray(found), axis=-1).ravel()
        off = np.nan_to_num(np.abs(lengths - 1.0), nan=np.inf)
        if np.any(off >= 1e-3):
            raise ValueError(
                f"{name}: got a vector of length {lengths[off.argmax()]:g}; give unit vectors from the craft"
            )
    return found


def _check_ways(table, ways):
    """Refuse a stack, and what the table does not know of where its antennas would stand."""
    if np.ndim(table.directions) == 3:
        raise ValueError(
            "craft: the table is a stack of several; take one, e.g. jax.tree.map(lambda part: part[0], it)"
        )
    if not is_concrete(ways):
        return
    there, back = (np.asarray(way, np.float64) for way in (ways[0], ways[-1]))
    half = np.degrees(np.arcsin(np.clip(0.5 * np.linalg.norm(there - back, axis=-1), 0.0, 1.0))).max(initial=0.0)
    if half > np.degrees(table.angle) + 0.1:
        raise ValueError(
            f"transmit: stands {2.0 * half:.3g} degrees from the receiver as the craft sees it; the table holds "
            f"{2.0 * np.degrees(table.angle):.3g}; give a factored body"
        )
    middle = there + back
    elevation = np.degrees(np.arcsin(np.clip(middle[:, 2] / np.linalg.norm(middle, axis=-1), -1.0, 1.0)))
    low, high = table.elevation_deg
    outside = (elevation < low - 0.1) | (elevation > high + 0.1)
    if np.any(outside):
        raise ValueError(
            f"receive: is at an elevation of {elevation[outside][0]:.3g} degrees; the table holds {low:g} to {high:g}; "
            "tabulate for more (elevation_deg), or give a factored body"
        )


def _plane_waves(points, directions, k):
    """Fields (3 P, 2 D) at points (P, 3) of unit waves from directions (D, 3), H and V of each in turn."""
    phase = jnp.exp(-1j * k * (points @ directions.T))
    fields = jnp.einsum("pd,dac->pcda", phase, polarisations(directions).astype(phase.dtype))
    return fields.reshape(-1, 2 * directions.shape[0])


def _blocks(heard, right, looks):
    """The 2 x 2 blocks of each look with itself, of (K, 2 D) fields."""
    heard, right = (part.reshape(-1, looks, 2) for part in (heard, right))
    return jnp.einsum("nda,ndb->dab", heard, right)


@jax.jit
def _of_body(body, ways, contrast):
    contrasts = jnp.broadcast_to(contrast, (len(body.frequencies_hz),)).astype(jnp.complex64)
    found = []
    for tone, frequency in enumerate(body.frequencies_hz):
        k = wavenumber(frequency)
        chi = contrasts[tone]
        gain = (k**2 / np.sqrt(4.0 * np.pi)) * chi / (1.0 - chi * body.eigenvalues[tone])

        def looked(ways, tone=tone, k=k, gain=gain):
            waves = [_plane_waves(body.points[tone], way.astype(jnp.float32), k)[body.rows[tone]] for way in ways]
            modal = [in_modes(body, tone, each) for each in waves]
            return _blocks(modal[0], gain[:, None] * modal[-1], ways[0].shape[0])

        found.append(_in_blocks(looked, ways))
    return found[0] if body.single else jnp.stack(found)


@jax.jit
def _of_table(table, ways, contrast):
    """What two crossed dipoles at the table's farthest distance see."""
    far = table.distance_m[1]

    def crossed(towards):
        places = jnp.broadcast_to(far * towards, (2, 3))
        return AntennaArray(places, polarisations(towards), table.frequencies_hz[0])

    def look(ends):
        receiver = crossed(ends[0]) if len(ends) == 2 else None
        H = table_channel(table, crossed(ends[-1]), jnp.eye(3), jnp.zeros(3), contrast, receiver=receiver)
        tones = H[None] if table.single else H
        return jnp.stack([seen_from(each, far, far, f) for each, f in zip(tones, table.frequencies_hz, strict=True)])

    ways = tuple(way.astype(jnp.float32) for way in ways)
    found = jnp.moveaxis(jax.lax.map(look, ways, batch_size=_TOGETHER), 0, 1)
    return found[0] if table.single else found


@partial(jax.jit, static_argnums=3)
def _of_cells(cells, ways, contrast, k):
    places = jnp.asarray(cells.sites())
    middle = jnp.mean(places, axis=0)
    place = places - middle
    matrix = interaction_matrix(cells, k)

    # about the middle, whose phases come last: small numbers keep their digits
    waves = [weighted_fields(cells, _plane_waves(place, way, k)) for way in ways]
    blocks = _blocks(waves[0], solve_dense(matrix, contrast, waves[-1]).polarization, ways[0].shape[0])
    phase = jnp.exp(-1j * k * ((ways[0] + ways[-1]) @ middle))
    return (k**2 / np.sqrt(4.0 * np.pi) * blocks * phase[:, None, None]).astype(jnp.complex64)


def _in_blocks(looked, ways):
    """A function of so many looks at once, over all of them."""
    count = ways[0].shape[0]
    each = min(_TOGETHER, count)
    groups = -(-count // each)
    ways = [jnp.pad(way, ((0, groups * each - count), (0, 0)), mode="edge").reshape(groups, each, 3) for way in ways]
    return jax.lax.map(looked, tuple(ways)).reshape(groups * each, 2, 2)[:count]
