"""Many attitudes of tabulated bodies at one place: what a search asks first.

With the place fixed, and with it the field subspace U about it (:mod:`august_jax.signal.roi`), much of a channel of
:mod:`august_jax.physics.body.table` is the same for all attitudes or drops out. The spherical waves diag(w) and the
phases of U are one and the same, so that the coefficients

    A = U^H H conj(U) = e^{2jk|q|} E X M X^T E^T,    E = P^T diag(1/r) S    (K, n) real,

need real factors alone beside M. The contrast is that of the whole survey, so that M is no mixture of nodes; 1/r hardly
changes over the array, so that the functions of it are numbers; and attitudes that see the antennas in the same
direction of the grid share V and M. The last is why they come in blocks: rows of one craft and one direction.

The global phase e^{2jk|q|} is left out, and how the bend of the wave differs over the antennas' distances: half a per
cent of a channel at 6 m, less than the table's own error at its worst.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import PlanarArray
from august_jax.physics.body.patch import Patch
from august_jax.physics.body.table import Table, aperture_of, interpolation

__all__ = ["SurveyTable", "nearest_directions", "survey_table", "surveyed_coefficients"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SurveyTable:
    """Tables of C craft at one contrast; a pytree.

    Attributes:
        directions: as of the tables (C, D, 3).
        axes: (C, D, 3, 3).
        functions: V (C, F, D, functions, R).
        responses: real and imaginary part of M at the contrast (C, F, D, 2, R, R).
        patch, frequencies_hz, radius_m, nearest_m: as of the tables; the last is the nearest antenna [m].
    """

    directions: Float[Array, "craft d 3"]
    axes: Float[Array, "craft d 3 3"]
    functions: Float[Array, "craft f d n r"]
    responses: Float[Array, "craft f d 2 r r"]
    patch: Patch = field(metadata={"static": True})
    frequencies_hz: tuple[float, ...] = field(metadata={"static": True})
    radius_m: float = field(metadata={"static": True})
    nearest_m: float = field(metadata={"static": True})


def survey_table(table: Table, contrast: ArrayLike, *, axes: int | None = None) -> SurveyTable:
    """A stack of tables at one contrast.

    Args:
        table: of :func:`august_jax.physics.stack_tables`.
        contrast: chi, scalar or one a tone (F,).
        axes: how many of the principal axes to keep, the strongest; None keeps all.
    """
    tones = len(table.frequencies_hz)
    kept = table.functions.shape[-1] if axes is None else min(axes, table.functions.shape[-1])
    weights = jnp.stack(
        [interpolation(table.nodes, each) for each in jnp.broadcast_to(jnp.asarray(contrast, jnp.complex64), (tones,))]
    )
    responses = table.responses[..., -kept:, -kept:]  # the weakest come first
    real, imag = (jnp.einsum("fn,cfdnprs->cfdprs", part, responses) for part in (weights.real, weights.imag))
    mixed = jnp.stack([real[:, :, :, 0] - imag[:, :, :, 1], real[:, :, :, 1] + imag[:, :, :, 0]], axis=3)
    return SurveyTable(
        table.directions,
        table.axes,
        table.functions[..., -kept:],
        mixed,
        table.patch,
        table.frequencies_hz,
        table.radius_m,
        table.reach_m[0],
    )


def nearest_directions(survey: SurveyTable, craft: int, towards: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Which direction of the grid is nearest to each of n directions (n, 3) in the body's frame."""
    return np.argmax(np.asarray(towards, np.float32) @ np.asarray(survey.directions[craft]).T, axis=1)


def surveyed_coefficients(
    survey: SurveyTable,
    array: PlanarArray,
    basis: Float[np.ndarray, "antennas orders"],
    place: Float[Array, "3"],
    craft: Int[Array, ""],
    direction: Int[Array, ""],
    rotations: Float[Array, "block 3 3"],
) -> Complex[jax.Array, "tones block orders orders"]:
    """Coefficients A of a block of attitudes (F, B, K, K) complex64, but for the phase e^{2jk|q|} of the place.

    Args:
        survey: from :func:`survey_table`.
        array: the antennas.
        basis: P (N_b, K) of the subspace.
        place: q (3,) [m], of all.
        craft, direction: which craft and which direction of its grid, of all.
        rotations: body to world (B, 3, 3).
    """
    found, distance = [], jnp.linalg.norm(place)
    for tone, frequency in enumerate(survey.frequencies_hz):
        chosen, spread = aperture_of(array, frequency, survey.radius_m, survey.nearest_m)
        distances = jnp.linalg.norm(place - jnp.asarray(array.positions, jnp.float32), axis=1)
        narrowed = jnp.asarray(basis).T @ (jnp.asarray(spread, jnp.float32) / distances[:, None])
        functions = survey.patch.at_distance(survey.functions[craft, tone, direction], distance)
        turned = rotations @ survey.axes[craft, direction].T
        elements = jnp.asarray(array.positions[chosen], jnp.float32)
        away = (elements - place) / distances[chosen][:, None]
        unit = jnp.einsum("nk,bkj->bnj", away, turned)
        moments = jnp.einsum("nk,bkj->bnj", jnp.asarray(array.moments[chosen], jnp.float32), turned)
        unit, moments = unit.reshape(-1, 3), moments.reshape(-1, 3)
        phi = survey.patch.flat.functions(distance * unit, jnp.full(len(unit), distance), moments)
        fields = (phi @ functions).reshape(len(rotations), len(chosen), -1)
        fields = jnp.einsum("kn,bnr->bkr", narrowed, fields)
        response = survey.responses[craft, tone, direction]
        both = fields @ jnp.concatenate([response[0], response[1]], axis=1)
        real, imag = jnp.split(both, 2, axis=-1)
        across = jnp.swapaxes(fields, 1, 2)
        found.append(jax.lax.complex(real @ across, imag @ across))
    return jnp.stack(found)
