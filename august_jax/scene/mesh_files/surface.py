"""What every reader returns: a surface of triangles, what its file says about units and axes, and what damage is.

A reader raises :class:`DamagedMesh` with what is wrong and the way out; the path is put in front of it where the
file is opened. Nothing that a reader cannot decode may vanish: it is decoded, or refused by its name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class DamagedMesh(ValueError):
    """A mesh file that cannot be read as its format says, or that asks for what no reader here supports."""


class Surface(NamedTuple):
    """Triangles in the file's own unit and axes.

    Attributes:
        vertices: places (V, 3) float64, in the file's unit.
        faces: indices of corners (F, 3) int64, each in [0, V).
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]


@dataclass(frozen=True)
class Declared:
    """Unit and axes that a file, or the standard of its format, fixes; None where nothing is said.

    Attributes:
        unit_m: length of the file's unit [m].
        up: axis that points up, such as "y" or "-z".
        forward: axis that points forward.
        by: who says so: for ``unit_m``, ``up`` and ``forward``, in the words that the user reads.
    """

    unit_m: float | None = None
    up: str | None = None
    forward: str | None = None
    by: tuple[str, str, str] = ("", "", "")


def check_surface(vertices: np.ndarray, faces: np.ndarray, part: str = "") -> Surface:
    """The surface as float64 and int64, its indices and numbers looked at.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        part: which part of the file this is, for the message; empty for all of it.

    Raises:
        DamagedMesh: a face names a vertex that is not there, or a vertex is NaN or infinite.
    """
    places, faces = check_places(vertices, part), np.asarray(faces, np.int64).reshape(-1, 3)
    check_indices(faces, len(places), part)
    return Surface(places, faces)


def check_places(vertices: np.ndarray, part: str = "") -> Float[np.ndarray, "V 3"]:
    """Vertices as float64; raises :class:`DamagedMesh` where one is NaN or infinite."""
    places = np.asarray(vertices, np.float64).reshape(-1, 3)
    wrong = int(np.sum(~np.isfinite(places).all(axis=1)))
    if wrong:
        where = f"{part}: " if part else ""
        raise DamagedMesh(
            f"{where}{wrong} of {len(places)} vertices are NaN or infinite, which would leave holes; "
            "repair or export the mesh again"
        )
    return places


def check_indices(faces: np.ndarray, count: int, part: str = "", what: str = "faces") -> None:
    """Raise :class:`DamagedMesh` where indices (F, n), from 0, do not name one of ``count`` vertices."""
    outside = (faces < 0) | (faces >= count)
    if outside.any():
        where = f"{part}: " if part else ""
        raise DamagedMesh(
            f"{where}{int(outside.any(axis=1).sum())} of {len(faces)} {what} name a vertex that is not there, such as "
            f"index {int(faces[outside][0])} (from 0) of {count} vertices; export the mesh again"
        )


def placed(surface: Surface, matrix: Float[np.ndarray, "4 4"]) -> Surface:
    """The surface after x -> M x; its faces are turned over where M mirrors, so that normals stay outward."""
    faces = surface.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0.0 else surface.faces
    return Surface(surface.vertices @ matrix[:3, :3].T + matrix[:3, 3], faces)


def joined(parts: list[Surface]) -> Surface:
    """All parts as one surface."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    return Surface(
        np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.zeros((0, 3), np.int64), *(part.faces + offset for part, offset in zip(parts, offsets))]),
    )


def strip_faces(corners: Int[np.ndarray, " n"]) -> Int[np.ndarray, "F 3"]:
    """Triangles of a strip: each corner from the third on makes one with the two before it, every other turned over."""
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=-1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def fan_faces(corners: Int[np.ndarray, " n"]) -> Int[np.ndarray, "F 3"]:
    """Triangles of a fan about its first corner."""
    return np.stack([np.broadcast_to(corners[:1], corners[2:].shape), corners[1:-1], corners[2:]], axis=-1)
