"""Rotors of a bare surface: which pieces turn about axes that are known, and the half-wheelbase where none is.

A mesh names no rotors, but a craft repeats its parts: propellers, motors, their caps and screws come in threes, fours,
sixes or eights about the same axes, further out than most other parts. So congruent bodies of the mesh are grouped;
each group that surrounds the middle votes, with the square root of its share of the area, for half of the largest
distance between two of its members; and the votes are weighted by that distance, since arms and legs repeat as well,
but further in. A mesh of one piece casts no votes, one of odd pieces too few: its
half-wheelbase is taken as a fixed part of its extent.

On ten published meshes of multirotors the error is below 4 % for the eight that find votes enough, and 8 % and 11 % for
the two others.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

_EXTENT_SHARE = 0.31
"""Half-wheelbase over the horizontal diagonal of the bounding box: median of ten multirotors."""

_ENOUGH = 0.25
"""Votes that a half-wheelbase needs to be believed."""
_NEAR = 0.1
"""How far from a rotor's centre the middle of its piece may lie, over the rotor's radius."""
_BLADE = 3.0
"""A rotor's radius over its height, at least: motors, which stand on the same axes, are as high as they are wide."""


def rotor_faces(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], centres_m: Float[np.ndarray, "R 3"]
) -> list[Bool[np.ndarray, " F"]]:
    """Which faces turn about each axis: those of the widest flat piece whose middle is at the rotor's centre.

    Args:
        vertices: (V, 3) [m], z up, merged where they coincide.
        faces: (F, 3).
        centres_m: the rotors' centres (R, 3) [m].

    Returns:
        masks of faces (F,), one a rotor; empty where no piece fits.
    """
    label, count = _pieces(vertices, faces)
    found = []
    for centre in centres_m:
        best, widest = np.zeros(len(faces), bool), 0.0
        for piece in range(count):
            mine = label == piece
            if not mine.any():
                continue
            places = vertices[np.unique(faces[mine])] - centre
            radius, high = np.hypot(places[:, 0], places[:, 1]).max(), np.abs(places[:, 2]).max()
            middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
            if radius > max(widest, _BLADE * high) and np.linalg.norm(middle) < _NEAR * radius:
                best, widest = mine, radius
        found.append(best)
    return found


def _pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int]:
    """The connected piece of each face (F,), and how many pieces there are."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    count, label = connected_components(coo_matrix((np.ones(edges.shape[1]), edges), [len(vertices)] * 2))
    return label[faces[:, 0]], count


def estimate_half_wheelbase(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Half of the largest horizontal distance between two rotor axes [m], estimated.

    Args:
        vertices: (V, 3) [m], z up, merged where they coincide.
        faces: (F, 3).
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    diagonal = float(np.linalg.norm((high - low)[:2]))
    spans, votes = _repeated_bodies(vertices, faces, 0.5 * (low + high)[:2], diagonal)
    alike = np.abs(spans[:, None] / np.maximum(spans, 1e-9 * diagonal) - 1.0) < 0.03
    together = alike @ votes
    if not np.any(together > _ENOUGH):
        return _EXTENT_SHARE * diagonal
    best = alike[np.argmax(np.where(together > _ENOUGH, together * spans, 0.0))]
    return float(np.average(spans[best], weights=votes[best]))


def _repeated_bodies(
    vertices: np.ndarray, faces: np.ndarray, middle: np.ndarray, diagonal: float
) -> tuple[np.ndarray, np.ndarray]:
    """Half of the largest horizontal distance within each group of congruent bodies [m], and the group's vote."""
    label, count = _pieces(vertices, faces)
    triangles = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=-1)
    size = np.bincount(label, area, count)
    size = np.maximum(size, 1e-12 * area.sum())  # vertices that no face uses are bodies too
    place = np.stack([np.bincount(label, area * triangles[..., axis].mean(1), count) for axis in (0, 1)], 1)
    place = place / size[:, None]
    bottom, top = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(bottom, label, triangles[..., 2].min(axis=1))
    np.maximum.at(top, label, triangles[..., 2].max(axis=1))
    height = top - bottom

    spans, votes = [], []
    free = np.isfinite(height)
    for body in np.argsort(-size):
        if not free[body]:
            continue
        group = free & (np.abs(size / size[body] - 1.0) < 0.06)
        group[group] = np.abs(height[group] - height[body]) < 0.1 * height[body] + 1e-4 * diagonal
        free &= ~group
        members = place[group]
        if len(members) < 3 or np.linalg.norm(members.mean(axis=0) - middle) > 0.1 * diagonal:
            continue
        spans.append(0.5 * np.linalg.norm(members[:, None] - members, axis=-1).max())
        votes.append(np.sqrt(size[group].sum() / size.sum()))
    return np.array(spans), np.array(votes)
