"""A body's scattering in a table: a channel is a product of matrices as small as the antennas see of it.

From the body an array fills a small patch of directions, in which the fields of its elements on the body are few
functions phi of where they stand (:mod:`august_jax.physics.body.patch`). So the factored body's

    H = k^2 F^T diag(chi / (1 - chi lambda)) F,    F = C Phi^T diag(w),    w_n = e^{j k r_n}/r_n,

needs the body through one small symmetric matrix T = k^2 C^T diag(chi/(1 - chi lambda)) C for each direction of a
grid over the sphere and for each contrast. Of its functions few matter in any one direction: V (functions, R) real,
the common principal axes of T at all contrasts that are tabulated, leaves M = V^T T V, and

    H = diag(w) X M X^T diag(w),    X = Phi V.

Between contrasts M is interpolated by polynomials of y = chi/(chi + 12), with M(0) = 0 a node that costs nothing: a
thin skin answers as chi/(1 + c chi) with a small c. Polynomials in chi itself err five times more.

X varies slowly over a planar array: X = S X_S of a few of its elements (:mod:`august_jax.physics.body.aperture`), so
that H = L (X_S M X_S^T) L^T, L = diag(w) S, and any combinations C of the antennas, C H C^T, have C L in place of L.
This is why :func:`table_channel` takes them (``combine``) in place of giving H to be multiplied: a region's
coefficients then cost less than the channel, no matrix of N_b x N_b numbers is made, and the order of the products
stays here. Products of complex matrices are written as real ones, which XLA multiplies three times faster on a CPU.

Conventions are those of :func:`august_jax.physics.body_channel`; :func:`august_jax.physics.tabulate` makes tables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int, Real

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body.aperture import sampled_fields
from august_jax.physics.body.patch import Patch
from august_jax.physics.body.spans import pivots, spanned
from august_jax.physics.checks import check_contrast, check_pose, is_concrete, settled
from august_jax.physics.green import inner, path_difference

_APERTURE = 1e-4  # smallest singular value kept of the fields over an aperture, relative to the largest
_SKIN = 12.0  # of the variable chi/(chi + 12) in which contrasts are interpolated
_EDGE = 1e-3  # relative: what rounding may put beyond a range


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Table:
    """A tabulated body; a pytree. Several of equal static parts stack (:func:`stack_tables`): a leading axis of craft.

    Attributes:
        directions: u_g, unit vectors in the body's frame (D, 3).
        axes: e1, e2 and u_g, row by row (D, 3, 3).
        functions: V (F, D, functions, R), float32.
        responses: Re M, Im M of the nodes (F, D, nodes, 2, R, R), float32, symmetric.
        errors: median and 95 % point of the relative error against :func:`body_channel`, of each tone (F, 2): of the
            array that the table was made for, in random poses all about it, distances and contrasts of the whole range.
        patch: the functions.
        frequencies_hz: the tones [Hz].
        single: True where the body was made for one plain frequency, so that channels carry no tone axis.
        nodes: the tabulated contrasts.
        distance_m: nearest and farthest body, from its origin to the middle of the antennas [m].
        extent_m: largest distance of an antenna from their middle [m].
        contrast: range of the real part of chi.
        loss: largest imaginary part of chi.
        elevation_deg: range of the elevation of the antennas' middle as the body sees it, over its x-y plane [deg].
        radius_m: largest radius of the tabulated bodies [m].
    """

    directions: Float[Array, "*craft d 3"]
    axes: Float[Array, "*craft d 3 3"]
    functions: Float[Array, "*craft f d n r"]
    responses: Float[Array, "*craft f d nodes 2 r r"]
    errors: Float[Array, "*craft f 2"]
    patch: Patch = field(metadata={"static": True})
    frequencies_hz: tuple[float, ...] = field(metadata={"static": True})
    single: bool = field(metadata={"static": True})
    nodes: tuple[complex, ...] = field(metadata={"static": True})
    distance_m: tuple[float, float] = field(metadata={"static": True})
    extent_m: float = field(metadata={"static": True})
    contrast: tuple[float, float] = field(metadata={"static": True})
    loss: float = field(metadata={"static": True})
    elevation_deg: tuple[float, float] = field(metadata={"static": True})
    radius_m: float = field(metadata={"static": True})

    @property
    def angle(self) -> float:
        """Largest angle at which the body may see an antenna from the antennas' middle [rad]."""
        return math.asin(min(self.extent_m / self.distance_m[0], 1.0))

    @property
    def reach_m(self) -> tuple[float, float]:
        """Nearest and farthest antenna, from the body's origin [m]."""
        return self.distance_m[0] - self.extent_m, self.distance_m[1] + self.extent_m


def stack_tables(tables: Sequence[Table]) -> Table:
    """Tables of several craft as one, with a leading axis; for ``craft`` of :func:`table_channel`, or ``jax.vmap``.

    Raises:
        ValueError: none, or tables of different ranges or sizes; :func:`tabulate_bodies` makes them alike.
    """
    if (
        len({jax.tree.structure(table) for table in tables}) != 1
        or len({tuple(leaf.shape for leaf in jax.tree.leaves(table)) for table in tables}) != 1
    ):
        raise ValueError(
            f"tables: got {len(tables)} of different ranges or sizes; make them together, with tabulate_bodies"
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tables)


def table_channel(
    table: Table,
    array: PlanarArray | AntennaArray,
    rotation: Real[Array, "3 3"],
    translation: Real[Array, "3"],
    contrast: ArrayLike | Sequence,
    *,
    receiver: PlanarArray | AntennaArray | None = None,
    combine: Complex[Array, "*each combined antennas"] | tuple[Array, Array] | None = None,
    craft: int | Int[Array, ""] | None = None,
) -> Complex[jax.Array, "*tones receive transmit"]:
    """Sensing channel of a tabulated body in a pose: :func:`august_jax.physics.body_channel` but for ``table.errors``.

    Args:
        table: from :func:`august_jax.physics.tabulate`.
        array: the antennas, transmitting and, without ``receiver``, receiving.
        rotation: body axes to world axes (3, 3).
        translation: origin of the body's frame in the world (3,) [m].
        contrast: chi, scalar; with several tones also (F,).
        receiver: the antennas that receive, where they are not those that transmit; of the same carrier. The body must
            see both ends in one patch.
        combine: C (K, N_b), or (F, K, N_b) tone by tone: what is wanted is C H C^T, for example the coefficients
            U^H H conj(U) of a region by C = U^H. With ``receiver`` a pair, of receiving and of transmitting antennas.
        craft: which table of a stack.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b) for a body of several tones; complex64, exactly symmetric without
        ``receiver``; rows receive, columns transmit. With ``combine`` (K, K) in its place. Differentiable in rotation,
        translation, contrast, ``combine`` and an :class:`AntennaArray`, but for steps of the size of the table's error
        where the nearest direction of its grid changes; ``jax.vmap`` over them makes batches, on a CPU best of 64 to
        256: of more the results no longer fit its caches (``jax.lax.map`` with a ``batch_size`` makes longer ones).

    Raises:
        ValueError: mismatched shapes, numbers that are not finite, a matrix that is no rotation, ends of different
            carriers, an array whose carrier lies outside the band of the tones by more than a tenth; a contrast,
            distances, an extent or an elevation outside the table's range. Traced numbers are not looked at: outside
            the range polynomials grow without bound.
    """
    check_pose(table.frequencies_hz, array, receiver, rotation, translation)
    tones = len(table.frequencies_hz)
    check_contrast(contrast, ((), (tones,)), f"a scalar or ({tones},), one value a tone")
    _check_craft(table, craft)
    check_contrast_range(table, contrast)
    check_place(table, array, receiver, rotation, translation)
    combined = _checked_combine(combine, array, receiver, tones)
    return _table_channel(
        table,
        array,
        receiver,
        settled("rotation", rotation),
        settled("translation", translation),
        settled("contrast", contrast),
        combined,
        craft,
    )


def _check_craft(table, craft):
    stacked = np.ndim(table.directions) == 3
    if stacked != (craft is not None):
        raise ValueError(
            "craft: the table is a stack of several craft; say which, or vmap over them"
            if stacked
            else f"craft: got {craft!r}, but the table is of one craft alone; leave it out"
        )
    if stacked and is_concrete(craft) and not 0 <= int(craft) < len(table.directions):
        raise ValueError(f"craft: got {craft}; the table holds craft 0 to {len(table.directions) - 1}")


def check_contrast_range(table: Table, contrast: ArrayLike | Sequence) -> None:
    """Refuse concrete contrasts that a table does not hold.

    Raises:
        ValueError: one is out of range.
    """
    if not is_concrete(contrast):
        return
    values = np.ravel(contrast)
    low, high = table.contrast
    slack = _EDGE * high
    outside = (values.real < low - slack) | (values.real > high + slack) | (np.abs(values.imag) > table.loss + slack)
    if np.any(outside):
        raise ValueError(
            f"contrast: got {complex(values[outside][0]):.3g}; the table holds {low:g} to {high:g}, with "
            f"an imaginary part up to {table.loss:g}; tabulate for more, or take body_channel"
        )


def check_place(table: Table, array, receiver, rotation, translation) -> None:
    """Refuse a concrete pose from which a table does not hold what antennas see.

    Raises:
        ValueError: distances, an extent or an elevation out of range.
    """
    if not is_concrete((array, receiver, translation)):
        return
    places = np.concatenate([np.asarray(end.positions, np.float64) for end in (array, receiver) if end is not None])
    away = places - np.asarray(translation, np.float64)
    distances = np.linalg.norm(away, axis=1)
    near, far = table.reach_m
    if distances.min() < near * (1.0 - _EDGE) or distances.max() > far * (1.0 + _EDGE):
        raise ValueError(
            f"translation: the body is {distances.min():.3g} to {distances.max():.3g} m from the antennas; the table "
            f"holds {near:.3g} to {far:.3g} m; tabulate for another distance_m, or take body_channel"
        )
    middle = away.mean(axis=0)
    middle /= np.linalg.norm(middle)
    cross = np.linalg.norm(np.cross(away / distances[:, None], middle), axis=1).max()
    if cross > np.sin(table.angle) * (1.0 + _EDGE) or np.any(away @ middle < 0.0):
        raise ValueError(
            f"array: the body sees antennas {np.degrees(np.arcsin(min(cross, 1.0))):.3g} degrees from their middle; "
            f"the table holds {np.degrees(table.angle):.3g}, antennas within {table.extent_m:.3g} m at "
            f"{table.distance_m[0]:g} m; tabulate for that array, or take body_channel"
        )
    if table.elevation_deg != (-90.0, 90.0) and is_concrete(rotation):
        elevation = np.degrees(np.arcsin(np.clip(middle @ np.asarray(rotation, np.float64)[:, 2], -1.0, 1.0)))
        low, high = table.elevation_deg
        if not low - 0.1 <= elevation <= high + 0.1:
            raise ValueError(
                f"rotation: the body sees the antennas at an elevation of {elevation:.3g} degrees; the "
                f"table holds {low:g} to {high:g}; tabulate for more (elevation_deg), or take "
                "body_channel"
            )


def _checked_combine(combine, array, receiver, tones):
    """(receive, transmit) matrices, of each tone (F, K, N); None where there are none."""
    if combine is None:
        return None
    pair = isinstance(combine, tuple)
    if pair == (receiver is None) or (pair and len(combine) != 2):
        raise ValueError("combine: give one matrix, or with receiver a pair, of receiving and of transmitting antennas")
    found = []
    for matrix, end in zip(combine if pair else (combine,), (receiver, array) if pair else (array,), strict=True):
        shape = np.shape(matrix)
        if shape[-1:] != (end.count,) or shape[:-2] not in ((), (tones,)) or len(shape) < 2:
            raise ValueError(f"combine: got shape {shape}; give (K, {end.count}) or ({tones}, K, {end.count})")
        found.append(jnp.broadcast_to(jnp.asarray(matrix, jnp.complex64), (tones, *shape[-2:])))
    return tuple(found) if pair else (found[0], found[0])


@jax.jit
def _table_channel(table, array, receiver, rotation, translation, contrast, combined, craft):
    rotation, translation = rotation.astype(jnp.float32), translation.astype(jnp.float32)
    ends = (array,) if receiver is None else (receiver, array)
    places = [jnp.asarray(end.positions, jnp.float32) for end in ends]
    middle = jnp.mean(jnp.concatenate(places), axis=0) - translation
    which = () if craft is None else (craft,)
    direction = nearest(table.directions[which], jax.lax.stop_gradient(middle @ rotation))
    axes = table.axes[*which, direction] @ rotation.T
    contrasts = jnp.broadcast_to(contrast, (len(table.frequencies_hz),)).astype(jnp.complex64)
    channels = []
    for tone, frequency in enumerate(table.frequencies_hz):
        weights = interpolation(table.nodes, contrasts[tone])
        nodes = table.responses[*which, tone, direction]
        parts = jnp.stack([weights.real, weights.imag]) @ nodes.reshape(len(table.nodes), -1)
        real, imag = (part.reshape(nodes.shape[1:]) for part in parts)
        response = jax.lax.complex(real[0] - imag[1], real[1] + imag[0])
        functions = table.functions[*which, tone, direction]
        seen = [_end(table, end, axes, translation, frequency, functions) for end in ends]
        heard, sent = seen[0], seen[-1]
        core = _sandwich(heard.fields, response, sent.fields)
        if combined is None:
            channel = _lifted(heard, core, sent)
        else:
            channel = _sandwich(_combined(combined[0][tone], heard), core, _combined(combined[1][tone], sent))
        channels.append(channel if receiver is not None else 0.5 * (channel + channel.T))
    return channels[0] if table.single else jnp.stack(channels)


def nearest(directions, towards):
    """Which of the directions is nearest: argmax, in two plain reductions that are three times as fast on a CPU."""
    cosines = inner(directions, towards)
    return jnp.min(jnp.where(cosines >= jnp.max(cosines), jnp.arange(len(directions)), len(directions) - 1))


def interpolation(nodes: Sequence[complex], contrast: ArrayLike) -> Complex[jax.Array, " nodes"]:
    """Weights (nodes,) of a response at tabulated contrasts: Lagrange's in chi/(chi + 12), with nothing at chi = 0."""
    y, places = contrast / (contrast + _SKIN), [node / (node + _SKIN) for node in nodes]
    weights = []
    for place in places:
        weight = y / place
        for other in places:
            if other != place:
                weight = weight * ((y - other) / (place - other))
        weights.append(weight)
    return jnp.stack(weights)


def contrast_nodes(contrast: tuple[float, float], loss: float, count: int) -> tuple[complex, ...]:
    """Contrasts to tabulate for a range: Chebyshev's nodes in chi/(chi + 12), at half the loss."""
    low, high = (value / (value + _SKIN) for value in contrast)
    places = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.pi * (np.arange(count) + 0.5) / count)
    return tuple(complex(_SKIN * place / (1.0 - place), 0.5 * loss) for place in places)


class _End(NamedTuple):
    """What an end sees: X_S of the elements that determine all (n, R), S (N, n) or None where they are all, w (N,)."""

    fields: jax.Array
    spread: jax.Array | None
    waves: jax.Array


def _end(table, array, axes, translation, frequency, functions):
    k = wavenumber(frequency)
    places, moments = (jnp.asarray(part, jnp.float32) for part in (array.positions, array.moments))
    centre = jnp.mean(places, axis=0)
    elements, base = places - centre, translation - centre
    far = jnp.sqrt(inner(base, base))
    nearer = path_difference(elements, base)
    distances = far + nearer
    if isinstance(array, PlanarArray):
        chosen, spread = aperture_of(array, frequency, table.radius_m, table.reach_m[0])
        spread = jnp.asarray(spread, jnp.float32)
    else:
        chosen, spread = slice(None), None
    phi = table.patch.functions((elements[chosen] - base) @ axes.T, distances[chosen], moments[chosen] @ axes.T)
    angle = k * far + k * nearer
    waves = jax.lax.complex(jnp.cos(angle) / distances, jnp.sin(angle) / distances)
    return _End(phi @ functions, spread, waves)


@lru_cache(maxsize=64)
def aperture_of(array, frequency, radius_m, nearest_m):
    """Elements (n,) that determine what all others see, spherical waves taken out, and how (N_b, n)."""
    elements = array.positions - array.positions.mean(axis=0)
    sampled = sampled_fields(elements, wavenumber(frequency), radius_m, max(nearest_m, 1.2 * radius_m), 512)
    basis, _ = spanned(sampled, _APERTURE)
    chosen = pivots(basis)
    return chosen, basis @ np.linalg.inv(basis[chosen])


def _combined(matrix, end):
    """C diag(w) S."""
    weighted = matrix * end.waves
    if end.spread is None:
        return weighted
    parts = jnp.concatenate([weighted.real, weighted.imag]) @ end.spread
    return jax.lax.complex(*jnp.split(parts, 2))


def _lifted(left, middle, right):
    """diag(w) S middle S^T diag(w)."""
    parts = jnp.stack([middle.real, middle.imag])
    if right.spread is not None:
        parts = parts @ right.spread.T
    if left.spread is not None:  # so turned, both are one matrix product of a whole batch
        parts = jnp.swapaxes(jnp.swapaxes(parts, 1, 2) @ left.spread.T, 1, 2)
    return left.waves[:, None] * jax.lax.complex(parts[0], parts[1]) * right.waves


def _sandwich(left, middle, right):
    """left middle right^T of a complex middle (n, m) and sides (N, n) and (M, m), real or complex."""
    return _times(_times(left, middle), right.T)


def _times(left, right):
    """A product of which at least one factor is complex, by one real product of all parts."""
    n, m = left.shape[0], right.shape[1]
    twice, across = jnp.iscomplexobj(left), jnp.iscomplexobj(right)
    rows = jnp.concatenate([left.real, left.imag], axis=0) if twice else left
    columns = jnp.concatenate([right.real, right.imag], axis=1) if across else right
    parts = rows @ columns
    if twice and across:
        return jax.lax.complex(parts[:n, :m] - parts[n:, m:], parts[:n, m:] + parts[n:, :m])
    return jax.lax.complex(parts[:n], parts[n:]) if twice else jax.lax.complex(parts[:, :m], parts[:, m:])
