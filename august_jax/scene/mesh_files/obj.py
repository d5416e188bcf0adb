"""Wavefront OBJ: vertices and faces; materials, textures, normals, groups and curves are not read.

Indices count from 1; a negative one counts back from the vertices read so far, -1 being the last of them.
"""

from __future__ import annotations

import numpy as np

from august_jax.scene.mesh_files.polygons import triangulated
from august_jax.scene.mesh_files.surface import DamagedMesh, Surface, check_places, check_surface


def read_obj(content: bytes) -> Surface:
    """The surface of an OBJ file's content.

    Raises:
        DamagedMesh: a line cannot be read, or a face names a vertex that is not there.
    """
    vertices: list[list[str]] = []
    counts: list[int] = []
    corners: list[int] = []
    text = content.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.lstrip().startswith(("v", "f")):
            continue
        keyword, *words = line.split("#")[0].split()
        if keyword == "v":
            vertices.append(words[:3])
            if len(words) < 3:
                raise DamagedMesh(f"line {number}: a vertex of {len(words)} numbers, {line.strip()!r}; wanted 3")
        elif keyword in ("f", "fo"):
            try:
                indices = [int(word.split("/")[0]) for word in words]
            except ValueError:
                raise DamagedMesh(f"line {number}: {line.strip()[:60]!r} is no face of whole numbers") from None
            if 0 in indices or min(indices, default=0) < -len(vertices):
                raise DamagedMesh(
                    f"line {number}: {line.strip()[:60]!r} names a vertex that is not there; indices start at 1, and "
                    f"negative ones count back from the {len(vertices)} vertices before the line"
                )
            counts.append(len(indices))
            corners.extend(index - 1 if index > 0 else len(vertices) + index for index in indices)
    try:
        numbers = np.array(vertices, np.float64)
    except ValueError as error:
        raise DamagedMesh(f"a vertex is not three numbers ({error})") from None
    places = check_places(numbers)
    return check_surface(places, triangulated(places, np.array(counts, np.int64), np.array(corners, np.int64)))
