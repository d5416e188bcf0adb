"""The craft's frame: what a cloud says of place and attitude, and the way there and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.models.frame import READINGS, facing, facing_back, into_craft, moments, out_of_craft, pose


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


def test_moments_by_hand():
    cloud, places, normals = flat_clouds()
    reading = np.asarray(moments(cloud))
    assert reading.shape == (6, READINGS)
    np.testing.assert_allclose(reading[:, :3], places, atol=1e-5)
    np.testing.assert_allclose(reading[:, 3:5], cloud[:, 0, 3:], atol=1e-5)
    covariance = np.cov(cloud[0, :, :3].T, bias=True)[np.triu_indices(3)]
    np.testing.assert_allclose(reading[0, 5:11], 10 * covariance, atol=1e-4)
    assert (np.sum(reading[:, 11:14] * normals, -1) > 0.999).all()  # a degree or two: the disc has a thickness


def test_the_harmonics_tell_arms_and_heading():
    """Four equal arms at heading a: c_4 = e^{4ja}/2, c_8 = e^{8ja}/2, and nothing at 1, 2, 3, 5, 6, 7."""
    heading = 0.3
    angles = heading + np.pi / 2 * np.arange(4)
    arms = np.linspace(0.1, 0.3, 30)[:, None, None] * np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    cloud = np.zeros((120, 5), np.float32)
    cloud[:, :3] = arms.reshape(-1, 3) + [0.2, -0.1, 0.4]
    harmonics = np.asarray(moments(jnp.asarray(cloud)))[14:]
    values = harmonics[:8] + 1j * harmonics[8:]
    expected = np.zeros(8, complex)
    expected[[3, 7]] = 0.5 * np.exp(1j * np.array([4, 8]) * heading)
    np.testing.assert_allclose(values, expected, atol=1e-4)


def test_the_pose_is_a_rotation_that_turns_up_into_the_normal():
    _, places, normals = flat_clouds()
    reading = np.concatenate([places, np.zeros((6, 8)), 0.7 * normals], -1).astype(np.float32)
    place, rotation = pose(jnp.asarray(reading))
    np.testing.assert_allclose(place, places, atol=1e-6)
    np.testing.assert_allclose(np.einsum("bij,bkj->bik", rotation, rotation), np.tile(np.eye(3), (6, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(rotation[:, :, 2], normals, atol=1e-5)
    # The smallest rotation to n: its angle is that between n and up, trace = 1 + 2 cos.
    np.testing.assert_allclose(np.trace(rotation, axis1=1, axis2=2), 1 + 2 * normals[:, 2], atol=1e-5)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, 0), (0.3, 0, -0.9), (1, 0, 0)])
def test_any_reading_gives_a_proper_frame(normal):
    reading = np.concatenate([np.zeros(11), normal]).astype(np.float32)
    rotation = np.asarray(pose(jnp.asarray(reading))[1])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-4)


def test_into_the_craft_s_frame_and_back():
    cloud, _, _ = flat_clouds()
    reading = moments(cloud)
    inside = np.asarray(into_craft(cloud, reading, 3.0))
    np.testing.assert_allclose(inside[..., :3].mean(1), 0.0, atol=1e-5)
    np.testing.assert_allclose(inside[..., 2].std(1), 3 * 0.02, rtol=0.15)  # level, in the new unit
    np.testing.assert_array_equal(inside[..., 3:], cloud[..., 3:])
    np.testing.assert_allclose(out_of_craft(inside, reading, 3.0), cloud, atol=1e-5)
    path = jnp.stack([inside, 2 * inside])  # a leading axis, as of the moments of a reconstruction
    np.testing.assert_allclose(out_of_craft(path, reading, 3.0)[0], cloud, atol=1e-5)


def test_a_scene_turned_about_the_station_looks_the_same():
    cloud, places, _ = flat_clouds()
    places = places + [4.0, 6.0, 3.0]
    angle = 2.0
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]], np.float32)
    moved = np.concatenate([cloud[..., :3] @ turn.T, cloud[..., 3:]], -1)
    seen = np.asarray(facing(cloud, places))
    np.testing.assert_allclose(facing(moved, places @ turn.T), seen, atol=1e-5)
    assert np.abs(seen - cloud).max() > 0.1
    np.testing.assert_allclose(facing_back(seen, places), cloud, atol=1e-6)
    # x points away from the station: what lies behind the place along the bearing has y = 0
    behind = np.concatenate([0.1 * places[:, None, :2], np.zeros((6, 1, 3))], -1)
    np.testing.assert_allclose(facing(behind, places)[:, 0, 1], 0.0, atol=1e-6)
    assert (facing(behind, places)[:, 0, 0] > 0.4).all()


def test_a_whole_turn_of_the_cloud_turns_the_reading_alone():
    """Two craft of one shape at other places and tilts are one cloud in their frames, up to heading."""
    cloud, _, _ = flat_clouds(1)
    angle = 0.3
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]], np.float32)
    moved = np.concatenate([cloud[..., :3] @ turn.T + np.float32(0.2), cloud[..., 3:]], -1)
    first, second = (np.asarray(jax.jit(into_craft, static_argnums=2)(c, moments(c), 1.0)) for c in (cloud, moved))
    np.testing.assert_allclose(first[..., 2], second[..., 2], atol=1e-5)
    np.testing.assert_allclose(np.hypot(first[..., 0], first[..., 1]), np.hypot(second[..., 0], second[..., 1]),
                               atol=1e-5)
