"""Rotations and rigid motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from august_jax.scene.pose import (
    random_rotation,
    rotation_from_axis_yaw,
    rotation_from_euler,
    rotation_from_quaternion,
    tilt,
    transform,
)

ROUNDING = 2e-6  # a few float32 roundings of numbers near one


def test_euler_angles_against_scipy():
    roll, pitch, yaw = np.random.default_rng(0).uniform(-3, 3, (3, 20))
    expected = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1)).as_matrix()
    np.testing.assert_allclose(rotation_from_euler(roll, pitch, yaw), expected, atol=ROUNDING)


def test_euler_signs():
    quarter = np.pi / 2
    np.testing.assert_allclose(rotation_from_euler(0, 0, quarter) @ jnp.array([1.0, 0, 0]), [0, 1, 0], atol=ROUNDING)
    np.testing.assert_allclose(rotation_from_euler(0, quarter, 0) @ jnp.array([1.0, 0, 0]), [0, 0, -1], atol=ROUNDING)
    np.testing.assert_allclose(rotation_from_euler(quarter, 0, 0) @ jnp.array([0.0, 1, 0]), [0, 0, 1], atol=ROUNDING)


def test_quaternions_against_scipy_at_any_length():
    q = np.random.default_rng(1).normal(size=(20, 4))
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(q), expected, atol=ROUNDING)
    np.testing.assert_allclose(rotation_from_quaternion(-3.0 * q), expected, atol=ROUNDING)


def test_axis_and_yaw_give_the_flat_attitude():
    generator = np.random.default_rng(2)
    axis = generator.normal(size=(30, 3)) * [0.4, 0.4, 0.1] + [0, 0, 1]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    yaw = generator.uniform(-np.pi, np.pi, 30)
    rotation = np.asarray(rotation_from_axis_yaw(jnp.asarray(axis), jnp.asarray(yaw)))
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), (30, 3, 3)), atol=ROUNDING
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=ROUNDING)
    np.testing.assert_allclose(rotation[..., 2], axis, atol=ROUNDING)
    np.testing.assert_allclose(np.cos(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]) - yaw), 1.0, atol=ROUNDING)


def test_tilt_is_the_angle_to_the_vertical():
    angle = jnp.array([0.0, 1e-3, 0.5, 2.0, 3.1])
    rotation = rotation_from_euler(angle, 0.0, 1.3)
    np.testing.assert_allclose(tilt(rotation), angle, atol=ROUNDING)


def test_random_rotations_are_uniform():
    rotations = np.asarray(jax.vmap(random_rotation)(jax.random.split(jax.random.key(0), 20_000)))
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    # Haar measure: every entry has mean 0 and variance 1/3; 5 standard errors
    np.testing.assert_allclose(rotations.mean(axis=0), 0.0, atol=5 * 0.577 / np.sqrt(20_000))
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1 / 3, atol=5 * 0.3 / np.sqrt(20_000))
    # the angle's density is (1 - cos a) / pi, whose mean is pi/2 + 2/pi
    angle = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.03)


def test_transform_moves_points_rigidly():
    points = np.random.default_rng(3).normal(size=(2, 5, 3))
    rotation = rotation_from_euler(jnp.array([0.1, 0.2]), jnp.array([0.3, 0.4]), jnp.array([0.5, 0.6]))
    shift = np.array([[1.0, 2, 3], [4, 5, 6]])
    moved = np.asarray(transform(points, rotation, shift))
    for batch in range(2):
        for point in range(5):
            np.testing.assert_allclose(
                moved[batch, point], np.asarray(rotation)[batch] @ points[batch, point] + shift[batch], atol=1e-5
            )
