"""The first look at an echo: every attitude of every known craft, at the bearing of the echo, by table.

Attitudes are a lattice: thrust axes spread evenly within the tilt that is asked for, headings in steps as wide as the
axes lie apart, each axis starting elsewhere. An attitude's coefficients A about the place from which the echo comes
(:mod:`august_jax.physics.body.survey`) are compared with the echo's statistics Z = A C + N by

    min_g ||Z_j - g A C_j||^2 = ||Z_j||^2 - |<A C_j, Z_j>|^2 / ||A C_j||^2,

the complex gain g in closed form: level and phase say nothing yet. Where a craft scatters from is not where it is: a
glint on a rotor arm shifts the bearing by an arm's length. So the statistics are moved about a few places j beside the
bearing, and each attitude takes the one that suits it best. To move them costs nothing for the attitude: a craft seen
in the same way from another place has the same coefficients about that place, but for what 1/r weakens.

Several tones share the gain. With o_f = <A_f C_f, Z_f> and e_f = ||A_f C_f||^2 of the tones they leave

    min_g ||Z - g A C||^2 = ||Z||^2 - |sum_f e^{-2j(k_f - k')d} o_f|^2 / sum_f e_f

at a range that is d greater than that of the place, k' being the mean wavenumber; each attitude takes the d, too, that
suits it best. Two tones alone tell d up to a multiple of pi/(k_2 - k_1): less than 75 MHz apart they tell it within a
metre either way.

Each device of a mesh looks at attitudes of its own.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Bool, Complex, Float, Int

from august_jax.arrays import Array
from august_jax.inference.refine import two_at_once
from august_jax.mesh import ROWS, SPLIT, WHOLE, own_accelerators, placed, spread
from august_jax.physics.body.patch import fibonacci_lattice
from august_jax.physics.body.survey import SurveyTable, nearest_directions, surveyed_coefficients
from august_jax.physics.parameters import rotation_from_vector
from august_jax.scene.pose import rotation_from_axis_yaw
from august_jax.signal.roi import Subspace, change_of_centre
from august_jax.signal.station import Statistics

BLOCK = 32
"""Attitudes of one direction that are looked at together."""
_BLOCKS = 128
_ACROSS_M = tuple(0.07 * step for step in range(-6, 7))
_UPWARD_M = (-0.25, 0.0, 0.25)
_RANGES = 8
"""So many ranges are tried where the phase between the tones that are farthest apart turns once."""


class Screened(NamedTuple):
    """The candidates that explain most, best first; n of them.

    Attributes:
        craft: which of the library's (n,).
        rotation: body to world (n, 3, 3).
        position: (n, 3) [m].
        gain: of the survey's contrast (n,) complex.
        residual: min ||Z - g A C||^2, in units of the noise (n,).
    """

    craft: Int[Array, " n"]
    rotation: Float[Array, "n 3 3"]
    position: Float[Array, "n 3"]
    gain: Complex[Array, " n"]
    residual: Float[Array, " n"]


def attitude_lattice(tilt_deg: float, spacing_deg: float) -> Float[np.ndarray, "n 3 3"]:
    """Attitudes (n, 3, 3) float32, body to world, no farther apart than about ``spacing_deg`` [deg].

    Args:
        tilt_deg: largest tilt of the thrust axis [deg].
        spacing_deg: of neighbouring thrust axes, and of headings [deg].
    """
    spacing, top = math.radians(spacing_deg), 1.0 - math.cos(math.radians(tilt_deg))
    count = max(math.ceil(2.0 * math.pi * top / spacing**2), 1)
    axes = fibonacci_lattice(count, top)
    turns = math.ceil(2.0 * math.pi / spacing)
    heading = 2.0 * np.pi / turns * (np.arange(turns) + (0.618034 * np.arange(count) % 1.0)[:, None])
    every = np.repeat(axes, turns, axis=0).astype(np.float32)
    return np.asarray(
        jax.vmap(rotation_from_axis_yaw)(jnp.asarray(every), jnp.asarray(heading.reshape(-1), jnp.float32))
    )


def moved_statistics(
    statistics: Statistics, places: Float[Array, "n 3"], subspace: Subspace
) -> tuple[Complex[jax.Array, "n tones orders orders"], Complex[jax.Array, "n tones orders orders"]]:
    """Z and C (n, F, K, K) of the coefficients about other places (n, 3) [m]: with T = U^H U',  T^H Z and T^T C."""
    change = jax.vmap(lambda place: change_of_centre(statistics.centre, place, subspace))(places)
    turned = jnp.swapaxes(change, -1, -2)
    return turned.conj() @ statistics.received, turned @ statistics.pilots


def screen(
    survey: SurveyTable,
    subspace: Subspace,
    statistics: Statistics,
    place: Float[Array, "3"],
    attitudes: Float[np.ndarray, "n 3 3"],
    keep: int,
    reach_m: float = 0.0,
    *,
    mesh: Mesh | None = None,
) -> Screened:
    """The ``keep`` best of all attitudes of all craft.

    Args:
        survey: the known craft at one contrast.
        subspace: of the station.
        statistics: of one slot.
        place: from where the echo comes (3,) [m], :func:`august_jax.signal.towards`.
        attitudes: candidates, body to world (n, 3, 3).
        keep: how many to return.
        reach_m: how much nearer or farther than the place a craft may be, where several tones tell its range [m].
        mesh: devices that share the attitudes; None takes :func:`~august_jax.mesh.own_accelerators`.
    """
    mesh = own_accelerators() if mesh is None else mesh
    survey = placed(survey, mesh, WHOLE)
    place = np.asarray(place, np.float32)
    distance = np.linalg.norm(place)
    sight = place / distance
    across = np.cross(sight, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    upward = np.cross(across, sight)
    steps = np.array([(x, z) for x in _ACROSS_M for z in _UPWARD_M])
    beside = place + steps[:, :1] * across + steps[:, 1:] * upward
    beside *= distance / np.linalg.norm(beside, axis=1, keepdims=True)
    farther = _ranges(subspace, reach_m)
    together = _BLOCKS * mesh.size
    direction, rows, real = _blocks(nearest_directions(survey, 0, -sight @ attitudes), together)
    crafts = survey.directions.shape[0]

    def compared(piece: slice) -> tuple[jax.Array, ...]:
        return _compared(
            mesh,
            survey,
            subspace,
            statistics,
            jnp.asarray(place),
            jnp.asarray(beside, jnp.float32),
            jnp.asarray(farther, jnp.float32),
            jnp.asarray(direction[piece]),
            jnp.asarray(attitudes[rows[piece]]),
        )

    pieces = [slice(start, start + together) for start in range(0, len(direction), together)]
    residual, which, far, gain = (
        np.concatenate(parts, axis=1) for parts in zip(*two_at_once(compared, pieces), strict=True)
    )
    residual = np.where(real, residual, np.inf)
    best = np.argpartition(residual.ravel(), min(keep, residual.size - 1))[:keep]
    best = best[np.argsort(residual.ravel()[best])]
    craft, block, row = np.unravel_index(best, residual.shape)
    assert len(residual) == crafts
    chosen = which[craft, block, row]
    turn = np.cross(sight, beside[chosen] / distance)  # small: the craft is seen from there as it was from here
    seen = attitudes[rows[block, row]]
    return Screened(
        craft.astype(np.int32),
        np.asarray(jax.vmap(rotation_from_vector)(jnp.asarray(turn, jnp.float32))) @ seen,
        (beside[chosen] * (1.0 + farther[far[craft, block, row]] / distance)[:, None]).astype(np.float32),
        gain[craft, block, row],
        residual[craft, block, row].astype(np.float32),
    )


def _ranges(subspace: Subspace, reach_m: float) -> Float[np.ndarray, " n"]:
    """By how much nearer or farther a craft is looked for [m]; not at all where a single tone tells nothing of it."""
    widest = float(np.ptp(subspace.wavenumbers))
    steps = math.ceil(reach_m * widest * _RANGES / math.pi)
    return reach_m * np.linspace(-1.0, 1.0, 2 * steps + 1) if steps else np.zeros(1)


def _blocks(
    direction: Int[np.ndarray, " n"], together: int
) -> tuple[Int[np.ndarray, " blocks"], Int[np.ndarray, "blocks size"], Bool[np.ndarray, "blocks size"]]:
    """Blocks of rows that share a direction, a multiple of ``together``: the direction, the rows, and which of them are
    not there to fill up."""
    order = np.argsort(direction, kind="stable")
    named, start, count = np.unique(direction[order], return_index=True, return_counts=True)
    blocks = -(-count // BLOCK)
    total = int(blocks.sum())
    first = np.repeat(start, blocks) + BLOCK * (np.arange(total) - np.repeat(np.cumsum(blocks) - blocks, blocks))
    end = np.repeat(start + count, blocks)[:, None]
    rows = first[:, None] + np.arange(BLOCK)
    real = rows < end
    spare = -total % together  # one shape, one compilation
    direction = np.pad(np.repeat(named, blocks), (0, spare)).astype(np.int32)
    rows = np.pad(order[np.minimum(rows, end - 1)], ((0, spare), (0, 0)))
    return direction, rows, np.pad(real, ((0, spare), (0, 0)))


@partial(jax.jit, static_argnames=("mesh", "subspace"))
def _compared(mesh, survey, subspace, *others):
    """:func:`_looked_at`, by each device of its blocks."""

    def own(survey, *others):
        return _looked_at(survey, subspace, *others)

    return spread(own, mesh, (*[WHOLE] * 5, SPLIT, SPLIT), PartitionSpec(None, ROWS))(survey, *others)


def _looked_at(survey, subspace, statistics, place, beside, farther, direction, attitudes):
    """Residual, best place beside, best range and gain of each craft's blocks (C, blocks, BLOCK)."""
    received, pilots = moved_statistics(statistics, beside, subspace)
    count, orders = len(beside), received.shape[-1]
    adjoint = jnp.swapaxes(pilots.conj(), -1, -2)
    matched = (received @ adjoint).reshape(count, -1, orders**2)
    grams = (pilots @ adjoint).reshape(count, -1, orders**2)
    whole = jnp.sum(jnp.abs(received) ** 2, axis=(1, 2, 3))
    # <A, Z C^H> = sum of conj(A) times it, and ||A C||^2 = tr(C C^H A^H A), as real products over all places at once
    inner = jnp.concatenate(
        [
            jnp.concatenate([matched.real, matched.imag], axis=-1),
            jnp.concatenate([matched.imag, -matched.real], axis=-1),
        ]
    )
    norms = jnp.concatenate([grams.real, -grams.imag], axis=-1)
    apart = jnp.asarray(subspace.wavenumbers - subspace.wavenumbers.mean())
    turns = 2.0 * apart[:, None] * (jnp.linalg.norm(place) + farther)

    def look(each):
        craft, towards, rotations = each
        found = surveyed_coefficients(survey, subspace.array, subspace.basis, place, craft, towards, rotations)
        energies = jnp.zeros((BLOCK, count, 1))
        overlaps = crosses = jnp.zeros((BLOCK, count, len(farther)))  # over tones, in phase and across
        for tone, values in enumerate(found):
            real, imag = values.real, values.imag
            flat = jnp.concatenate([real.reshape(BLOCK, -1), imag.reshape(BLOCK, -1)], axis=1)
            overlap = flat @ inner[:, tone].T
            side = jnp.concatenate([real, imag], axis=1)
            square = jnp.swapaxes(side, 1, 2) @ side
            crossed = jnp.swapaxes(real, 1, 2) @ imag
            crossed = jnp.swapaxes(crossed, 1, 2) - crossed
            energy = jnp.concatenate([square.reshape(BLOCK, -1), crossed.reshape(BLOCK, -1)], axis=1) @ norms[:, tone].T
            one, other = jnp.split(overlap[:, :, None], 2, axis=1)
            cosine, sine = jnp.cos(turns[tone]), jnp.sin(turns[tone])
            energies += energy[:, :, None]
            overlaps += cosine * one + sine * other
            crosses += cosine * other - sine * one
        residual = (whole[:, None] - (overlaps**2 + crosses**2) / energies).reshape(BLOCK, -1)
        chosen = jnp.argmin(residual, axis=1)
        picked = jnp.arange(BLOCK), chosen
        gain = (jax.lax.complex(overlaps, crosses) / energies).reshape(BLOCK, -1)[picked]
        which, far = jnp.divmod(chosen.astype(jnp.int32), len(farther))
        return residual[picked], which, far, gain

    def craft(number):
        return jax.lax.map(lambda each: look((number, *each)), (direction, attitudes))

    return jax.lax.map(craft, jnp.arange(survey.directions.shape[0]))
