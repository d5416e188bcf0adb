"""COLLADA 1.4 and 1.5 (.dae): the nodes of the scene, their transforms, and the meshes that they show.

Read are triangles, polylists, polygons, strips and fans; lines, materials, cameras and lights are passed over. What
else would put a surface into the scene is refused by its name: skins and morphs (``instance_controller``), polygons
with holes, convex hulls. ``<unit>`` and ``<up_axis>`` are returned; where they are missing the standard says metres
and y up. It names no forward axis: x is taken, as craft of z up are drawn, and what x becomes where z is turned to
the axis that points up.
"""

from __future__ import annotations

from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from august_jax.scene.mesh_files.polygons import triangulated
from august_jax.scene.mesh_files.surface import (
    DamagedMesh,
    Declared,
    Surface,
    check_places,
    check_surface,
    fan_faces,
    joined,
    placed,
    strip_faces,
)

_UP = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
_SURFACES = {"triangles", "polylist", "polygons", "tristrips", "trifans"}
_TRANSFORMS = {"matrix", "translate", "rotate", "scale", "skew", "lookat"}


def read_dae(content: bytes) -> tuple[Surface, Declared]:
    """The surface of a COLLADA file's content, and its unit and axes.

    Raises:
        DamagedMesh: the file is no well-formed XML, refers to what it does not hold, or shows what is not read here.
    """
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise DamagedMesh(f"no well-formed XML, {error}; it was cut off or edited by hand: export it again") from None
    for element in root.iter():
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    # exporters give one id to things of different kinds
    ids = {(element.tag, element.get("id", "")): element for element in root.iter()}
    document = _Document(ids, {})
    scene = root.find("scene/instance_visual_scene")
    if scene is not None:
        scene = document.named(scene, "url", "visual_scene")
    else:
        scene = root.find("library_visual_scenes/visual_scene")
    if scene is None:
        raise DamagedMesh("it holds no scene, so that no mesh has a place in it; export it again")
    parts: list[Surface] = []
    for node in scene.findall("node"):
        _walk(document, node, np.eye(4), parts, ())
    return joined(parts), _declared(root)


class _Document(NamedTuple):
    ids: dict[tuple[str, str], ElementTree.Element]
    meshes: dict[int, Surface]
    """Geometries read, by identity: nodes share them."""

    def named(self, element: ElementTree.Element, attribute: str, *kinds: str) -> ElementTree.Element:
        """What an element refers to, of one of the kinds given."""
        name = element.get(attribute, "")
        for kind in kinds:
            if name.startswith("#") and (kind, name[1:]) in self.ids:
                return self.ids[kind, name[1:]]
        raise DamagedMesh(
            f"<{element.tag} {attribute}={name!r}> refers to no <{kinds[0]}> of the file; export the mesh as one file"
        )


def _declared(root: ElementTree.Element) -> Declared:
    unit, axis = root.find("asset/unit"), root.find("asset/up_axis")
    meter = unit.get("meter", "1") if unit is not None else "1"
    metres = _numbers(meter, "<unit>")
    up = (axis.text or "").strip().upper() if axis is not None else "Y_UP"
    if up not in _UP:
        raise DamagedMesh(f"<up_axis> is {up!r}; wanted one of {', '.join(_UP)}")
    if not (len(metres) == 1 and np.isfinite(metres[0]) and metres[0] > 0.0):
        raise DamagedMesh(f"<unit> is meter={meter!r}; wanted a positive number of metres")
    default = "COLLADA's default"
    # of the frames that COLLADA lists, x of the one with z up is x of the one with y up and -y of the one with x up
    return Declared(
        float(metres[0]),
        _UP[up],
        None,
        ("its <unit>" if unit is not None else default, "its <up_axis>" if axis is not None else default, ""),
    )


def _walk(
    document: _Document,
    node: ElementTree.Element,
    parent: np.ndarray,
    parts: list[Surface],
    above: tuple[ElementTree.Element, ...],
) -> None:
    """Append the surfaces of a node and of those below it, placed."""
    if node in above:
        raise DamagedMesh(f"node {node.get('id')!r} holds itself; export it again")
    matrix, unread = parent, ""
    for element in node:
        if element.tag in ("skew", "lookat"):
            unread = element.tag  # cameras have them
        elif element.tag in _TRANSFORMS:
            matrix = matrix @ _matrix(element)
        elif element.tag == "instance_controller":
            raise DamagedMesh(
                "it shows a skinned or morphed mesh (<instance_controller>), which is not read here; "
                "apply its armature and export it again"
            )
        elif element.tag == "instance_geometry":
            if unread:
                raise DamagedMesh(
                    f"a mesh is placed by <{unread}>, which is not read here; apply the transforms and export it again"
                )
            geometry = document.named(element, "url", "geometry")
            if id(geometry) not in document.meshes:
                document.meshes[id(geometry)] = _geometry(document, geometry)
            parts.append(placed(document.meshes[id(geometry)], matrix))
        elif element.tag == "instance_node":
            _walk(document, document.named(element, "url", "node"), matrix, parts, (*above, node))
        elif element.tag == "node":
            _walk(document, element, matrix, parts, (*above, node))


def _matrix(element: ElementTree.Element) -> np.ndarray:
    """The (4, 4) of a <matrix>, <translate>, <rotate> (axis and degrees) or <scale>."""
    values = _numbers(element.text, f"<{element.tag}>")
    wanted = {"matrix": 16, "translate": 3, "rotate": 4, "scale": 3}[element.tag]
    if len(values) != wanted:
        raise DamagedMesh(f"<{element.tag}> has {len(values)} numbers; wanted {wanted}")
    if element.tag == "matrix":
        return values.reshape(4, 4)
    matrix = np.eye(4)
    if element.tag == "translate":
        matrix[:3, 3] = values
    elif element.tag == "scale":
        matrix[:3, :3] = np.diag(values)
    elif np.any(values[:3]):
        x, y, z = values[:3] / np.linalg.norm(values[:3])
        angle = np.radians(values[3])
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return matrix


def _geometry(document: _Document, geometry: ElementTree.Element) -> Surface:
    """All triangles of a <geometry>."""
    name = f"geometry {geometry.get('id')!r}"
    mesh = geometry.find("mesh")
    if mesh is None:
        if geometry.find("spline") is not None:
            return joined([])  # a curve
        raise DamagedMesh(f"{name} holds no <mesh>, and nothing else is read here; export it as a mesh")
    return joined([_primitive(document, element, name) for element in mesh if element.tag in _SURFACES])


def _primitive(document: _Document, element: ElementTree.Element, name: str) -> Surface:
    """Triangles of one <triangles>, <polylist>, <polygons>, <tristrips> or <trifans>."""
    if element.find("ph") is not None:
        raise DamagedMesh(
            f"{name} has polygons with holes (<ph>), which are not read here; triangulate it and export it again"
        )
    inputs = element.findall("input")
    lists = [_numbers(indices.text, "<p>").astype(np.int64) for indices in element.findall("p")]
    source = next((entry for entry in inputs if entry.get("semantic") == "VERTEX"), None)
    if source is None:
        if not any(map(len, lists)):
            return joined([])
        raise DamagedMesh(f"{name}: <{element.tag}> has no VERTEX input; export it again")
    stride = 1 + max(int(entry.get("offset", 0)) for entry in inputs)
    lists = [indices.reshape(-1, stride)[:, int(source.get("offset", 0))] for indices in lists]
    vertices = check_places(_positions(document, document.named(source, "source", "vertices", "source")), name)
    corners = np.concatenate([np.zeros(0, np.int64), *lists])
    stated = int(element.get("count", -1))
    if element.tag == "triangles":
        counts = np.full(len(corners) // 3, 3)
    elif element.tag == "polylist":
        counts = _numbers(element.findtext("vcount"), "<vcount>").astype(np.int64)
    else:
        counts = np.array([len(indices) for indices in lists], np.int64)
    if counts.sum() != len(corners) or (stated >= 0 and stated != len(counts)):
        raise DamagedMesh(
            f"{name}: <{element.tag}> states {stated if stated >= 0 else 'no number of'} faces, holds {len(counts)}, "
            f"and has {len(corners)} corners where {int(counts.sum())} are wanted; export it again"
        )
    if element.tag in ("tristrips", "trifans"):
        cut = strip_faces if element.tag == "tristrips" else fan_faces
        faces = np.concatenate([np.zeros((0, 3), np.int64), *(cut(part) for part in lists if len(part) >= 3)])
    else:
        faces = triangulated(vertices, counts, corners)
    return check_surface(vertices, faces, name)


def _positions(document: _Document, vertices: ElementTree.Element) -> np.ndarray:
    """Places (V, 3) of a <vertices>, or of a <source> that stands for it."""
    if vertices.tag == "vertices":
        entry = next((entry for entry in vertices.findall("input") if entry.get("semantic") == "POSITION"), None)
        if entry is None:
            raise DamagedMesh(f"<vertices id={vertices.get('id')!r}> has no POSITION; export it again")
        vertices = document.named(entry, "source", "source")
    accessor, array = vertices.find("technique_common/accessor"), vertices.find("float_array")
    if accessor is None or array is None:
        raise DamagedMesh(f"<source id={vertices.get('id')!r}> has no <float_array> with its <accessor>")
    values = _numbers(array.text, "<float_array>")
    count, stride = int(accessor.get("count", 0)), int(accessor.get("stride", 1))
    first = int(accessor.get("offset", 0))
    if stride < 3 or first + count * stride > len(values) or len(values) != int(array.get("count", len(values))):
        raise DamagedMesh(
            f"<source id={vertices.get('id')!r}>: {count} places of {stride} numbers are wanted, and "
            f"{len(values)} numbers are there; export it again"
        )
    return values[first : first + count * stride].reshape(count, stride)[:, :3]


def _numbers(text: str | None, what: str) -> np.ndarray:
    try:
        return np.array((text or "").split(), dtype=np.float64)
    except ValueError as error:
        raise DamagedMesh(f"{what} holds what is no number ({error})") from None
