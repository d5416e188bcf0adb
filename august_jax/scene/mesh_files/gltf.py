"""glTF 2.0, as .gltf with its buffers beside it or inside it, and as .glb (Khronos, ISO/IEC 12113).

Read are the nodes of the default scene at rest, their meshes' POSITION and indices, sparse accessors and quantised
ones, triangles, strips and fans, morph targets at their default weights and skins in their rest pose. The standard
fixes metres, y up and z forward.

Extensions of materials, textures, lights and the like do not move a vertex and are passed over. Any other that the
file says it requires is refused by its name, as are those that put geometry where plain glTF does not look.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote

import numpy as np

from august_jax.scene.mesh_files.surface import (
    DamagedMesh,
    Declared,
    Surface,
    check_surface,
    fan_faces,
    joined,
    placed,
    strip_faces,
)

DECLARED = Declared(1.0, "y", "z", ("glTF", "glTF", "glTF"))
"""What the standard fixes."""

_HARMLESS = re.compile(
    r"KHR_(materials_\w+|texture_\w+|techniques_webgl|lights_\w+|animation_pointer|xmp\w*|mesh_quantization)"
    r"|EXT_(texture_\w+|lights_\w+|mesh_features|structural_metadata|instance_features|mesh_primitive_edge_visibility)"
    r"|MSFT_(texture_dds|packing_\w+)|AGI_\w+|CESIUM_primitive_outline|GODOT_single_root"
)
"""Extensions that leave every vertex and face where it is, or (quantisation) that are read."""
_ELSEWHERE = {
    "KHR_draco_mesh_compression": "primitive",
    "EXT_meshopt_compression": "view",
    "KHR_meshopt_compression": "view",
    "EXT_mesh_gpu_instancing": "node",
    "KHR_node_visibility": "node",
}
"""Extensions that change geometry even where they are not required, and where they stand."""
_WAY_OUT = "export the mesh without it (such as uncompressed), or as STL or PLY"

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_NO_TRIANGLES = {0, 1, 2, 3}
"""Modes of points and lines."""


def read_gltf(content: bytes, fetch: Callable[[str], bytes]) -> Surface:
    """The surface of a .gltf or .glb file's content.

    Args:
        content: the file.
        fetch: content of a file that is named relative to this one.

    Raises:
        DamagedMesh: the file is cut off or contradicts itself, or needs an extension that is not read here.
    """
    document, binary = _chunks(content)
    for name in document.get("extensionsRequired", []):
        if not _HARMLESS.fullmatch(name):
            raise DamagedMesh(f"it requires the glTF extension {name}, which is not read here; {_WAY_OUT}")
    reader = _Reader(document, binary, fetch)
    nodes = document.get("nodes", [])
    scenes = document.get("scenes", [])
    if scenes:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
    world: dict[int, np.ndarray] = {}
    pending = [(root, np.eye(4)) for root in roots]
    while pending:
        index, parent = pending.pop()
        if index in world:
            raise DamagedMesh(f"node {index} is reached twice; a glTF scene is a tree: export it again")
        _refuse_elsewhere(nodes[index], "node")
        world[index] = parent @ _local(nodes[index])
        pending += [(child, world[index]) for child in nodes[index].get("children", [])]
    return joined(
        [
            part
            for index in sorted(world)
            if "mesh" in nodes[index]
            for part in reader.parts(nodes[index], world[index], world)
        ]
    )


class _Reader:
    """Accessors of one document."""

    def __init__(self, document: dict[str, Any], binary: bytes, fetch: Callable[[str], bytes]) -> None:
        self.document, self.binary, self.fetch = document, binary, fetch
        self.buffers: dict[int, bytes] = {}

    def parts(self, node: dict[str, Any], matrix: np.ndarray, world: dict[int, np.ndarray]) -> list[Surface]:
        """Surfaces of a node's mesh, placed by its matrix, or by the joints of its skin."""
        mesh = self.document["meshes"][node["mesh"]]
        weights = node.get("weights", mesh.get("weights", []))
        parts = []
        for number, primitive in enumerate(mesh["primitives"]):
            mode = primitive.get("mode", 4)
            if mode in _NO_TRIANGLES:
                continue
            _refuse_elsewhere(primitive, "primitive")
            name = f"mesh {mesh.get('name', node['mesh'])!r}, primitive {number}"
            vertices = self.accessor(primitive["attributes"]["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", [])):
                if weight and "POSITION" in target:
                    vertices = vertices + weight * self.accessor(target["POSITION"])
            if "indices" in primitive:
                corners = self.accessor(primitive["indices"]).reshape(-1).astype(np.int64)
            else:
                corners = np.arange(len(vertices))
            if mode not in (4, 5, 6) or len(corners) < 3 or (mode == 4 and len(corners) % 3):
                raise DamagedMesh(f"{name}: {len(corners)} corners make no triangles of mode {mode}; export it again")
            faces = corners.reshape(-1, 3) if mode == 4 else (strip_faces if mode == 5 else fan_faces)(corners)
            surface = check_surface(vertices, faces, name)
            if "skin" in node and "JOINTS_0" in primitive["attributes"]:
                surface = surface._replace(vertices=self.skinned(surface.vertices, primitive, node["skin"], world))
                parts.append(check_surface(*surface, name))
            else:
                parts.append(placed(surface, matrix))
        return parts

    def skinned(
        self, vertices: np.ndarray, primitive: dict[str, Any], index: int, world: dict[int, np.ndarray]
    ) -> np.ndarray:
        """Vertices in the rest pose: sum over joints of weight * (joint in the world) * (inverse of its bind)."""
        skin = self.document["skins"][index]
        joints = np.stack([world.get(joint, np.eye(4)) for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            joints = joints @ np.swapaxes(self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4), 1, 2)
        moved, total = np.zeros_like(vertices), np.zeros((len(vertices), 1))
        homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        attributes = primitive["attributes"]
        for group in range(sum(name.startswith("JOINTS_") for name in attributes)):
            which = self.accessor(attributes[f"JOINTS_{group}"]).astype(np.int64)
            share = self.accessor(attributes[f"WEIGHTS_{group}"])
            for column in range(which.shape[1]):
                moved += share[:, column, None] * np.einsum("vab,vb->va", joints[which[:, column], :3], homogeneous)
                total += share[:, column, None]
        return moved / total

    def accessor(self, index: int) -> np.ndarray:
        """Numbers (count, width) float64 of an accessor, its sparse part put in."""
        accessor = self.document["accessors"][index]
        count, width = accessor["count"], _WIDTHS[accessor["type"]]
        kind = np.dtype(_COMPONENTS[accessor["componentType"]])
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            values = self.view(accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width).copy()
        elif sparse:
            values = np.zeros((count, width), kind)
        else:
            raise DamagedMesh(f"accessor {index} holds no data, only an extension may; {_WAY_OUT}")
        if sparse:
            where, what = sparse["indices"], sparse["values"]
            places = self.view(
                where["bufferView"],
                where.get("byteOffset", 0),
                np.dtype(_COMPONENTS[where["componentType"]]),
                sparse["count"],
                1,
            )[:, 0]
            if len(places) and places.max() >= count:
                raise DamagedMesh(f"accessor {index}: its sparse part names element {places.max()} of {count}")
            values[places] = self.view(what["bufferView"], what.get("byteOffset", 0), kind, sparse["count"], width)
        numbers = values.astype(np.float64)
        if accessor.get("normalized") and kind.kind in "iu":
            numbers = np.maximum(numbers / np.iinfo(kind).max, -1.0)
        return numbers

    def view(self, index: int, offset: int, kind: np.dtype, count: int, width: int) -> np.ndarray:
        """Elements (count, width) of a buffer view, from a byte offset in it."""
        view = self.document["bufferViews"][index]
        _refuse_elsewhere(view, "view")
        buffer = self.buffer(view["buffer"])
        start, size = view.get("byteOffset", 0), width * kind.itemsize
        stride = view.get("byteStride", size)
        end = offset + (count - 1) * stride + size if count else offset
        if min(start, offset) < 0 or end > view["byteLength"] or start + view["byteLength"] > len(buffer):
            raise DamagedMesh(
                f"buffer view {index}: {count} elements end at byte {start + end} of a buffer that holds "
                f"{min(len(buffer), start + view['byteLength'])}; the file was cut off: export it again"
            )
        return np.ndarray((count, width), kind, buffer, start + offset, (stride, kind.itemsize))

    def buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            uri = self.document["buffers"][index].get("uri")
            if uri is None and index == 0 and self.binary:
                self.buffers[index] = self.binary
            elif uri is None:
                raise DamagedMesh(f"buffer {index} is nowhere: it has no uri, and the file no binary chunk for it")
            elif uri.startswith("data:"):
                self.buffers[index] = base64.b64decode(uri.partition(",")[2])
            else:
                self.buffers[index] = self.fetch(unquote(uri))
        return self.buffers[index]


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary buffer of a .glb; of a .gltf the latter is empty."""
    binary = b""
    if content[:4] == b"glTF":
        number, length = (int.from_bytes(content[place : place + 4], "little") for place in (4, 8))
        if number != 2:
            raise DamagedMesh(f"it is glTF {number}, and glTF 2 is read here; export it as glTF 2.0")
        if length > len(content) or len(content) < 20:
            raise DamagedMesh(f"its header states {length} bytes, but it has {len(content)}; it was cut off")
        chunks: dict[bytes, bytes] = {}
        offset = 12
        while offset + 8 <= length:
            size = int.from_bytes(content[offset : offset + 4], "little")
            chunks.setdefault(content[offset + 4 : offset + 8], content[offset + 8 : offset + 8 + size])
            offset += 8 + size
        content, binary = chunks.get(b"JSON", b""), chunks.get(b"BIN\0", b"")
    try:
        document = json.loads(content)
        version = str(document["asset"]["version"])
    except (ValueError, KeyError, TypeError):
        raise DamagedMesh("it holds no JSON document with asset.version, as glTF does") from None
    if version.split(".")[0] != "2":
        raise DamagedMesh(f"it is glTF {version}, and glTF 2 is read here; export it as glTF 2.0")
    return document, binary


def _local(node: dict[str, Any]) -> np.ndarray:
    """Matrix (4, 4) of a node: given by columns, or T R S."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _refuse_elsewhere(item: dict[str, Any], place: str) -> None:
    for name in item.get("extensions", {}):
        if _ELSEWHERE.get(name) == place:
            raise DamagedMesh(f"it uses the glTF extension {name}, which is not read here; {_WAY_OUT}")
