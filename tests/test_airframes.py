"""Airframes: geometry, thin-shell lattice, surface samples, mesh files."""

import subprocess
import sys

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from august_jax.scene.airframes import (
    AIRFRAMES,
    Airframe,
    load_airframe,
    mesh_path,
    procedural_airframe,
    resolve_airframe,
    sample_triangles,
)
from august_jax.scene.lattice import distance_to_triangles, shell_cells, surface_grid, touched_cells
from august_jax.scene.pose import rotation_from_euler
from august_jax.scene.rotors import estimate_half_wheelbase


@pytest.fixture(scope="module")
def crafts() -> dict[str, Airframe]:
    return {name: procedural_airframe(name) for name in AIRFRAMES}


UPRIGHT = np.eye(3)


def sheet(edge: float, rotation=UPRIGHT, offset=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Two triangles (2, 3, 3) that make a square, its middle at ``offset``."""
    corners = 0.5 * edge * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ np.asarray(rotation).T + offset
    return corners[[[0, 1, 2], [0, 2, 3]]]


def material(cells) -> float:
    return float(np.sum(cells.fill * cells.volumes))


def centres(cells, edge: float) -> np.ndarray:
    """Of the lattice's cells: positions are less than half a cell off them."""
    return np.round(cells.positions / edge) * edge


# procedural families


@pytest.mark.parametrize("name", AIRFRAMES)
def test_families_are_closed_scaled_and_centred(crafts, name):
    craft = crafts[name]
    assert craft.mesh.is_watertight and craft.mesh.is_winding_consistent
    assert craft.mesh.volume > 0.0  # normals point outwards
    assert 700 <= craft.cells(0.012, 0.002).count <= 1600
    axes = craft.rotor_axes_m[:, :2]
    assert np.linalg.norm(axes[:, None] - axes, axis=-1).max() / 2 == pytest.approx(0.25)
    centroid = np.average(craft.mesh.triangles_center, axis=0, weights=craft.mesh.area_faces)
    np.testing.assert_allclose(centroid, 0.0, atol=1e-12)
    assert craft.radius_m == pytest.approx(np.linalg.norm(craft.mesh.vertices, axis=1).max())


def test_families_differ_and_forward_shows(crafts):
    assert [len(craft.rotor_axes_m) for craft in crafts.values()] == [4, 4, 6, 8, 6]
    assert len({craft.digest for craft in crafts.values()}) == 5
    for craft in crafts.values():
        surface, _ = surface_grid(craft.mesh.triangles, 0.004)
        tail_first = surface * [-1, 1, 1] + [2 * craft.rotor_axes_m[:, 0].mean(), 0, 0]
        distance, _ = cKDTree(surface).query(tail_first)
        assert np.mean(distance > 0.01) > 0.05


def test_rotors_carry_material_at_their_axes(crafts):
    for craft in crafts.values():
        distance = trimesh.proximity.closest_point_naive(craft.mesh, craft.rotor_axes_m)[1]
        assert distance.max() < 0.005  # the hub's half thickness is 3 mm


def test_scaling_keeps_the_shape(crafts):
    craft = crafts["hexa"]
    small = craft.scaled(0.1)
    assert small.half_wheelbase_m == 0.1
    np.testing.assert_allclose(small.mesh.vertices, 0.4 * craft.mesh.vertices, atol=1e-15)
    np.testing.assert_allclose(small.rotor_axes_m, 0.4 * craft.rotor_axes_m)
    assert small.digest != craft.digest
    assert small.digest == procedural_airframe("hexa", 0.1).digest
    assert len(craft.digest) == 16


# the lattice


def test_sheet_through_the_middle_of_its_cells_fills_a_fifth():
    cells = shell_cells(sheet(0.2), 0.01, 0.002)
    inner = np.abs(cells.positions[:, :2]).max(axis=1) < 0.085
    assert inner.sum() == 17**2  # one layer of cells
    np.testing.assert_allclose(cells.fill[inner], 0.2, atol=1e-12)
    np.testing.assert_allclose(cells.normals[inner], np.broadcast_to(np.diag([0, 0, 1.0]), (289, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(cells.volumes, 1e-6)


@pytest.mark.parametrize("angles", [(0, 0, 0), (10, 0, 0), (45, 0, 0), (0, 30, 20), (35.26, 45, 0), (62, 11, 74)])
@pytest.mark.parametrize("height", [0.0, 0.0031, 0.006])
def test_sheet_holds_its_volume_and_normal_at_every_tilt(angles, height):
    rotation = np.asarray(rotation_from_euler(*np.radians(angles)), dtype=float)
    edge, skin = 0.15, 0.002
    cells = shell_cells(sheet(edge, rotation, (0.001, 0.002, height)), 0.012, skin)
    # the skin's rim is half a round rod; dropped cells hold up to 0.5 %, and the rim is resolved by few sub-cells
    expected = edge**2 * skin + 4 * edge * np.pi * (skin / 2) ** 2 / 2
    assert material(cells) == pytest.approx(expected, rel=0.01)
    normal = rotation[:, 2]
    np.testing.assert_allclose(cells.normals, np.broadcast_to(np.outer(normal, normal), cells.normals.shape), atol=1e-6)


def test_sphere_fill_against_random_points():
    radius, cell, skin = 0.04, 0.012, 0.002
    cells = shell_cells(trimesh.creation.icosphere(4, radius).triangles, cell, skin)
    shell = 4 / 3 * np.pi * ((radius + skin / 2) ** 3 - (radius - skin / 2) ** 3)
    assert material(cells) == pytest.approx(shell, rel=0.02)
    generator = np.random.default_rng(0)
    inside = centres(cells, cell)[:, None] + cell * (generator.random((cells.count, 4000, 3)) - 0.5)
    distance = np.linalg.norm(inside, axis=-1)
    fill = np.mean(np.abs(distance - radius) < skin / 2, axis=1)
    # counting 4000 points has a standard error of 0.006; sub-cells of 1.5 mm blur corners by as much
    assert np.sqrt(np.mean((cells.fill - fill) ** 2)) < 0.01
    np.testing.assert_allclose(np.trace(cells.normals, axis1=1, axis2=2), 1.0, atol=1e-12)
    radial = cells.positions / np.linalg.norm(cells.positions, axis=1, keepdims=True)
    assert np.einsum("na,nab,nb->n", radial, cells.normals, radial).mean() > 0.95


def test_material_does_not_count_double():
    single, twice = sheet(0.1), np.concatenate([sheet(0.1), sheet(0.1)[:, ::-1]])
    plate = np.concatenate([sheet(0.1, offset=(0, 0, -0.0005)), sheet(0.1, offset=(0, 0, 0.0005))])
    alone = shell_cells(single, 0.012, 0.002)
    for other in (twice, sheet(0.1)[:, ::-1]):
        np.testing.assert_allclose(shell_cells(other, 0.012, 0.002).fill, alone.fill, atol=1e-12)
    # two skins of 2 mm whose middles are 1 mm apart cover 3 mm
    assert material(shell_cells(plate, 0.012, 0.002)) == pytest.approx(1.5 * material(alone), rel=0.03)


def test_faces_may_be_cut_in_any_way():
    square = trimesh.Trimesh(sheet(0.1).reshape(-1, 3), [[0, 1, 2], [3, 4, 5]], process=False)
    fine = square.subdivide().subdivide().subdivide()
    coarse_cells, fine_cells = (shell_cells(mesh.triangles, 0.012, 0.002) for mesh in (square, fine))
    np.testing.assert_array_equal(centres(coarse_cells, 0.012), centres(fine_cells, 0.012))
    np.testing.assert_allclose(coarse_cells.fill, fine_cells.fill, atol=1e-3)


def test_dropped_cells_hold_little(crafts, monkeypatch):
    from august_jax.scene import lattice

    kept = material(crafts["octo"].cells(0.012, 0.002))
    monkeypatch.setattr(lattice, "_NEGLIGIBLE", 0.0)
    again = procedural_airframe("octo")  # an airframe keeps the lattice that it made last
    assert 0.995 < kept / material(again.cells(0.012, 0.002)) < 1.0


def test_cells_are_deterministic_and_about_the_lattice(crafts):
    first, second = (craft.cells(0.015, 0.002) for craft in (crafts["quad_x"], procedural_airframe("quad_x")))
    np.testing.assert_array_equal(first.fill, second.fill)
    middles = centres(first, 0.015)
    assert len(np.unique(np.round(middles / 0.015), axis=0)) == first.count
    # two fifths of the way to the centroid, which lies in the cell
    np.testing.assert_allclose(first.positions, middles + 0.4 * (first.centroids - middles), atol=1e-12)
    assert np.abs(first.centroids - middles).max() <= 0.5 * 0.015 + 1e-9
    assert first.fill.min() > 0.0 and first.fill.max() <= 1.0


def test_cell_size_for_a_budget(crafts):
    craft = crafts["quad_x"]
    assert craft.cell_size_for(700, 0.024, 0.006) == 0.024
    size = craft.cell_size_for(200, 0.024, 0.006)
    assert craft.cells(size, 0.006).count <= 200 < craft.cells(size / 1.05, 0.006).count
    assert np.log(size / 0.024) / np.log(1.05) == pytest.approx(round(np.log(size / 0.024) / np.log(1.05)))


@pytest.mark.parametrize(
    "ask, message",
    [
        (lambda craft: craft.cell_size_for(0, 0.012, 0.002), "max_cells=0: .* at least 8"),
        (lambda craft: craft.cell_size_for(1, 0.012, 0.002), "max_cells=1: .* at least 8"),
        (lambda craft: craft.cell_size_for(8, 0.012, 0.002), "max_cells=8: the finest cells that fit are 6"),
        (lambda craft: craft.cells(0.7, 0.002), "cell_m=0.7: quad_x, .* 1 cells.* give 0.17 m or less"),
        (lambda craft: craft.cell_size_for(200, 0.7, 0.002), "cell_m=0.7: .* 1 cells"),
        (lambda craft: craft.cells(1e9, 0.002), "no cell holds material"),
        (lambda craft: craft.cells(1e-6, 1e-7), "cell_m=1e-06: .* samples, .* give 0.0017 m or more"),
        (lambda craft: craft.cell_size_for(200, 1e-6, 1e-7), "cell_m=1e-06: .* samples"),
        (lambda craft: craft.scaled(float("nan")), "half_wheelbase_m=nan"),
        (lambda craft: procedural_airframe("hexa", 1e-9), "half_wheelbase_m=1e-09"),
    ],
)
def test_sizes_that_make_no_body_are_refused(crafts, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(crafts["quad_x"])


@pytest.mark.parametrize("cell, skin", [(0.01, 0.02), (0.0, 0.0), (0.01, -1.0), (float("nan"), 0.002)])
def test_sizes_are_checked(cell, skin):
    with pytest.raises(ValueError, match="skin_m="):
        shell_cells(sheet(0.1), cell, skin)


def test_distance_to_triangles_against_closest_point():
    generator = np.random.default_rng(1)
    triangles, points = generator.normal(size=(200, 3, 3)), generator.normal(size=(200, 3))
    expected = np.linalg.norm(trimesh.triangles.closest_point(triangles, points) - points, axis=1)
    np.testing.assert_allclose(distance_to_triangles(points, triangles), expected, atol=1e-12)


def test_surface_grid_lies_on_its_triangles_and_leaves_no_gaps():
    triangles = np.array([[[0, 0, 0], [0.2, 0, 0], [0.11, 0.003, 0]], [[0, 0, 0.1], [0.03, 0, 0.1], [0, 0.04, 0.1]]])
    points, owner = surface_grid(triangles, 0.001)
    assert distance_to_triangles(points, triangles[owner]).max() < 1e-12
    assert len(points) < 4000  # a sliver costs no more than its area
    generator = np.random.default_rng(2)
    weights = generator.dirichlet([1, 1, 1], 500)
    for index in range(2):
        anywhere = weights @ triangles[index]
        gap = np.linalg.norm(anywhere[:, None] - points[owner == index], axis=-1).min(axis=1)
        assert gap.max() < 0.0013
    assert touched_cells(sheet(0.1), 0.01) == 11**2


# surface samples


def test_samples_are_area_uniform_and_follow_the_key(crafts):
    craft = crafts["coaxial_y6"]
    key = jax.random.key(3)
    points = np.asarray(craft.sample_surface(key, 20_000))
    assert points.shape == (20_000, 3) and points.dtype == np.float32
    np.testing.assert_array_equal(points, craft.sample_surface(key, 20_000))
    assert np.abs(points - np.asarray(craft.sample_surface(jax.random.key(4), 20_000))).max() > 0.1
    # the mean of n samples scatters by r / sqrt(n); the frame's origin is the surface's centroid
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=5 * 0.2 / np.sqrt(20_000))
    height = craft.mesh.triangles_center[:, 2]
    above = np.sum(craft.mesh.area_faces[height > 0.03]) / craft.mesh.area
    assert np.mean(points[:, 2] > 0.03) == pytest.approx(above, abs=0.02)


def test_samples_on_two_triangles_share_by_area_and_fill_them():
    triangles = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 5], [3, 0, 5], [0, 1, 5]]], dtype=np.float32)
    points = np.asarray(sample_triangles(jax.random.key(0), triangles, np.array([0.5, 2.0], np.float32), 40_000))
    lower = points[points[:, 2] < 1]
    assert len(lower) / 40_000 == pytest.approx(0.25, abs=0.01)  # 4 standard errors
    # in the unit triangle, x is below 1/2 with probability 3/4
    assert np.mean(lower[:, 0] < 0.5) == pytest.approx(0.75, abs=0.02)
    assert (lower[:, :2] >= 0).all() and (lower[:, :2].sum(axis=1) <= 1 + 1e-6).all()


def test_samples_vmap_over_keys(crafts):
    craft = crafts["quad_x"]
    keys = jax.random.split(jax.random.key(1), 3)
    many = jax.vmap(lambda key: sample_triangles(key, *craft.surface, 10))(keys)
    np.testing.assert_allclose(many[2], craft.sample_surface(keys[2], 10), atol=1e-6)


# mesh files: how they are read is tested beside the readers


@pytest.fixture
def craft_file(tmp_path, crafts):
    def write(kind: str, transform=None):
        path = tmp_path / f"craft.{kind}"
        mesh = crafts["hexa"].mesh.copy()
        (mesh if transform is None else mesh.apply_transform(transform)).export(path)
        return path

    return write


def test_units_and_axes(craft_file, crafts):
    # millimetres, up is -y, forward is -z; left is then -y x -z = x
    transform = np.diag([1000.0, 1000.0, 1000.0, 1.0]) @ np.array(
        [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]]
    )
    path = craft_file("stl", transform)
    for unit in ("mm", "0.001", 0.001):
        craft = load_airframe(path, unit=unit, up="-y", forward="-z")
        np.testing.assert_allclose(
            np.sort(craft.mesh.vertices, axis=0), np.sort(crafts["hexa"].mesh.vertices, axis=0), atol=2e-6
        )
        assert craft.source.arguments() == {"unit": 0.001, "up": "-y", "forward": "-z"}
    large = load_airframe(path, unit="mm", up="-y", forward="-z", half_wheelbase_m=0.5)
    assert large.mesh.extents[2] == pytest.approx(2 * crafts["hexa"].mesh.extents[2], rel=1e-3)
    assert large.source == craft.source


def test_a_dirty_mesh_is_cleaned(tmp_path):
    path = tmp_path / "dirty.obj"
    grid = "".join(f"v {x} {y} 0\n" for y in range(6) for x in range(6))
    quads = "".join(
        f"f {6 * y + x + 1} {6 * y + x + 2} {6 * y + x + 8} {6 * y + x + 7}\n" for y in range(5) for x in range(5)
    )
    # a vertex given again, one that no face uses, a face that uses the first, one given twice, one without area
    extra = "v 0 0 0\nv 9 9 9\nf 37 2 8\nf 2 8 1\nf 1 1 2\n"
    path.write_text("mtllib missing.mtl\nusemtl gone\n" + grid + quads + extra)
    craft = load_airframe(path)
    assert len(craft.mesh.faces) == 50 and craft.mesh.area == pytest.approx(25.0)
    points = np.asarray(craft.sample_surface(jax.random.key(0), 100))
    assert np.abs(points).max() < 2.6


def test_many_faces_without_area_are_told(tmp_path):
    path = tmp_path / "half.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 0\nf 1 2 3\nf 1 4 1\n")
    with pytest.warns(UserWarning, match=r"half.obj: 1 of 2 faces have no area"):
        assert len(load_airframe(path).mesh.faces) == 1


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"unit": "furlong"}, "unit='furlong'"),
        ({"unit": "-1"}, "unit='-1'"),
        ({"unit": "nan"}, "unit='nan'"),
        ({"up": "w"}, "up='w'"),
        ({"forward": "+x"}, r"forward='\+x'"),
        ({"up": "z", "forward": "-z"}, "perpendicular"),
        ({"forward": "z"}, "give up too"),
        ({"half_wheelbase_m": 0.0}, "half_wheelbase_m=0.0"),
        ({"half_wheelbase_m": 1e6}, "half_wheelbase_m=1000000.0: wanted .* from 0.001 to 100"),
        ({"half_wheelbase_m": float("nan")}, "half_wheelbase_m=nan"),
    ],
)
def test_bad_arguments_are_named(craft_file, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_airframe(craft_file("stl"), **arguments)


def test_a_surface_without_area_is_refused(tmp_path):
    path = tmp_path / "flat.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"flat.obj: all faces have zero area"):
        load_airframe(path)


def test_resolve_airframe(craft_file):
    assert resolve_airframe("octo", 0.3).half_wheelbase_m == 0.3
    assert resolve_airframe(str(craft_file("ply")), 0.3).half_wheelbase_m == 0.3
    for text in ("octa", "no/such.ply"):
        with pytest.raises(ValueError, match=text):
            resolve_airframe(text, 0.3)
    with pytest.raises(ValueError, match="name='octa'"):
        procedural_airframe("octa")


def test_a_name_carries_unit_and_axes_of_its_mesh(craft_file, crafts, tmp_path):
    to_file = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])  # y up, z forward
    path = craft_file("stl", to_file)
    text = f"{path}?unit=mm&up=y&forward=z"
    craft = resolve_airframe(text, 0.25)
    np.testing.assert_allclose(craft.mesh.extents, crafts["hexa"].mesh.extents, rtol=1e-3)
    assert craft.source.arguments() == {"unit": 0.001, "up": "y", "forward": "z"}
    assert mesh_path(text) == path == mesh_path(str(path))
    assert mesh_path("hexa") is None and mesh_path(f"{tmp_path}/no.stl?unit=mm") is None
    named_so = tmp_path / "a.stl?unit=mm"
    named_so.write_bytes(path.read_bytes())
    assert mesh_path(str(named_so)) == named_so


@pytest.mark.parametrize("query", ["units=mm", "unit", "unit=", "up=y&up=z", "unit=mm,up=y&", "half_wheelbase_m=1"])
def test_what_stands_after_a_name_is_checked(craft_file, query):
    with pytest.raises(ValueError, match=r"is not one of unit, up, forward, each once and with a value"):
        resolve_airframe(f"{craft_file('stl')}?{query}", 0.25)
    with pytest.raises(ValueError, match=r"airframe '.*craft.stl\?up=w': up='w'"):
        resolve_airframe(f"{craft_file('stl')}?up=w", 0.25)


# half-wheelbase of a bare mesh


@pytest.mark.parametrize("name", AIRFRAMES)
def test_half_wheelbase_is_found_from_the_repeated_parts(crafts, name):
    mesh = crafts[name].mesh
    turn = np.asarray(rotation_from_euler(0.0, 0.0, 0.7), dtype=float)
    assert estimate_half_wheelbase(mesh.vertices @ turn.T, mesh.faces) == pytest.approx(0.25, rel=1e-6)
    assert estimate_half_wheelbase(40.0 * mesh.vertices, mesh.faces) == pytest.approx(10.0, rel=1e-6)


def test_half_wheelbase_of_one_piece_falls_back_on_its_extent():
    box = trimesh.creation.box((0.6, 0.8, 0.1))
    assert estimate_half_wheelbase(box.vertices, box.faces) == pytest.approx(0.31)


def test_flights_do_not_import_trimesh():
    code = "import august_jax.scene.trajectory, sys; assert 'trimesh' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_centroids_lie_on_the_skin(crafts):
    craft = crafts["quad_x"]
    cells = craft.cells(0.015, 0.002)
    assert np.linalg.norm(cells.centroids - cells.positions, axis=1).mean() > 0.06 * 0.015
    # What is added up over the lattice is the material's own mean, wherever the lattice lies.
    weights = np.asarray(cells.fill) * np.asarray(cells.volumes)
    surface = np.asarray(craft.sample_surface(jax.random.key(0), 20_000)).mean(axis=0)
    np.testing.assert_allclose(weights @ cells.centroids / weights.sum(), surface, atol=0.004)
