"""STL, binary and text. A file has no vertices to share: every facet brings its own three corners.

Binary: 80 bytes of header, the number of facets as uint32, and 50 bytes a facet (normal, three corners as float32,
two bytes). What is binary is told by that length, since headers that begin with "solid" are common.
"""

from __future__ import annotations

import re

import numpy as np

from august_jax.scene.mesh_files.surface import DamagedMesh, Surface, check_surface

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(content: bytes) -> Surface:
    """The surface of an STL file's content.

    Raises:
        DamagedMesh: the number of facets is not the one that the file states, or a text file is cut off.
    """
    stated = int.from_bytes(content[80:84], "little") if len(content) >= 84 else None
    binary = stated is not None and len(content) == 84 + 50 * stated
    if not binary and content.lstrip()[:5].lower() == b"solid" and b"\0" not in content[:2048]:
        return _text(content)
    if stated is None:
        raise DamagedMesh(f"{len(content)} bytes are too few for an STL file, whose header takes 84; export it again")
    held, rest = divmod(len(content) - 84, 50)
    if held != stated:
        raise DamagedMesh(
            f"its header counts {stated} facets ({84 + 50 * stated} bytes), but {len(content)} bytes hold {held}"
            f"{' and a part of one' if rest else ''}; it was cut off or patched: export it again"
        )
    corners = np.frombuffer(content, _FACET, stated, 84)["corners"].reshape(-1, 3)
    return check_surface(corners, np.arange(len(corners)).reshape(-1, 3))


def _text(content: bytes) -> Surface:
    text = content.decode("utf-8", errors="replace").lower()
    begun, ended = len(re.findall(r"\bfacet\s+normal\b", text)), len(re.findall(r"\bendfacet\b", text))
    rows = re.findall(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", text)
    if not (begun == ended and len(rows) == 3 * begun and re.search(r"\bendsolid\b", text)):
        raise DamagedMesh(
            f"{begun} facets begin, {ended} end, and they have {len(rows)} corners (3 a facet and a last "
            "line 'endsolid' are wanted); it was cut off: export it again"
        )
    try:
        corners = np.array(rows, np.float64).reshape(-1, 3)
    except ValueError as error:
        raise DamagedMesh(f"a corner is not three numbers ({error})") from None
    return check_surface(corners, np.arange(len(corners)).reshape(-1, 3))
