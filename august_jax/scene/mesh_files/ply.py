"""PLY, text and binary of either byte order: ``vertex`` with x, y, z, and ``face`` or ``tristrips`` with their lists.

The header names elements, the number of their rows and the type of each property; a list is a count and as many
values. Text is read as binary whose every number takes eight bytes.
"""

from __future__ import annotations

import numpy as np

from august_jax.scene.mesh_files.polygons import triangulated
from august_jax.scene.mesh_files.surface import DamagedMesh, Surface, check_places, check_surface, strip_faces

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float16": "f2",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_INDICES = ("vertex_indices", "vertex_index")

_Property = tuple[str, np.dtype | None, np.dtype]
"""Name, type of the count (None of what is no list), type of the values."""


def read_ply(content: bytes) -> Surface:
    """The surface of a PLY file's content.

    Raises:
        DamagedMesh: the header is none, names no vertices, or the file ends before its rows do.
    """
    elements, body = _header(content)
    table = _Table(body)
    for element in elements:
        table.read(*element)
    missing = [axis for axis in "xyz" if ("vertex", axis) not in table.columns]
    if missing:
        raise DamagedMesh(f"its header names no vertex property {missing[0]!r}; wanted an element vertex with x, y, z")
    vertices = check_places(np.stack([table.columns["vertex", axis] for axis in "xyz"], axis=-1))
    faces = [np.zeros((0, 3), np.int64)]
    for name in _INDICES:
        if ("face", name) in table.lists:
            counts, corners = table.lists["face", name]
            faces.append(triangulated(vertices, counts, corners.astype(np.int64)))
        if ("tristrips", name) in table.lists:
            corners = table.lists["tristrips", name][1].astype(np.int64)
            strips = np.split(corners, np.flatnonzero(corners == -1))  # -1 begins a strip anew
            faces += [strip_faces(strip[strip != -1]) for strip in strips if (strip != -1).sum() >= 3]
    return check_surface(vertices, np.concatenate(faces))


def _header(content: bytes) -> tuple[list[tuple[str, int, list[_Property]]], bytes]:
    """Elements (name, rows, properties) and the rows' bytes."""
    head, found, body = content.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    if not found or not lines or lines[0] != ["ply"]:
        raise DamagedMesh("its header does not run from 'ply' to 'end_header'")
    order = next((_ORDERS.get(line[1]) for line in lines if line[:1] == ["format"] and len(line) > 1), None)
    if order is None:
        raise DamagedMesh(f"its header names no format among {', '.join(_ORDERS)}")
    text = ["format", "ascii"] in [line[:2] for line in lines]
    elements: list[tuple[str, int, list[_Property]]] = []
    try:
        for line in lines:
            if line[:1] == ["element"]:
                elements.append((line[1], int(line[2]), []))
            elif line[:1] == ["property"]:
                kinds = [np.dtype(order + _TYPES[kind]) for kind in line[1:-1] if kind != "list"]
                kinds = [np.dtype("<f8") for _ in kinds] if text else kinds
                elements[-1][2].append((line[-1], kinds[0] if line[1] == "list" else None, kinds[-1]))
    except (IndexError, KeyError, ValueError):
        raise DamagedMesh(f"its header has a line that is no PLY: {' '.join(line)[:60]!r}") from None
    body = body[2:] if body[:2] == b"\r\n" else body[1:]
    if text:
        try:
            body = np.array(body.split(), dtype=np.float64).tobytes()
        except ValueError as error:
            raise DamagedMesh(f"a value is no number ({error})") from None
    return elements, body


class _Table:
    """Columns of elements, read one element after the other.

    Attributes:
        columns: values of a property that is no list, by (element, property).
        lists: lengths (rows,) and values, list after list, of one that is.
    """

    def __init__(self, body: bytes) -> None:
        self.body, self.offset = body, 0
        self.columns: dict[tuple[str, str], np.ndarray] = {}
        self.lists: dict[tuple[str, str], tuple[np.ndarray, np.ndarray]] = {}

    def read(self, name: str, rows: int, properties: list[_Property]) -> None:
        """Read an element at once where the lists of all rows are as long as those of the first, else row by row."""
        lengths = self.lengths(properties) if rows else None
        if lengths is None or not self.at_once(name, rows, properties, lengths):
            self.row_by_row(name, rows, properties)

    def at_once(self, name: str, rows: int, properties: list[_Property], lengths: list[int]) -> bool:
        """Read rows whose lists have these lengths; False, and nothing read, where they have not."""
        fields: list[tuple] = []
        for (label, count, kind), length in zip(properties, lengths):
            fields += [(f"{label} count", count), (label, kind, (length,))] if count is not None else [(label, kind)]
        row = np.dtype(fields)
        if self.offset + rows * row.itemsize > len(self.body):
            return False
        table = np.frombuffer(self.body, row, rows, self.offset)
        lists = [(label, length) for (label, count, _), length in zip(properties, lengths) if count is not None]
        if not all((table[f"{label} count"] == length).all() for label, length in lists):
            return False
        self.columns |= {(name, label): table[label] for label, count, _ in properties if count is None}
        self.lists |= {
            (name, label): (np.full(rows, length, np.int64), table[label].reshape(-1)) for label, length in lists
        }
        self.offset += rows * row.itemsize
        return True

    def row_by_row(self, name: str, rows: int, properties: list[_Property]) -> None:
        """Read rows whose lists differ in length."""
        values: dict[str, list[np.ndarray]] = {label: [] for label, _, _ in properties}
        counts: dict[str, list[int]] = {label: [] for label, _, _ in properties}
        for row in range(rows):
            lengths = self.lengths(properties)
            if lengths is None:
                raise DamagedMesh(
                    f"it ends in row {row + 1} of the {rows} of its element {name!r}; it was cut off, or "
                    "its header is wrong: export it again"
                )
            for (label, count, kind), length in zip(properties, lengths):
                self.offset += count.itemsize if count is not None else 0
                values[label].append(np.frombuffer(self.body, kind, length, self.offset))
                counts[label].append(length)
                self.offset += length * kind.itemsize
        for label, count, kind in properties:
            column = np.concatenate([np.zeros(0, kind), *values[label]])
            if count is None:
                self.columns[name, label] = column
            else:
                self.lists[name, label] = np.array(counts[label], np.int64), column

    def lengths(self, properties: list[_Property]) -> list[int] | None:
        """Number of values of each property of the next row; None where the file ends in it."""
        lengths, offset = [], self.offset
        for _, count, kind in properties:
            length = 1
            if count is not None:
                if offset + count.itemsize > len(self.body):
                    return None
                length = int(np.frombuffer(self.body, count, 1, offset)[0])
                offset += count.itemsize
            lengths.append(length)
            offset += kind.itemsize * length
            if length < 0 or offset > len(self.body):
                return None
        return lengths
