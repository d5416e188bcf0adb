"""A thin shell on a cubic lattice: fill fractions and sheet directions of the cells that a surface's skin touches.

The material is every point no further than half the skin thickness from the surface, on either side. Only the
distance to the nearest facet enters, so faces given twice, plates of no thickness, open edges and bodies that cut
through one another need no repair: their material is the union, and nothing counts double.

The lattice is cubic with one cell centred at the origin. Each cell is divided into sub-cells of edge h, about 3/4
of the skin thickness t, or a twelfth of the cell where that is longer. A sub-cell at distance r from its nearest
facet, with normal n, holds the part of its volume that lies in the slab |n . x| < t/2 of that facet,
F(t/2 - r) - F(-t/2 - r), where

    F(x) = sum over s in {-1, 1}^3 of s1 s2 s3 max(0, x + h s.n / 2)^3 / (6 h^3 |n1 n2 n3|)

is the part of a cube below a plane at height x (components of n by magnitude). A flat sheet so keeps its volume
exactly, whatever its tilt and its place on the lattice.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from august_jax.arrays import Array
from august_jax.physics.cells import Cells

_NEGLIGIBLE = 0.05
"""Cells with less than this part of the fill of a sheet through the cell's middle are dropped."""
_MOST_PARTS = 12
"""Sub-cells along a cell's edge. Walls nearer to each other than a sub-cell count as one: on a quad_x with a skin of
0.5 mm in 16.8 mm cells 0.7 % of the material is lost against 32 parts, which take nine times as long."""
_MOST_SAMPLES = 3e7
"""Points on the surface, which take about 100 bytes each on the way. A craft of half a metre takes 3e5."""
_TOWARDS_CENTROID = 0.4
"""Where a cell couples to the others, from its centre (0) to its material's centroid (1). Between centres a tilted
sheet is a staircase; between centroids neighbours that share a corner's worth of material come too close for point
dipoles. Of 0, 0.25, 0.4, 0.5, 0.6 this errs least on 25 sheets of random tilt and place, at permittivities 3 and 5."""


def shell_cells(triangles: Float[Array, "T 3 3"], cell_m: float, skin_m: float) -> Cells:
    """Cells of a cubic lattice that the skin of a surface touches, in the frame of ``triangles``.

    Cells filled to less than 5 % of ``skin_m / cell_m`` are dropped; on drone-like bodies they hold about 0.2 % of
    the material. The result depends on the arguments alone.

    Args:
        triangles: corners (T, 3, 3) [m], none of zero area.
        cell_m: edge of the cells [m].
        skin_m: thickness of the material [m], at most ``cell_m``.

    Returns:
        Cells with float64 positions (N, 3) [m] on the way from the lattice's centres to the material's centroids,
        volumes (N,) [m^3], fill (N,) in (0, 1], the mean of n n^T (N, 3, 3), weighted by the material in the cell, and
        the centroids (N, 3) [m].

    Raises:
        ValueError: a size is not positive, the skin is thicker than a cell, or so thin or coarse that no cell is left,
            or the cells so fine that the work does not fit in memory.
    """
    check_sizes(cell_m, skin_m)
    triangles = np.asarray(triangles, dtype=np.float64)
    # half a skin is no more than a sub-cell then, so that the shell stays within the neighbours of those it passes
    parts = min(int(np.ceil(cell_m / (0.75 * skin_m))), _MOST_PARTS)
    step = cell_m / parts
    _check_cost(triangles, cell_m, 0.5 * step)
    samples, owner = surface_grid(triangles, 0.5 * step)

    index = np.floor(samples / step + 0.5 * parts).astype(np.int64)
    low = index.min(axis=0) - 1
    shape = index.max(axis=0) - low + 2
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    near = np.unique((index - low) @ strides)
    for stride in strides:
        near = np.unique(near[:, None] + np.array([-stride, 0, stride]))
    index = np.stack(np.unravel_index(near, shape), axis=-1) + low
    centres = (index + 0.5 - 0.5 * parts) * step

    # the nearest sample names the facet; the distance itself is taken to the whole facet
    reach = 0.5 * skin_m + 0.87 * step
    _, sample = cKDTree(samples, balanced_tree=False).query(centres, distance_upper_bound=reach + step, workers=-1)
    found = sample < len(samples)
    index, centres, facet = index[found], centres[found], owner[sample[found]]
    distance = distance_to_triangles(centres, triangles[facet])
    normals = _unit_normals(triangles)[facet]
    half = 0.5 * skin_m
    part = _below(half - distance, normals, step) - _below(-half - distance, normals, step)

    keep = part > 1e-6
    index, centres, part, normals = index[keep], centres[keep], part[keep], normals[keep]
    cells, inverse = np.unique(index // parts, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    weight = np.bincount(inverse, part)
    tensors = np.empty((len(cells), 3, 3))
    for row in range(3):
        for column in range(row, 3):
            mean = np.bincount(inverse, part * normals[:, row] * normals[:, column]) / weight
            tensors[:, row, column] = tensors[:, column, row] = mean
    centroids = np.stack([np.bincount(inverse, part * centres[:, axis]) / weight for axis in range(3)], axis=-1)
    middles = cells * cell_m
    fill = weight / parts**3
    kept = fill >= _NEGLIGIBLE * skin_m / cell_m
    if not kept.any():
        raise ValueError(
            f"cell_m={cell_m!r}, skin_m={skin_m!r}: no cell holds material worth keeping; both are in "
            "metres, e.g. 0.012 and 0.002"
        )
    return Cells(
        positions=(middles + _TOWARDS_CENTROID * (centroids - middles))[kept],
        volumes=np.full(int(kept.sum()), cell_m**3),
        fill=np.minimum(fill[kept], 1.0),
        normals=tensors[kept],
        centroids=centroids[kept],
    )


def check_sizes(cell_m: float, skin_m: float) -> None:
    """Raise ValueError unless 0 < skin_m <= cell_m, both finite [m]."""
    if not (np.isfinite(cell_m) and np.isfinite(skin_m) and 0.0 < skin_m <= cell_m):
        raise ValueError(f"skin_m={skin_m!r}, cell_m={cell_m!r}: wanted 0 < skin_m <= cell_m, both in metres")


def touched_cells(triangles: Float[Array, "T 3 3"], cell_m: float) -> int:
    """Number of lattice cells of edge ``cell_m`` [m] that the bare surface passes: cheap, a little below
    ``shell_cells(...).count``."""
    triangles = np.asarray(triangles, dtype=np.float64)
    _check_cost(triangles, cell_m, 0.25 * cell_m)
    samples, _ = surface_grid(triangles, 0.25 * cell_m)
    index = np.floor(samples / cell_m + 0.5).astype(np.int64)
    index -= index.min(axis=0)
    return len(np.unique(index @ np.array([1, 1 << 20, 1 << 40])))


def surface_grid(
    triangles: Float[np.ndarray, "T 3 3"], spacing_m: float
) -> tuple[Float[np.ndarray, "P 3"], Int[np.ndarray, " P"]]:
    """Regular points on triangles, no further than about ``spacing_m`` [m] apart.

    Rows run along each triangle's longest edge, so that slivers stay cheap; each row is as long as the lower side of
    its strip, so that sharp corners are reached.

    Returns:
        points (P, 3) [m] and the triangle that each lies on (P,).
    """
    edges = np.roll(triangles, -1, axis=1) - triangles
    lengths = np.linalg.norm(edges, axis=-1)
    first = np.argmax(lengths, axis=1)
    every = np.arange(len(triangles))
    start, length = triangles[every, first], lengths[every, first]
    along = edges[every, first] / length[:, None]
    apex = triangles[every, (first + 2) % 3] - start
    foot = np.clip(np.sum(apex * along, axis=-1), 1e-9 * length, (1.0 - 1e-9) * length)
    rise = apex - foot[:, None] * along
    height = np.linalg.norm(rise, axis=-1)

    rows = np.maximum(1, np.ceil(height / spacing_m)).astype(np.int64)
    owner = np.repeat(every, rows)
    bottom = _rank(rows) / rows[owner]
    counts = np.maximum(1, np.ceil(length[owner] * (1.0 - bottom) / spacing_m)).astype(np.int64)
    u = (_rank(counts) + 0.5) / np.repeat(counts, counts)
    owner, bottom = np.repeat(owner, counts), np.repeat(bottom, counts)
    x = foot[owner] * bottom + u * length[owner] * (1.0 - bottom)
    roof = np.minimum(x / foot[owner], (length[owner] - x) / (length - foot)[owner])
    y = np.minimum(bottom + 0.5 / rows[owner], 0.5 * (bottom + roof))
    return start[owner] + x[:, None] * along[owner] + y[:, None] * rise[owner], owner


def distance_to_triangles(
    points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "N 3 3"]
) -> Float[np.ndarray, " N"]:
    """Distance (N,) [m] of each point (N, 3) to the filled triangle (N, 3, 3) of the same row."""
    normals = _unit_normals(triangles)
    squared = np.full(len(points), np.inf)
    inside = np.ones(len(points), dtype=bool)
    for corner in range(3):
        edge = triangles[:, (corner + 1) % 3] - triangles[:, corner]
        offset = points - triangles[:, corner]
        along = np.clip(np.sum(offset * edge, -1) / np.sum(edge * edge, -1), 0.0, 1.0)
        squared = np.minimum(squared, np.sum((offset - along[:, None] * edge) ** 2, -1))
        inside &= np.sum(np.cross(edge, offset) * normals, -1) >= 0.0
    plane = np.abs(np.sum((points - triangles[:, 0]) * normals, -1))
    return np.where(inside, plane, np.sqrt(squared))


def _check_cost(triangles: np.ndarray, cell_m: float, spacing_m: float) -> None:
    """Raise ValueError where a grid of this spacing [m] on the surface would not fit in memory."""
    area = 0.5 * float(np.linalg.norm(_twice_areas(triangles), axis=-1).sum())
    if area > _MOST_SAMPLES * spacing_m**2:
        enough = 2.0 * _MOST_PARTS * np.sqrt(area / _MOST_SAMPLES)
        raise ValueError(
            f"cell_m={cell_m!r}: {area:.3g} m^2 of surface would take {area / spacing_m**2:.2g} samples, more than "
            f"{_MOST_SAMPLES:.0e}; give {enough:.2g} m or more, or check the craft's size and its mesh's unit"
        )


def _below(height: np.ndarray, normals: np.ndarray, edge: float) -> np.ndarray:
    """Part of a cube's volume below a plane with the given normal, ``height`` (N,) above the cube's centre."""
    slant = np.maximum(np.abs(normals), 1e-3).T  # keeps the division well posed where an axis lies in the plane
    x = height / edge
    total = np.zeros_like(x)
    for signs in itertools.product((-0.5, 0.5), repeat=3):
        total += 8.0 * np.prod(signs) * np.maximum(x + np.dot(signs, slant), 0.0) ** 3
    return np.clip(total / (6.0 * np.prod(slant, axis=0)), 0.0, 1.0)


def _unit_normals(triangles: np.ndarray) -> np.ndarray:
    normals = _twice_areas(triangles)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _twice_areas(triangles: np.ndarray) -> np.ndarray:
    """Area vectors (T, 3) of triangles, doubled."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _rank(counts: np.ndarray) -> np.ndarray:
    """0, 1, ..., counts[0]-1, 0, 1, ..., counts[1]-1, ..."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
