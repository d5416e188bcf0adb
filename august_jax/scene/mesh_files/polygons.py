"""Polygons cut into triangles, concave ones too, each in its own plane.

The area vector of a polygon with corners p_1 ... p_n is Newell's, A = 1/2 sum_i p_i x p_{i+1}, whatever its shape.
A fan about one corner is right where every triangle of it turns with A: where that corner sees all others. Else ears
are cut off: a corner whose triangle turns with A and holds no other corner. Every triangle then turns with A, and
their areas add up to |A|.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from august_jax.scene.mesh_files.surface import check_indices

_FLAT = 1e-9
"""Area of a triangle over that of its polygon's square extent below which three corners lie on one line."""


def triangulated(
    vertices: Float[np.ndarray, "V 3"], counts: Int[np.ndarray, " P"], corners: Int[np.ndarray, " C"]
) -> Int[np.ndarray, "F 3"]:
    """Triangles of polygons, in the polygons' order and winding.

    Args:
        vertices: (V, 3), finite.
        counts: corners of each polygon (P,); one of fewer than three becomes a triangle of no area.
        corners: indices of the corners (C,), polygon after polygon; C is the sum of ``counts``.

    Returns:
        indices (F, 3). Triangles of no area are left out of polygons that have some, not out of those that are flat.

    Raises:
        DamagedMesh: a corner names a vertex that is not there.
    """
    check_indices(corners.reshape(-1, 1), len(vertices), what="corners of faces")
    starts = np.cumsum(counts) - counts
    faces, order = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(counts[counts >= 1]):
        which = np.flatnonzero(counts == size)
        rings = corners[starts[which][:, None] + np.minimum(np.arange(max(size, 3)), size - 1)]
        if size <= 3:
            faces.append(rings)
            order.append(which)
            continue
        cut, owner = _of_one_size(vertices[rings])
        faces.append(rings[owner[:, None], cut])
        order.append(which[owner])
    return np.concatenate(faces)[np.argsort(np.concatenate(order), kind="stable")]


def _of_one_size(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (F, 3) in [0, n) of triangles of polygons (P, n, 3), and the polygon (F,) that each is of."""
    polygons, size, _ = points.shape
    points = points - points[:, :1]
    extent = np.ptp(points, axis=1).max(axis=-1)
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=-1)
    flat = length <= 2.0 * _FLAT * extent**2
    normal /= np.where(flat, 1.0, length)[:, None]
    least = 2.0 * _FLAT * extent**2
    todo = np.ones(polygons, bool)
    faces, owner = [], []
    for apex in range(size if size == 4 else 1):  # a quadrilateral always has a corner that sees the others
        corner = (apex + np.stack([np.zeros(size - 2, int), np.arange(1, size - 1), np.arange(2, size)], -1)) % size
        a, b, c = np.moveaxis(points[:, corner], 2, 0)
        area = np.einsum("pfi,pi->pf", np.cross(b - a, c - a), normal)
        fits = todo & (flat | (area >= -least[:, None]).all(axis=1))
        keep = fits[:, None] & (flat[:, None] | (area > least[:, None]))
        which, face = np.nonzero(keep)
        faces.append(corner[face])
        owner.append(which)
        todo &= ~fits
    for polygon in np.flatnonzero(todo):
        cut = _ears(_in_plane(points[polygon], normal[polygon]), least[polygon])
        faces.append(cut)
        owner.append(np.full(len(cut), polygon))
    return np.concatenate(faces), np.concatenate(owner)


def _in_plane(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Points (n, 2) in a right-handed frame of the plane whose normal they turn about."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    across = np.cross(normal, helper)
    across /= np.linalg.norm(across)
    return points @ np.stack([across, np.cross(normal, across)], axis=-1)


def _ears(points: np.ndarray, least: float) -> np.ndarray:
    """Triangles (F, 3) of one polygon (n, 2) that runs anticlockwise, ears cut off one by one.

    A corner on the rim of an ear forbids it, one at a corner of the ear does not: a polygon may touch itself, as one
    whose holes are joined to its rim does. One that crosses itself has no ear at some point: its bluntest corner goes.
    """
    ring = list(range(len(points)))
    faces = []
    while len(ring) > 3:
        corners = points[ring]
        before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
        turns = np.asarray(_twice_area(before, corners, after))
        reflex = corners[turns < -least]
        straight = np.flatnonzero(np.abs(turns) <= least)
        if len(straight):  # no area: the corner goes, and no face is made
            del ring[straight[0]]
            continue
        # blunt ears first: slivers would come of cutting in order
        for place in np.argsort(-turns):
            a, b, c = before[place], corners[place], after[place]
            inside = np.min([_twice_area(*edge, reflex) for edge in ((a, b), (b, c), (c, a))], axis=0)
            apart = np.min([np.abs(reflex - corner).max(axis=-1, initial=0.0) for corner in (a, b, c)], axis=0)
            if turns[place] > 0.0 and not ((inside >= -least) & (apart > least**0.5)).any():
                break
        else:
            place = int(np.argmax(turns))
        faces.append([ring[place - 1], ring[place], ring[(place + 1) % len(ring)]])
        del ring[place]
    if abs(float(_twice_area(*points[ring]))) > least:
        faces.append(ring)
    return np.array(faces, np.int64).reshape(-1, 3)


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray | np.float64:
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
