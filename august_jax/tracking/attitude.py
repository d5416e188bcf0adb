"""Attitude from a cloud: the upward normal of the rotor plane (paper, Section VI, eq. normal vector).

The paper averages the unit normals of random triples of rotor points. A triple's normal has no side of its own, so each
is turned upward first (a multirotor's thrust points up in flight), triples too thin to span a plane are left out, and
the average is normalised again.

:func:`plane_normal` is the robust alternative: the plane of the triple that most points agree with, then the
least-squares plane of those points. :func:`rotor_points` finds the rotor points without knowing the truth.

All take one cloud of any origin, have fixed shapes, and may be mapped.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Shaped

from august_jax.arrays import Array


@partial(jax.jit, static_argnames="triples")
def triple_normal(
    key: jax.Array,
    points: Float[Array, "points 3"],
    triples: int = 512,
    *,
    weights: Shaped[Array, " points"] | None = None,
) -> Float[jax.Array, "3"]:
    """The paper's estimate: mean normal of random triples.

    Args:
        key: random key.
        points: (M, 3) [m], world axes.
        triples: number of triples, J.
        weights: (M,), chance of each point to be drawn up to a factor; a mask will do. None: all alike.

    Returns:
        unit normal (3,), z >= 0; straight up where every triple was degenerate.
    """
    _check(points, triples)
    corners = points[_draw(key, points.shape[0], weights, triples)]
    normals, valid = _normals(corners)
    mean = jnp.sum(jnp.where(valid[:, None], upward(normals), 0.0), axis=0)
    length = jnp.linalg.norm(mean)
    up = jnp.array([0.0, 0.0, 1.0], points.dtype)
    return jnp.where(length > 0.0, mean / jnp.where(length > 0.0, length, 1.0), up)


@partial(jax.jit, static_argnames="trials")
def plane_normal(
    key: jax.Array,
    points: Float[Array, "points 3"],
    trials: int = 128,
    *,
    tolerance_m: float | jax.Array = 0.03,
    weights: Shaped[Array, " points"] | None = None,
) -> Float[jax.Array, "3"]:
    """Normal of the plane that most points lie near: random sample consensus, then total least squares.

    Args:
        key: random key.
        points: (M, 3) [m], world axes.
        trials: planes to try.
        tolerance_m: points within this distance belong to a plane [m]; a plane's score is the sum of their squared
            distances, with this one for all others.
        weights: (M,) non-negative importance of each point; a mask will do. None: all alike.

    Returns:
        unit normal (3,), z >= 0.
    """
    _check(points, trials)
    importance = jnp.ones(points.shape[0], points.dtype) if weights is None else weights.astype(points.dtype)
    corners = points[_draw(key, points.shape[0], weights, trials)]
    normals, valid = _normals(corners)
    distances = normals @ points.T - jnp.sum(normals * corners[:, 0], axis=-1, keepdims=True)
    squared = jnp.minimum(distances**2, tolerance_m**2)
    scores = jnp.where(valid, squared @ importance, jnp.inf)
    best = jnp.argmin(scores)
    members = importance * (jnp.abs(distances[best]) < tolerance_m)
    # Without one proper triple every point is a member: the least-squares plane of all.
    return least_squares_normal(points, jnp.where(valid[best], members, importance))


def rotor_plane_normal(key: jax.Array, points: Float[Array, "points 3"]) -> Float[jax.Array, "3"]:
    """Upward unit normal (3,) of the rotor plane, read from a cloud (M, 3) [m] alone."""
    return plane_normal(key, points, weights=rotor_points(points))


@jax.jit
def cloud_normals(
    key: jax.Array, clouds: Float[Array, "batch points 3"]
) -> tuple[Float[jax.Array, "batch 3"], Float[jax.Array, "batch 3"]]:
    """Normals (B, 3) of clouds (B, M, 3) [m]: of the plane of their rotor points, and the paper's, by triples of
    these."""
    centred = clouds - jnp.mean(clouds, axis=1, keepdims=True)

    def both(key: jax.Array, cloud: jax.Array) -> tuple[jax.Array, jax.Array]:
        plane, triples = jax.random.split(key)
        return rotor_plane_normal(plane, cloud), triple_normal(triples, cloud, weights=rotor_points(cloud))

    return jax.vmap(both)(jax.random.split(key, len(clouds)), centred)


def least_squares_normal(points: Float[Array, "points 3"], weights: Float[Array, " points"]) -> Float[jax.Array, "3"]:
    """Upward unit normal (3,) of the plane with the least weighted sum of squared distances; points (M, 3)."""
    centred = points - weights @ points / jnp.sum(weights)
    _, axes = jnp.linalg.eigh((weights[:, None] * centred).T @ centred)
    return upward(axes[:, 0])


@partial(jax.jit, static_argnames="rounds")
def rotor_points(points: Float[Array, "points 3"], rounds: int = 3) -> Bool[jax.Array, " points"]:
    """Which points are likely on the rotor plane, from the cloud alone.

    Rotors are far from the axis and above the arms. Starting from the least-squares plane of the whole cloud, keep the
    outer half and of that the upper half, fit again, and repeat with the new normal.

    Args:
        points: (M, 3) [m], world axes.
        rounds: how often to fit.

    Returns:
        mask (M,) bool.
    """
    _check(points, rounds)
    centred = points - jnp.mean(points, axis=0)

    def refine(mask, _):
        normal = least_squares_normal(points, mask.astype(points.dtype))
        height = centred @ normal
        radius = jnp.linalg.norm(centred - height[:, None] * normal, axis=-1)
        outer = radius >= jnp.median(radius)
        level = jnp.nanmedian(jnp.where(outer, height, jnp.nan))
        return outer & (height >= level), None

    mask, _ = jax.lax.scan(refine, jnp.ones(points.shape[0], bool), length=rounds)
    return mask


def upward(normals: Float[Array, "*batch 3"]) -> Float[jax.Array, "*batch 3"]:
    """Vectors (..., 3) with the sign that makes z >= 0."""
    return jnp.where(normals[..., 2:] < 0.0, -normals, normals)


def _draw(key: jax.Array, count: int, weights: jax.Array | None, triples: int) -> jax.Array:
    """Indices (triples, 3) of points, drawn with replacement; a point drawn twice makes a degenerate triple."""
    if weights is None:
        return jax.random.randint(key, (triples, 3), 0, count)
    total = jnp.cumsum(weights.astype(jnp.float32))
    places = jax.random.uniform(key, (triples, 3), maxval=total[-1])
    return jnp.minimum(jnp.searchsorted(total, places, side="right"), count - 1)


def _normals(corners: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Unit normals (J, 3) of triangles (J, 3, 3), and whether each spans a plane: sine of an angle above 0.1."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = jnp.cross(first, second)
    area = jnp.linalg.norm(cross, axis=-1)
    sides = jnp.linalg.norm(first, axis=-1) * jnp.linalg.norm(second, axis=-1)
    valid = area > 0.1 * sides
    return cross / jnp.where(valid, area, 1.0)[:, None], valid


def _check(points: jax.Array, count: int) -> None:
    if points.ndim != 2 or points.shape[-1] != 3 or points.shape[0] < 3:
        raise ValueError(
            f"points: got shape {points.shape}; give at least three points (M, 3) in metres and map over clouds with "
            "jax.vmap"
        )
    if count < 1:
        raise ValueError(f"triples, trials, rounds: got {count}; give at least 1")
