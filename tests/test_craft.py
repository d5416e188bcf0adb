"""The craft's frame: what a cloud says of place, attitude and kind, and the chain of turns there and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.models.craft import KIND_SIZE, READING_SIZE, CraftFrame, Reading, RegionFrame
from august_jax.scene import AIRFRAMES, procedural_airframe

ARMS = {"quad_x": 4, "quad_plus": 4, "hexa": 6, "octo": 8, "coaxial_y6": 3}
AHEAD = np.array([5.0, 0.0, 3.0], np.float32)
"""A place whose bearing is e_x: what is seen there is faced as it is."""


def turn_about(axis, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]], np.float32)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)


def turned(cloud, matrix, shift=0.0):
    return np.concatenate([cloud[..., :3] @ matrix.T + np.float32(shift), cloud[..., 3:]], -1)


def flat_clouds(count=6, points=400):
    """Flat discs at random places and tilts: clouds (B, M, 5), places (B, 3) and normals (B, 3)."""
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(count, 3)) + [0.0, 0.0, 4.0]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    places = generator.uniform(-0.6, 0.6, (count, 3))
    discs = generator.normal(size=(count, points, 3)) * [0.3, 0.25, 0.02]
    discs -= discs.mean(1, keepdims=True)
    axes = [np.linalg.qr(np.stack([n, *generator.normal(size=(2, 3))], axis=1))[0][:, [1, 2, 0]] for n in normals]
    xyz = np.einsum("bma,bca->bmc", discs, np.stack(axes)) + places[:, None]
    material = np.broadcast_to(generator.uniform(0, 1, (count, 1, 2)), (count, points, 2))
    return np.concatenate([xyz, material], -1).astype(np.float32), places, normals


def craft_cloud(name, yaw, seed=0):
    body = np.asarray(procedural_airframe(name).sample_surface(jax.random.key(seed), 1000))
    return jnp.asarray(turned(np.concatenate([body, np.full((1000, 2), 0.5)], -1), turn_about("z", yaw)), jnp.float32)


def test_a_reading_by_hand():
    cloud, places, normals = flat_clouds()
    reading = Reading.of_cloud(cloud)
    np.testing.assert_allclose(reading.place, places, atol=1e-5)
    np.testing.assert_allclose(reading.material, cloud[:, 0, 3:], atol=1e-5)
    assert (np.sum(reading.normal * normals, -1) > 0.999).all()  # a degree or two: the disc has a thickness


def test_a_reading_as_a_vector_and_back():
    """Weights that are stored are trained to this order: place, material, normal, harmonics."""
    reading = Reading.of_cloud(flat_clouds()[0])
    vector = np.asarray(reading.vector())
    assert vector.shape == (6, READING_SIZE) == (6, 24) and reading.kind().shape == (6, KIND_SIZE)
    for part, columns in (
        ("place", slice(3)),
        ("material", slice(3, 5)),
        ("normal", slice(5, 8)),
        ("harmonics", slice(8, 24)),
    ):
        np.testing.assert_array_equal(vector[:, columns], getattr(reading, part))
    jax.tree.map(np.testing.assert_array_equal, Reading.from_vector(vector), reading)


def test_the_harmonics_tell_arms_and_heading():
    """Four equal arms at heading a: c_4 = e^{4ja}/2, c_8 = e^{8ja}/2, and nothing at 1, 2, 3, 5, 6, 7."""
    heading = 0.3
    angles = heading + np.pi / 2 * np.arange(4)
    arms = np.linspace(0.1, 0.3, 30)[:, None, None] * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    cloud = np.zeros((120, 5), np.float32)
    cloud[:, :3] = arms.reshape(-1, 3) + [0.2, -0.1, 0.4]
    harmonics = np.asarray(Reading.of_cloud(cloud).harmonics)
    expected = np.zeros(8, complex)
    expected[[3, 7]] = 0.5 * np.exp(1j * np.array([4, 8]) * heading)
    np.testing.assert_allclose(harmonics[:8] + 1j * harmonics[8:], expected, atol=1e-4)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_heading_turns_with_the_craft(name):
    readings = [Reading.of_cloud(craft_cloud(name, yaw)) for yaw in (0.0, 0.05)]
    strengths = np.hypot(*np.split(np.asarray(readings[0].harmonics), 2))
    assert np.argmax(strengths) + 1 == ARMS[name]
    first, second = (float(reading.heading()) for reading in readings)
    sector = 2 * np.pi / ARMS[name]
    assert (second - first - 0.05 + sector / 2) % sector - sector / 2 == pytest.approx(0.0, abs=0.005)
    # whichever of its arms the heading is taken along, the harmonics that its arms share come out the same
    shared = np.arange(ARMS[name] - 1, 8, ARMS[name])
    rows = [np.asarray(reading.kind())[np.append(shared, 8 + shared)] for reading in readings]
    np.testing.assert_allclose(*rows, atol=0.01)
    assert rows[0][0] > 0.3 and abs(rows[0][len(shared)]) < 1e-5
    np.testing.assert_allclose(readings[0].kind()[16:], 0.5, atol=1e-6)


def along_x(normal):
    """A reading of that normal whose heading is 0: c_1 is real."""
    shape = np.shape(normal)[:-1]
    harmonics = np.zeros((*shape, 16), np.float32)
    harmonics[..., 0] = 0.5
    return Reading(
        np.zeros((*shape, 3), np.float32),
        np.zeros((*shape, 2), np.float32),
        jnp.asarray(normal, "f"),
        jnp.asarray(harmonics),
    )


def test_the_level_axes_are_the_smallest_turn_of_up_into_the_normal():
    _, _, normals = flat_clouds()
    axes = np.asarray(along_x(0.7 * normals).axes())
    np.testing.assert_allclose(axes[:, :, 2], normals, atol=1e-5)
    # The angle of the smallest is that between n and up: trace = 1 + 2 cos.
    np.testing.assert_allclose(np.trace(axes, axis1=1, axis2=2), 1 + 2 * normals[:, 2], atol=1e-5)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, 0), (0.3, 0, -0.9), (1, 0, 0)])
def test_any_reading_has_proper_axes(normal):
    axes = np.asarray(along_x(np.array(normal)).axes())
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-4)


@pytest.mark.parametrize("frame", [RegionFrame(), CraftFrame(jnp.array([4.0, 6.0, 3.0]), 3.0)], ids=["region", "craft"])
def test_into_a_frame_and_back(frame):
    cloud, _, _ = flat_clouds()
    reading = frame.read(cloud)
    inside = frame.into(cloud, reading)
    np.testing.assert_array_equal(inside[..., 3:], cloud[..., 3:])
    np.testing.assert_allclose(frame.out(inside, reading), cloud, atol=1e-5)
    path = jnp.stack([inside, 2 * inside])  # a leading axis, as of the instants of a reconstruction
    np.testing.assert_allclose(frame.out(path, reading)[0], cloud, atol=1e-5)


def test_a_cloud_in_its_own_frame_is_centred_level_and_scaled():
    cloud, _, _ = flat_clouds()
    frame = CraftFrame(jnp.array([4.0, 6.0, 3.0]), 3.0)
    inside = np.asarray(frame.into(cloud, frame.read(cloud)))
    np.testing.assert_allclose(inside[..., :3].mean(1), 0.0, atol=1e-5)
    np.testing.assert_allclose(inside[..., 2].std(1), 3 * 0.02, rtol=0.15)


def test_a_scene_turned_about_the_station_looks_the_same():
    cloud, places, _ = flat_clouds()
    places = (places + [4.0, 6.0, 3.0]).astype(np.float32)
    turn = turn_about("z", 2.0)
    faced = np.asarray(CraftFrame(places, 1.0).faced(cloud))
    np.testing.assert_allclose(CraftFrame(places @ turn.T, 1.0).faced(turned(cloud, turn)), faced, atol=1e-5)
    assert np.abs(faced - cloud).max() > 0.1
    # x points away from the station: what lies behind the place along the bearing has y = 0
    behind = np.concatenate([0.1 * places[:, None, :2], np.zeros((6, 1, 3), "f")], -1)
    seen = np.asarray(CraftFrame(places, 1.0).faced(behind))[:, 0]
    np.testing.assert_allclose(seen[:, 1], 0.0, atol=1e-6)
    assert (seen[:, 0] > 0.4).all()


def test_a_whole_turn_of_the_cloud_turns_the_reading_alone():
    """Two craft of one shape at other places and tilts are one cloud in their frames, up to heading."""
    cloud, _, _ = flat_clouds(1)
    frame = CraftFrame(jnp.asarray(AHEAD), 1.0)
    first, second = (
        np.asarray(jax.jit(lambda c: frame.into(c, frame.read(c)))(c))
        for c in (cloud, turned(cloud, turn_about("x", 0.3), 0.2))
    )
    np.testing.assert_allclose(first[..., 2], second[..., 2], atol=1e-5)
    np.testing.assert_allclose(
        np.hypot(first[..., 0], first[..., 1]), np.hypot(second[..., 0], second[..., 1]), atol=1e-5
    )


def test_arms_of_a_kind_coincide_in_the_craft_s_axes():
    """Two headings and two samples of one craft: its points come to lie on each other."""
    frame = CraftFrame(jnp.asarray(AHEAD), 4.0)
    first, second = (
        np.asarray(frame.into(c, frame.read(c))) for c in (craft_cloud("hexa", 0.3, 1), craft_cloud("hexa", 1.1, 2))
    )

    def apart(a, b):
        return np.mean(np.min(np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1), axis=1))

    assert apart(first, second) < 0.35 * apart(first, turned(second, turn_about("z", -0.5)))
