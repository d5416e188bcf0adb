"""Rotations and rigid motion.

A rotation matrix takes body coordinates to world coordinates: x_world = R x_body + t. The body's third axis in the
world, R e_z, is the rotor-plane normal. Euler angles are yaw about z, then pitch about the new y, then roll about
the new x: R = R_z(yaw) R_y(pitch) R_x(roll). Functions broadcast over leading axes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float, Real

from august_jax.arrays import Array, ArrayLike


def rotation_from_euler(
    roll: Real[ArrayLike, "*#batch"], pitch: Real[ArrayLike, "*#batch"], yaw: Real[ArrayLike, "*#batch"]
) -> Float[jax.Array, "*batch 3 3"]:
    """R_z(yaw) R_y(pitch) R_x(roll) as (..., 3, 3); angles [rad]."""
    roll, pitch, yaw = jnp.broadcast_arrays(*map(jnp.asarray, (roll, pitch, yaw)))
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (jnp.cos, jnp.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_from_quaternion(quaternion: Real[Array, "*batch 4"]) -> Float[jax.Array, "*batch 3 3"]:
    """Rotations (..., 3, 3) of quaternions (..., 4), scalar part first, of any length but zero."""
    q = jnp.asarray(quaternion)
    w, x, y, z = jnp.moveaxis(q / jnp.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_from_axis_yaw(
    axis: Float[Array, "*batch 3"], yaw: Float[Array, "*batch"]
) -> Float[jax.Array, "*batch 3 3"]:
    """The attitude (..., 3, 3) of a multirotor whose thrust points along ``axis`` and whose nose heads to ``yaw``.

    Differential flatness: z_B = axis; x_B is perpendicular to it and to (-sin yaw, cos yaw, 0), so that its
    horizontal bearing is the yaw of :func:`rotation_from_euler`; y_B completes the triad.

    Args:
        axis: unit vectors (..., 3) that point upwards.
        yaw: headings (...,) [rad].
    """
    abeam = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw), jnp.zeros_like(yaw)], axis=-1)
    nose = jnp.cross(abeam, axis)
    nose /= jnp.linalg.norm(nose, axis=-1, keepdims=True)
    return jnp.stack([nose, jnp.cross(axis, nose), axis], axis=-1)


def random_rotation(key: jax.Array) -> Float[jax.Array, "3 3"]:
    """A rotation (3, 3) drawn uniformly (Haar measure)."""
    return rotation_from_quaternion(jax.random.normal(key, (4,)))


def tilt(rotation: Float[Array, "*batch 3 3"]) -> Float[jax.Array, "*batch"]:
    """Angle (...,) [rad] between the body's z axis and the vertical, in [0, pi]."""
    return jnp.arctan2(jnp.hypot(rotation[..., 0, 2], rotation[..., 1, 2]), rotation[..., 2, 2])


def transform(
    points: Float[Array, "*#batch M 3"], rotation: Float[Array, "*#batch 3 3"], translation: Real[Array, "*#batch 3"]
) -> Float[Array, "*batch M 3"]:
    """Points (..., M, 3) after x -> R x + t; rotation (..., 3, 3), translation (..., 3)."""
    return points @ jnp.swapaxes(rotation, -1, -2) + jnp.asarray(translation)[..., None, :]
