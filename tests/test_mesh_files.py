"""Mesh files: areas against closed forms, axes and units of every format, and what is refused, with its count."""

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from august_jax.scene import load_airframe, procedural_airframe
from august_jax.scene.mesh_files import FORMATS, read_mesh
from august_jax.scene.mesh_files.polygons import triangulated

MESHES = Path(__file__).parents[2] / "shared" / "meshes"
"""Published craft; where they are not at hand their test is skipped."""

L_SHAPE = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)
"""Six corners, area 3."""
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
SIDES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
TETRAHEDRON_AREA = 1.5 + 0.5 * 3**0.5


def area(surface) -> float:
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()


# writers of small files, one a format


def obj(vertices, polygons) -> bytes:
    rows = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f " + " ".join(str(i + 1) for i in p) for p in polygons]
    return "\n".join(rows).encode()


def ply(vertices, polygons, order="ascii", count="uchar", extra=False) -> bytes:
    head = (
        f"ply\nformat {order} 1.0\ncomment made up\nelement vertex {len(vertices)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(polygons)}\n"
        + ("property uchar red\n" if extra else "")
        + f"property list {count} int vertex_indices\n"
        + ("property float quality\n" if extra else "")
        + "end_header\n"
    )
    if order == "ascii":
        rows = [" ".join(map(str, v)) for v in vertices]
        rows += [" ".join(map(str, [*([9] if extra else []), len(p), *p, *([0.5] if extra else [])])) for p in polygons]
        return head.encode() + "\n".join(rows).encode() + b"\n"
    end = "<" if "little" in order else ">"
    body = b"".join(struct.pack(end + "3f", *v) for v in vertices)
    for p in polygons:
        body += struct.pack(end + "B", 9) if extra else b""
        body += struct.pack(end + {"uchar": "B", "int": "i"}[count], len(p)) + struct.pack(f"{end}{len(p)}i", *p)
        body += struct.pack(end + "f", 0.5) if extra else b""
    return head.encode() + body


def stl(vertices, faces, stated=None, header=b"made up") -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *np.ravel(np.asarray(vertices)[face]), 0) for face in faces]
    return header.ljust(80) + struct.pack("<I", len(rows) if stated is None else stated) + b"".join(rows)


def text_stl(vertices, faces) -> bytes:
    rows = ["solid made up"]
    for face in faces:
        corners = "\n".join("vertex {} {} {}".format(*vertices[i]) for i in face)
        rows.append(f"facet normal 0 0 0\nouter loop\n{corners}\nendloop\nendfacet")
    return "\n".join([*rows, "endsolid made up\n"]).encode()


def gltf(vertices, faces, *, sparse=None, nodes=None, mode=4, indexed=True, **document) -> dict:
    """A document with its buffer inside; ``sparse`` takes (indices, values) of POSITION over zeros."""
    blobs, views, accessors = [], [], []

    def add(array, kind, components, **more):
        blobs.append(np.ascontiguousarray(array).tobytes().ljust(-(-array.nbytes // 4) * 4, b"\0"))
        views.append({"buffer": 0, "byteOffset": sum(map(len, blobs[:-1])), "byteLength": array.nbytes})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": components, "count": len(array), "type": kind, **more}
        )
        return len(accessors) - 1

    position = add(np.asarray(vertices, "<f4"), "VEC3", 5126)
    primitive = {"attributes": {"POSITION": position}, "mode": mode}
    if indexed:
        primitive["indices"] = add(np.asarray(faces, "<u2").reshape(-1), "SCALAR", 5123)
    if sparse is not None:
        where, what = add(np.asarray(sparse[0], "<u2"), "SCALAR", 5123), add(np.asarray(sparse[1], "<f4"), "VEC3", 5126)
        del accessors[position]["bufferView"]
        accessors[position]["sparse"] = {
            "count": len(sparse[0]),
            "indices": {"bufferView": where, "componentType": 5123},
            "values": {"bufferView": what},
        }
    data = b"".join(blobs)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": uri}],
        **document,
    }


def glb(document) -> bytes:
    data = base64.b64decode(document["buffers"][0].pop("uri").partition(",")[2])
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def dae(vertices, polygons, *, asset="<up_axis>Z_UP</up_axis>", node="", kind="polylist") -> bytes:
    corners = " ".join(f"{i} 0" for p in polygons for i in p)
    if kind == "polylist":
        body = f"<vcount>{' '.join(str(len(p)) for p in polygons)}</vcount><p>{corners}</p>"
    elif kind == "triangles":
        body = f"<p>{corners}</p>"
    else:  # one list a polygon, strip or fan
        body = "".join("<p>" + " ".join(f"{i} 0" for i in p) + "</p>" for p in polygons)
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{asset}</asset><library_geometries><geometry id="g"><mesh><source id="s">
<float_array id="a" count="{3 * len(vertices)}">{" ".join(str(x) for v in vertices for x in v)}</float_array>
<technique_common><accessor source="#a" count="{len(vertices)}" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices><{kind} count="{len(polygons)}">
<input semantic="VERTEX" source="#v" offset="0"/><input semantic="NORMAL" source="#s" offset="1"/>{body}</{kind}>
</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="scene"><node id="scene">{node}
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>""".encode()


@pytest.fixture
def load(tmp_path):
    def read(name, content, **arguments):
        (tmp_path / name).write_bytes(content)
        return read_mesh(tmp_path / name, **arguments)[0]

    return read


# polygons


def on_a_plane(points) -> np.ndarray:
    """Places (n, 3) of (n, 2) on a plane askew."""
    return np.asarray(points) @ np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]]) + [3.0, -2.0, 5.0]


def star(count: int) -> np.ndarray:
    """A star of 2 count corners with radii 1 and 0.4: its area is count * 0.4 * sin(pi / count)."""
    angle = np.pi * np.arange(2 * count) / count
    return np.where(np.arange(2 * count) % 2, 0.4, 1.0)[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def comb(teeth: int) -> np.ndarray:
    """A bar of height 1 with teeth of width and height 1, one apart: its area is 3 teeth - 1."""
    upper = [point for k in range(teeth) for point in ((2 * k, 2), (2 * k + 1, 2), (2 * k + 1, 1), (2 * k + 2, 1))]
    return np.array([(2 * teeth - 1, 0), (0, 0), *upper[:-2], (2 * teeth - 1, 1)][: 4 * teeth + 2], float)


SQUARE_WITH_HOLE = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]
"""Its hole is joined to its rim by a cut of no width: area 8."""
POLYGONS = {
    "triangle": ([(0, 0), (1, 0), (0, 1)], 0.5),
    "L": (L_SHAPE, 3.0),
    "dart": ([(0, 0), (2, 1), (0, 2), (0.5, 1)], 1.5),
    "star": (star(7), 7 * 0.4 * np.sin(np.pi / 7)),
    "comb": (comb(5), 14.0),
    "hole": (SQUARE_WITH_HOLE, 8.0),
    "straight corners": ([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)], 4.0),
}


@pytest.mark.parametrize("name", POLYGONS)
def test_polygons_keep_their_area_from_every_corner_and_in_both_windings(name):
    corners, expected = POLYGONS[name]
    for winding in (1, -1):
        for first in range(len(corners)):
            places = on_a_plane(np.roll(np.asarray(corners, float)[::winding], first, axis=0))
            faces = triangulated(places, np.array([len(places)]), np.arange(len(places)))
            crosses = np.cross(places[faces[:, 1]] - places[faces[:, 0]], places[faces[:, 2]] - places[faces[:, 0]])
            assert 0.5 * np.linalg.norm(crosses, axis=-1).sum() == pytest.approx(expected)
            assert 0.5 * np.linalg.norm(crosses.sum(axis=0)) == pytest.approx(expected)  # all turn alike


def test_polygons_of_all_sizes_keep_their_order():
    vertices = on_a_plane(np.concatenate([L_SHAPE, L_SHAPE + 5.0]))
    counts = np.array([6, 3, 4, 6, 2])
    corners = np.array([*range(6), 0, 1, 2, 0, 1, 2, 5, *range(6, 12), 0, 1])
    faces = triangulated(vertices, counts, corners)
    assert len(faces) == 4 + 1 + 2 + 4 + 1
    np.testing.assert_array_equal(faces[4], [0, 1, 2])
    np.testing.assert_array_equal(faces[-1], [0, 1, 1])  # no area: the cleaning counts it
    assert (faces[:4] < 6).all() and (faces[7:11] >= 6).all()


WAYS_TO_WRITE = {
    "obj": ("l.obj", obj),
    "ply": ("l.ply", ply),
    "ply little": ("l.ply", lambda v, p: ply(v, p, "binary_little_endian")),
    "ply big": ("l.ply", lambda v, p: ply(v, p, "binary_big_endian", "int", extra=True)),
    "ply extra": ("l.ply", lambda v, p: ply(v, p, extra=True)),
    "dae": ("l.dae", dae),
    "dae polygons": ("l.dae", lambda v, p: dae(v, p, kind="polygons")),
}


@pytest.mark.parametrize("way", WAYS_TO_WRITE)
@pytest.mark.parametrize("mixed", [False, True])
def test_every_format_with_polygons_cuts_concave_ones_rightly(load, way, mixed):
    name, write = WAYS_TO_WRITE[way]
    vertices = np.pad(L_SHAPE, ((0, 0), (0, 1)))
    polygons = [range(6), [0, 1, 2], [0, 1, 2, 3]] if mixed else [range(6)]
    wanted = 3.0 + (1.0 + 1.5 if mixed else 0.0)
    assert area(load(name, write(vertices, [list(p) for p in polygons]))) == pytest.approx(wanted)


# formats


EVERY_FORMAT = {
    **{way: (name, lambda v, f, write=write: write(v, f.tolist())) for way, (name, write) in WAYS_TO_WRITE.items()},
    "stl": ("t.stl", stl),
    "stl that begins with solid": ("t.stl", lambda v, f: stl(v, f, header=b"solid binary")),
    "text stl": ("t.stl", text_stl),
    "gltf": ("t.gltf", lambda v, f: json.dumps(gltf(v, f)).encode()),
    "glb": ("t.glb", lambda v, f: glb(gltf(v, f))),
    "glb without indices": ("t.glb", lambda v, f: glb(gltf(v[f].reshape(-1, 3), None, indexed=False))),
    "sparse gltf": ("t.gltf", lambda v, f: json.dumps(gltf(v, f, sparse=([1, 2, 3], v[1:]))).encode()),
    "dae triangles": ("t.dae", lambda v, f: dae(v, f, kind="triangles")),
}


@pytest.mark.parametrize("way", EVERY_FORMAT)
def test_every_format_gives_the_same_surface(load, way):
    name, write = EVERY_FORMAT[way]
    surface = load(name, write(TETRAHEDRON, SIDES), unit=1.0, **({} if "gl" in way else {"up": "z", "forward": "x"}))
    assert len(surface.faces) == 4 and area(surface) == pytest.approx(TETRAHEDRON_AREA)
    volume = np.linalg.det(surface.vertices[surface.faces]).sum() / 6
    assert volume == pytest.approx(1 / 6)  # wound outward


STRIP = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], float)


@pytest.mark.parametrize(
    "name, content, wanted",
    [
        ("strip.glb", glb(gltf(STRIP, range(5), mode=5)), 1.5),
        ("fan.glb", glb(gltf(STRIP, [0, 1, 3, 4], mode=6)), 1.5),
        ("strip.dae", dae(STRIP, [range(5)], kind="tristrips"), 1.5),
        ("fan.dae", dae(STRIP, [[0, 1, 3, 4]], kind="trifans"), 1.5),
        (
            "strip.ply",
            b"ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
            b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
            b"0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 2 0\n9 0 1 2 3 -1 2 3 4 -1\n",
            1.5,
        ),
    ],
)
def test_strips_and_fans(load, name, content, wanted):
    surface = load(name, content)
    assert area(surface) == pytest.approx(wanted)
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a).sum(axis=0)) == pytest.approx(2 * wanted)  # all turn alike


def test_negative_indices_count_back_from_the_vertices_before_them(load):
    square = "v 0 0 {z}\nv 1 0 {z}\nv 1 1 {z}\nv 0 1 {z}\nf -4//1 -3//1 -2//1 -1//1\n"
    surface = load("two.obj", ("o a\n" + square.format(z=0) + "o b\n" + square.format(z=5)).encode())
    assert area(surface) == pytest.approx(2.0)
    assert sorted(surface.vertices[surface.faces][..., 2].mean(axis=1)) == [0, 0, 5, 5]


def test_obj_takes_comments_continued_lines_and_colours(load):
    text = b"# f 1 2 3\nv 0 0 0 1 0 0\r\nv 1 0 0 # here\nv 0 1 0\nvn 0 0 1\nf 1/2/1 \\\n2/2/1 3/1/1\nl 1 2\n"
    assert area(load("odd.obj", text)) == pytest.approx(0.5)


def test_scene_transforms_apply_and_mirrors_keep_faces_outward(load, tmp_path):
    nodes = [
        {"children": [1, 2], "translation": [0, 0, 1], "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},  # 90 degrees about z
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
    ]
    surface = load("two.glb", glb(gltf(TETRAHEDRON, SIDES, nodes=nodes)))
    assert area(surface) == pytest.approx(8 * TETRAHEDRON_AREA)
    assert np.linalg.det(surface.vertices[surface.faces]).sum() / 6 == pytest.approx(2 * 8 / 6)
    # the file's x, y, z are left, up and forward: the first copy spans x in [-2, 0], the mirrored one in [8, 10]
    np.testing.assert_allclose([surface.vertices.min(0), surface.vertices.max(0)], [[1, -2, 0], [3, 10, 2]], atol=1e-6)
    node = "<translate>0 0 1</translate><rotate>0 0 1 90</rotate><scale>2 2 2</scale>"
    surface = load("placed.dae", dae(TETRAHEDRON, SIDES, node=node))
    np.testing.assert_allclose([surface.vertices.min(0), surface.vertices.max(0)], [[-2, 0, 1], [0, 2, 3]], atol=1e-12)


def test_quantised_places_and_skins_and_morphs_are_read(load):
    document = gltf(TETRAHEDRON, SIDES, extensionsRequired=["KHR_mesh_quantization"], extensionsUsed=[])
    data = bytearray(base64.b64decode(document["buffers"][0]["uri"].partition(",")[2]))
    data[:24] = np.asarray(TETRAHEDRON * 32767, "<i2").tobytes()
    document["accessors"][0] |= {"componentType": 5122, "normalized": True}
    document["bufferViews"][0]["byteStride"] = 6
    document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(data).decode()
    assert area(load("short.gltf", json.dumps(document).encode())) == pytest.approx(TETRAHEDRON_AREA)

    morph = gltf(TETRAHEDRON, SIDES)
    morph["meshes"][0]["weights"] = [1.0]
    morph["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]  # each place moved by itself: twice as large
    assert area(load("morph.gltf", json.dumps(morph).encode())) == pytest.approx(4 * TETRAHEDRON_AREA)

    joint = {"nodes": [{"mesh": 0, "skin": 0, "translation": [7, 7, 7]}, {"scale": [3, 3, 3]}]}
    skin = gltf(TETRAHEDRON, SIDES, skins=[{"joints": [1, 1, 1, 1]}], **joint)
    skin["scenes"][0]["nodes"] = [0, 1]
    extra = np.zeros((4, 4), "u1").tobytes() + np.tile(np.asarray([1, 0, 0, 0], "<f4"), (4, 1)).tobytes()
    data = base64.b64decode(skin["buffers"][0]["uri"].partition(",")[2])
    skin["bufferViews"] += [
        {"buffer": 0, "byteOffset": len(data), "byteLength": 16},
        {"buffer": 0, "byteOffset": len(data) + 16, "byteLength": 64},
    ]
    skin["accessors"] += [
        {"bufferView": 2, "componentType": 5121, "count": 4, "type": "VEC4"},
        {"bufferView": 3, "componentType": 5126, "count": 4, "type": "VEC4"},
    ]
    skin["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_0": 2, "WEIGHTS_0": 3}
    skin["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(data + extra).decode()
    surface = load("skin.gltf", json.dumps(skin).encode())
    assert area(surface) == pytest.approx(9 * TETRAHEDRON_AREA)
    assert surface.vertices.max() == pytest.approx(3.0)  # a skin's joints place it, its node does not


def test_a_gltf_takes_its_buffer_from_beside_it(load, tmp_path):
    document = gltf(TETRAHEDRON, SIDES)
    (tmp_path / "my data.bin").write_bytes(base64.b64decode(document["buffers"][0]["uri"].partition(",")[2]))
    document["buffers"][0]["uri"] = "my%20data.bin"
    assert area(load("beside.gltf", json.dumps(document).encode())) == pytest.approx(TETRAHEDRON_AREA)
    document["buffers"][0]["uri"] = "gone.bin"
    with pytest.raises(ValueError, match=r"beside.gltf: .* its buffer 'gone.bin' cannot be read"):
        load("beside.gltf", json.dumps(document).encode())


# unit and axes


PLATE = np.array([[-0.125, -0.25, 0], [0.125, -0.25, 0], [0.125, 0.25, 0], [-0.125, 0.25, 0]])
"""A plate in body axes: 0.25 m along x, 0.5 m along y, flat along z."""
TO_GLTF = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])
"""Body to file: x left, y up, z forward."""
TO_Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
"""Body to file: x forward, y up."""
MM_Y_UP = '<unit name="millimeters" meter="10e-4"/><up_axis>Y_UP</up_axis>'


def plate_file(kind, to_file=None, scale=1.0, **arguments) -> tuple[str, bytes]:
    places = scale * PLATE @ np.asarray(to_file).T
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    write = {
        "glb": lambda: glb(gltf(places, faces)),
        "gltf": lambda: json.dumps(gltf(places, faces)).encode(),
        "dae": lambda: dae(places, faces, **arguments),
        "obj": lambda: obj(places, faces.tolist()),
        "stl": lambda: stl(places, faces),
        "ply": lambda: ply(places, faces.tolist()),
    }[kind]
    return f"plate.{kind}", write()


STANDS = {
    "glTF fixes all": (plate_file("glb", TO_GLTF), {}, "unit 1 m (glTF), up y (glTF), forward z (glTF)"),
    "gltf": (plate_file("gltf", TO_GLTF), {}, "unit 1 m (glTF), up y (glTF), forward z (glTF)"),
    "its own unit and axis": (
        plate_file("dae", TO_Y_UP, 1000, asset=MM_Y_UP),
        {},
        "unit 0.001 m (its <unit>), up y (its <up_axis>), forward x (assumed",
    ),
    "COLLADA, z up": (plate_file("dae", np.eye(3)), {}, "up z (its <up_axis>)"),
    "COLLADA, x up": (
        plate_file("dae", [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], asset="<up_axis>X_UP</up_axis>"),
        {},
        "up x (its <up_axis>), forward -y (assumed",
    ),
    "COLLADA that says nothing": (
        plate_file("dae", TO_Y_UP, asset=""),
        {},
        "unit 1 m (COLLADA's default), up y (COLLADA's default)",
    ),
    "OBJ": (plate_file("obj", np.eye(3)), {}, "unit 1 m (assumed: the file says nothing), up z (assumed"),
    "STL": (plate_file("stl", np.eye(3)), {}, "forward x (assumed"),
    "PLY": (plate_file("ply", np.eye(3)), {}, "forward x (assumed"),
    "STL that is told": (
        plate_file("stl", TO_GLTF, 100),
        {"unit": "cm", "up": "y", "forward": "z"},
        "unit 0.01 m (given), up y (given), forward z (given)",
    ),
    "PLY told its upward axis": (plate_file("ply", TO_Y_UP), {"up": "y"}, "up y (given), forward x (assumed"),
}


@pytest.mark.parametrize("name", STANDS)
def test_a_craft_stands_as_its_file_says(tmp_path, name):
    (file, content), arguments, told = STANDS[name]
    (tmp_path / file).write_bytes(content)
    craft = load_airframe(tmp_path / file, **arguments)
    np.testing.assert_allclose(craft.mesh.extents, [0.25, 0.5, 0.0], atol=1e-7)
    assert told in str(craft.source) and craft.source.path == str(tmp_path / file)
    again, source = read_mesh(tmp_path / file, **craft.source.arguments())
    np.testing.assert_allclose(np.ptp(again.vertices, axis=0), [0.25, 0.5, 0.0], atol=1e-7)
    assert json.loads(json.dumps(source.record()))["up_from"] == "given"


@pytest.mark.parametrize(
    "file, arguments, message",
    [
        (plate_file("glb", TO_GLTF), {"up": "z"}, r"declares up y \(glTF\), but is read with up='z'"),
        (plate_file("glb", TO_GLTF), {"forward": "x"}, r"declares forward z \(glTF\), but is read with forward='x'"),
        (plate_file("glb", TO_GLTF), {"unit": "mm"}, r"declares a unit of 1 m \(glTF\), but is read with unit=0.001 m"),
        (plate_file("dae", TO_Y_UP, asset=MM_Y_UP), {"unit": "m"}, "declares a unit of 0.001 m"),
        (plate_file("dae", TO_Y_UP, asset=MM_Y_UP), {"up": "z"}, r"declares up y \(its <up_axis>\)"),
    ],
)
def test_an_argument_wins_and_a_contradiction_is_told(tmp_path, file, arguments, message):
    (tmp_path / file[0]).write_bytes(file[1])
    with pytest.warns(UserWarning, match=message):
        craft = load_airframe(tmp_path / file[0], **arguments)
    assert (craft.source.unit_m, craft.source.up, craft.source.forward) == (
        {"mm": 0.001, "m": 1.0}.get(arguments.get("unit"), craft.source.unit_m),
        arguments.get("up", craft.source.up),
        arguments.get("forward", craft.source.forward),
    )


def test_arguments_that_agree_with_the_file_are_silent(tmp_path):
    name, content = plate_file("glb", TO_GLTF)
    (tmp_path / name).write_bytes(content)
    assert load_airframe(tmp_path / name, unit="m", up="y", forward="z").mesh.extents[2] == pytest.approx(0.0)


def test_a_craft_on_its_side_is_doubted_unless_it_was_asked_for(tmp_path):
    name, content = plate_file("obj", TO_Y_UP)
    (tmp_path / name).write_bytes(content)
    assert "stands 0.5 m high" not in str(load_airframe(tmp_path / name, up="y").source)
    turned = load_airframe(tmp_path / name)
    assert "it stands 0.5 m high and is 0 m wide: if that is wrong, give up" in str(turned.source)
    assert not load_airframe(tmp_path / name, up="z").source.doubt


def test_a_written_craft_comes_back_from_every_format(tmp_path):
    craft = procedural_airframe("hexa")
    for kind in ("obj", "stl", "ply", "glb"):
        mesh = craft.mesh.copy()
        if kind == "glb":
            mesh.apply_transform(np.block([[TO_GLTF, np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]]))
        mesh.export(tmp_path / f"craft.{kind}")
        back = load_airframe(tmp_path / f"craft.{kind}")
        assert back.name == "craft" and back.rotor_axes_m is None and back.mesh.is_watertight
        np.testing.assert_allclose(back.mesh.extents, craft.mesh.extents, atol=1e-6)
        assert back.mesh.area == pytest.approx(craft.mesh.area, rel=1e-5)
        assert back.half_wheelbase_m == pytest.approx(0.25, rel=1e-3)


# what is refused


GLTF = gltf(TETRAHEDRON, SIDES)


def altered(document, **changes) -> bytes:
    return json.dumps({**document, **changes}).encode()


def of_one_accessor(**changes) -> bytes:
    return altered(GLTF, accessors=[GLTF["accessors"][0] | changes, *GLTF["accessors"][1:]])


def with_nan(write, rows=((1, np.nan), (2, np.inf))) -> bytes:
    vertices = TETRAHEDRON.copy()
    for row, value in rows:
        vertices[row, 0] = value
    return write(vertices, SIDES)


DAE = dae(TETRAHEDRON, SIDES).decode()
TWO_NAN = r"2 of 4 vertices are NaN or infinite"
TWO_OUTSIDE = r"1 of 4 faces name a vertex that is not there, such as index 9 \(from 0\) of 4 vertices"
OUTSIDE = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 9], [2, 0, 3]])
BAD_FILES = {
    "missing.stl": (None, "no such file"),
    "notes.txt": (b"v 0 0 0", "unknown mesh format '.txt'; wanted one of .obj"),
    **{f"empty{kind}": (b"", r"is empty \(0 bytes\)") for kind in FORMATS},
    "points.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "holds no faces"),
    "nan.obj": (with_nan(obj), TWO_NAN),
    "nan.ply": (with_nan(ply), TWO_NAN),
    "nan-binary.ply": (with_nan(lambda v, f: ply(v, f, "binary_little_endian")), TWO_NAN),
    "nan.stl": (with_nan(stl), "6 of 12 vertices are NaN or infinite"),
    "nan-text.stl": (with_nan(text_stl), "6 of 12 vertices are NaN or infinite"),
    "nan.glb": (with_nan(lambda v, f: glb(gltf(v, f))), TWO_NAN),
    "nan.dae": (with_nan(dae), "2 of 4 vertices are NaN or infinite"),
    "outside.obj": (obj(TETRAHEDRON, OUTSIDE), "such as index 9"),
    "outside.ply": (ply(TETRAHEDRON, OUTSIDE), "such as index 9"),
    "outside.glb": (glb(gltf(TETRAHEDRON, OUTSIDE)), TWO_OUTSIDE),
    "outside.dae": (dae(TETRAHEDRON, OUTSIDE), "such as index 9"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4: .* indices start at 1"),
    "far-back.obj": (b"v 0 0 0\nv 1 0 0\nf -3 -2 -1\nv 0 1 0\n", "line 3: .* back from the 2 vertices"),
    "short.obj": (b"v 0 0\nv 1 0 0\nf 1 2 1\n", "line 1: a vertex of 2 numbers"),
    "huge.obj": (b"v 0 0 0\nv 1e300 0 0\nv 0 1e300 0\nf 1 2 3\n", r"is 1e\+300 m long with unit=1 m"),
    "word.obj": (b"v 0 0 0\nv 1 0 x\nf 1 2 1\n", "a vertex is not three numbers"),
    "half.obj": (b"v 0 0 0\nf 1 2 b\n", "line 2: .* no face of whole numbers"),
    "few.stl": (stl(TETRAHEDRON, SIDES)[:-60], "counts 4 facets .* hold 2 and a part of one"),
    "many.stl": (stl(TETRAHEDRON, SIDES, stated=2), r"counts 2 facets \(184 bytes\), but 284 bytes hold 4"),
    "head.stl": (b"made up", "7 bytes are too few"),
    "cut-text.stl": (text_stl(TETRAHEDRON, SIDES)[:150], "2 facets begin, 1 end"),
    "broken.ply": (b"ply\n", "does not run from 'ply' to 'end_header'"),
    "odd.ply": (ply(TETRAHEDRON, SIDES).replace(b"float z", b"quad z"), "no PLY: .property quad z"),
    "flat.ply": (ply(TETRAHEDRON, SIDES).replace(b"float z", b"float w"), "no vertex property 'z'"),
    "cut.ply": (ply(TETRAHEDRON, SIDES)[:-6], "ends in row 4 of the 4 of its element 'face'"),
    "cut-mixed.ply": (ply(TETRAHEDRON, [[0, 1, 2], [0, 1, 2, 3]], "binary_big_endian")[:-1], "ends in row 2 of the 2"),
    "broken.glb": (b"glTF", "states 0 bytes|it is glTF 0"),
    "cut.glb": (glb(gltf(TETRAHEDRON, SIDES))[:-8], "header states .* bytes, but it has"),
    "old.gltf": (altered(GLTF, asset={"version": "1.0"}), "it is glTF 1.0, and glTF 2 is read"),
    "no.gltf": (b"{", "holds no JSON document"),
    "draco.gltf": (
        altered(GLTF, extensionsRequired=["KHR_draco_mesh_compression"]),
        "requires the glTF extension KHR_draco_mesh_compression, .* export the mesh without it",
    ),
    "unheard.gltf": (altered(GLTF, extensionsRequired=["XY_teapots"]), "requires the glTF extension XY_teapots"),
    "copies.gltf": (
        altered(GLTF, nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]),
        "uses the glTF extension EXT_mesh_gpu_instancing",
    ),
    "bare.gltf": (json.dumps(GLTF).replace('"bufferView": 0, ', "").encode(), "accessor 0 holds no data"),
    "overrun.gltf": (of_one_accessor(count=40), "40 elements end at byte 480 of a buffer"),
    "sparse.gltf": (altered(gltf(TETRAHEDRON, SIDES, sparse=([1, 9], TETRAHEDRON[:2]))), "names element 9 of 4"),
    "nowhere.gltf": (altered(GLTF, buffers=[{"byteLength": 120}]), "buffer 0 is nowhere"),
    "ring.gltf": (altered(GLTF, nodes=[{"mesh": 0, "children": [0]}]), "node 0 is reached twice"),
    "bufferless.gltf": (json.dumps({k: v for k, v in GLTF.items() if k != "buffers"}).encode(), "'buffers' is missing"),
    "nodes.gltf": (altered(GLTF, scenes=[{"nodes": [7]}]), "IndexError"),
    "cut.dae": (DAE[:600].encode(), "no well-formed XML"),
    "ampersand.dae": (b'<?xml version="1.0"?><COLLADA><a name="bolt & nut"/></COLLADA>', "no well-formed XML"),
    "scene.dae": (b"<COLLADA/>", "holds no scene"),
    "skin.dae": (DAE.replace("instance_geometry", "instance_controller").encode(), "<instance_controller>"),
    "gone.dae": (DAE.replace('url="#g"', 'url="#h"').encode(), "url='#h'> refers to no <geometry>"),
    "skew.dae": (dae(TETRAHEDRON, SIDES, node="<skew>1 1 0 0 0 1 0</skew>"), "placed by <skew>"),
    "holes.dae": (DAE.replace("<vcount>", "<ph/><vcount>").encode(), "polygons with holes"),
    "short.dae": (DAE.replace("<p>0 0", "<p>").encode(), "states 4 faces, holds 4, and has 11 corners where 12"),
    "unit.dae": (dae(TETRAHEDRON, SIDES, asset='<unit meter="0"/>'), "<unit> is meter='0'"),
    "axis.dae": (dae(TETRAHEDRON, SIDES, asset="<up_axis>UP</up_axis>"), "<up_axis> is 'UP'; wanted one of X_UP"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_refused_briefly(tmp_path, name):
    content, message = BAD_FILES[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_airframe(tmp_path / name)
    text = str(caught.value).replace(str(tmp_path), "")
    assert name in text and len(text.splitlines()) == 1 and len(text) < 300


@pytest.mark.parametrize("name", ["KHR_materials_unlit", "KHR_techniques_webgl", "KHR_texture_transform"])
def test_extensions_that_move_no_vertex_are_passed_over(load, name):
    assert area(load("fine.gltf", altered(GLTF, extensionsRequired=[name]))) == pytest.approx(TETRAHEDRON_AREA)


# published craft


ORIGINALS = {
    "arducopter/3dr_arducopter_quad_x.obj": "arducopter_quad_x.ply",
    "cesium/CesiumDrone.glb": "cesium_drone.ply",
    "crazyflie/cf2_assembly_with_props.dae": "crazyflie2.ply",
    "hector/quadrotor_base.dae": "hector_quadrotor.ply",
    "hector/quadrotor_base.stl": "hector_quadrotor.ply",
}


@pytest.mark.skipif(not MESHES.is_dir(), reason="the published meshes are not at hand")
@pytest.mark.parametrize("name", ORIGINALS)
def test_published_craft_stand_upright_at_the_defaults(name):
    craft, converted = load_airframe(MESHES / "originals" / name), load_airframe(MESHES / ORIGINALS[name])
    np.testing.assert_allclose(craft.mesh.extents, converted.mesh.extents, rtol=1e-4)
    assert craft.half_wheelbase_m == pytest.approx(converted.half_wheelbase_m, rel=1e-3)
    assert craft.mesh.area == pytest.approx(converted.mesh.area, rel=1e-3)
    # the surface is flattest along z: rotors, arms and plates lie in the rotor plane
    weights, places = craft.mesh.area_faces, craft.mesh.triangles_center
    _, axes = np.linalg.eigh((places * weights[:, None]).T @ places)
    assert abs(axes[2, 0]) > 0.99


def test_readers_agree_with_trimesh(tmp_path):
    mesh = trimesh.creation.annulus(0.1, 0.3, 0.05)
    for kind in ("obj", "stl", "ply", "glb"):
        mesh.export(tmp_path / f"ring.{kind}")
        surface, _ = read_mesh(tmp_path / f"ring.{kind}")
        assert area(surface) == pytest.approx(mesh.area, rel=1e-5)
