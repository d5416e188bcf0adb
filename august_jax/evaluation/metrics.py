"""How good a reconstruction is (paper, Section VI): WD, MCD, MPE, MDE.

For clouds P (truth) and P^ (estimate), each shifted to its own mean,

    CD = mean_{p^} min_p |p^ - p|^2 + mean_p min_{p^} |p - p^|^2                                       [m^2]
    WD = 10 log10 mean_t (CD_t + |q_t - q^_t|^2),   MCD = 10 log10 mean_t CD_t                         [dB re 1 m^2]
    MPE = mean_t |q_t - q^_t|   [m],                MDE = mean_t (1 - n_t . n^_t).

The logarithm follows the mean over samples. Lengths are metres, never region units, so that regions of different size
compare; ``size_m`` divides them out where targets of different size are to compare.

What no information gives is worth a line in every plot: ``mde`` of always answering up; ``mpe_m`` of answering the
prediction; ``wd_db`` of the mean shape there; and, as the floor, ``wd_db`` of the truth sampled a second time.

Functions named after a quantity take one sample and may be mapped; those that end in a unit, and ``mde``, take a batch.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array, ArrayLike

Scalar = Float[jax.Array, ""]

BATCH = 16
"""Samples whose distances are found side by side."""


def nearest_squared(source: Float[Array, "n 3"], target: Float[Array, "m 3"]) -> Float[jax.Array, " n"]:
    """Squared distance (N,) [m^2] of each point of ``source`` (N, 3) to the nearest of ``target`` (M, 3) [m].

    Written coordinate by coordinate: the N x M distances then melt into the minimum and are never stored.

    Raises:
        ValueError: a cloud without points.
    """
    if 0 in (len(source), len(target)):
        raise ValueError(f"source, target: clouds of {len(source)} and {len(target)} points; give at least one in each")
    distances = sum((source[:, None, axis] - target[None, :, axis]) ** 2 for axis in range(3))
    return jnp.min(distances, axis=1)


def chamfer(estimated: Float[Array, "n 3"], true: Float[Array, "m 3"]) -> Scalar:
    """Two one-sided means of the squared distance to the nearest point, added [m^2].

    Args:
        estimated: (N, 3) [m].
        true: (M, 3) [m].
    """
    return jnp.mean(nearest_squared(estimated, true)) + jnp.mean(nearest_squared(true, estimated))


def shape_distance(estimated: Float[Array, "n 3"], true: Float[Array, "m 3"]) -> Scalar:
    """Chamfer distance of two clouds (N, 3), (M, 3) [m], each shifted to its own mean [m^2]."""
    return chamfer(estimated - jnp.mean(estimated, axis=0), true - jnp.mean(true, axis=0))


def weighted_distance(
    estimated: Float[Array, "n 3"],
    true: Float[Array, "m 3"],
    estimated_position: Float[Array, "3"],
    position: Float[Array, "3"],
) -> Scalar:
    """:func:`shape_distance` of two clouds plus the squared distance of two positions (3,) [m], in m^2."""
    return shape_distance(estimated, true) + jnp.sum((estimated_position - position) ** 2)


def shape_distances(
    estimated: Float[Array, "batch n 3"], true: Float[Array, "batch m 3"]
) -> Float[jax.Array, " batch"]:
    """:func:`shape_distance` of each pair of clouds (B, N, 3), (B, M, 3) [m], about any origin, in m^2.

    Raises:
        ValueError: shapes that do not fit.
    """
    _check_clouds(estimated, true)
    return _shape_distances(estimated, true)


@jax.jit
def _shape_distances(estimated, true):
    return jax.lax.map(lambda pair: shape_distance(*pair), (estimated, true), batch_size=BATCH)


def decibels(values: Float[Array, " batch"]) -> tuple[float, float | None]:
    """Mean of squared distances (B,) [m^2] in dB, and its standard error [dB] to first order: None for one value,
    or where all are zero and the mean is minus infinity."""
    values = np.asarray(values, np.float64)
    mean = float(np.mean(values))
    if not mean > 0.0:
        return -np.inf, None
    error = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return 10.0 * float(np.log10(mean)), None if error is None else 10.0 / float(np.log(10.0)) * error / mean


def wd_db(
    estimated: Float[Array, "batch n 3"],
    true: Float[Array, "batch m 3"],
    estimated_position: Float[Array, "batch 3"],
    position: Float[Array, "batch 3"],
    *,
    size_m: ArrayLike = 1.0,
) -> Scalar:
    """Weighted distance of a batch [dB].

    Args:
        estimated: clouds (B, N, 3) [m], about any origin.
        true: clouds (B, M, 3) [m], about any origin.
        estimated_position, position: (B, 3) [m].
        size_m: length that divides every distance, one or (B,); the half-wheelbase gives WD/size^2.

    Raises:
        ValueError: shapes that do not fit.
    """
    _check_clouds(estimated, true)
    _check_vectors("estimated_position", estimated_position, "position", position)
    squared = jnp.sum((jnp.asarray(estimated_position) - position) ** 2, axis=-1)
    return 10.0 * jnp.log10(jnp.mean((_shape_distances(estimated, true) + squared) / jnp.square(size_m)))


def mcd_db(estimated: Float[Array, "batch n 3"], true: Float[Array, "batch m 3"], *, size_m: ArrayLike = 1.0) -> Scalar:
    """Mean Chamfer distance of a batch of centred clouds [dB]; arguments and errors as in :func:`wd_db`."""
    _check_clouds(estimated, true)
    return 10.0 * jnp.log10(jnp.mean(_shape_distances(estimated, true) / jnp.square(size_m)))


def mpe_m(estimated_position: Float[Array, "batch 3"], position: Float[Array, "batch 3"]) -> Scalar:
    """Mean positioning error of positions (B, 3) [m]."""
    _check_vectors("estimated_position", estimated_position, "position", position)
    return jnp.mean(jnp.linalg.norm(jnp.asarray(estimated_position) - position, axis=-1))


def along_and_across_m(
    estimated_position: Float[Array, "batch 3"], position: Float[Array, "batch 3"]
) -> tuple[Scalar, Scalar]:
    """Root-mean-square errors of positions (B, 3) [m] along the line of sight from the origin and across it [m]."""
    _check_vectors("estimated_position", estimated_position, "position", position)
    error = jnp.asarray(estimated_position) - position
    along = jnp.sum(error * position, axis=-1) / jnp.linalg.norm(position, axis=-1)
    across = jnp.maximum(jnp.sum(error**2, axis=-1) - along**2, 0.0)
    return jnp.sqrt(jnp.mean(along**2)), jnp.sqrt(jnp.mean(across))


def mde(estimated_normal: Float[Array, "batch 3"], normal: Float[Array, "batch 3"]) -> Scalar:
    """Mean directional error, mean(1 - n.n^), of unit normals (B, 3)."""
    _check_vectors("estimated_normal", estimated_normal, "normal", normal)
    return jnp.mean(1.0 - jnp.sum(jnp.asarray(estimated_normal) * normal, axis=-1))


def _check_clouds(estimated: Array, true: Array) -> None:
    shapes = jnp.shape(estimated), jnp.shape(true)
    if any(len(shape) != 3 or shape[-1] != 3 for shape in shapes) or shapes[0][0] != shapes[1][0]:
        raise ValueError(
            f"estimated, true: got shapes {shapes[0]} and {shapes[1]}; give (B, N, 3) and (B, M, 3) in metres "
            "(drop the material columns of a 5-D cloud)"
        )


def _check_vectors(name: str, first: Array, other: str, second: Array) -> None:
    shapes = jnp.shape(first), jnp.shape(second)
    if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][-1] != 3:
        raise ValueError(f"{name}, {other}: got shapes {shapes[0]} and {shapes[1]}; give (B, 3) for both")
