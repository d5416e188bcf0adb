"""Small bodies for the physics tests, as NumPy arrays in double precision."""

import numpy as np

from august_jax.physics import Cells


def sphere(radius, across):
    """A solid sphere on a lattice of 2 radius/across; cells that its surface cuts are partly filled.

    Across a surface the field behaves as at a sheet: parallel mixing along it, series mixing across it.
    """
    edge = 2.0 * radius / across
    steps = np.arange(-(across // 2) - 1, across // 2 + 2) * edge
    centres = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    inner = ((np.arange(10) + 0.5) / 10 - 0.5) * edge
    inside = np.stack(np.meshgrid(inner, inner, inner, indexing="ij"), -1).reshape(-1, 3)
    fill = np.mean(np.linalg.norm(centres[:, None] + inside, axis=-1) < radius, axis=1)
    centres, fill = centres[fill > 0.02], fill[fill > 0.02]
    fill = np.minimum(fill * 4.0 * np.pi / 3.0 * radius**3 / (fill.sum() * edge**3), 1.0)
    normals = centres / np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-12)
    return Cells(centres, np.full(len(centres), edge**3), fill, normals)


def cross(arm=5, edge=0.012, fill=0.3):
    """A small drone-like cross of partly filled cells with sheet normals along z."""
    span = np.arange(-arm, arm + 1) * edge
    points = np.concatenate(
        [
            np.stack([span, 0 * span, 0 * span], -1),
            np.stack([0 * span, span, 0 * span], -1)[np.abs(span) > 1e-9],
            np.array([[0.0, 0.0, edge], [edge, 0.0, edge], [0.0, edge, -edge]]),
        ]
    )
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return Cells(points, np.full(len(points), edge**3), np.full(len(points), fill), normals)


def turned(angles):
    """Rotation matrix from three Euler angles [rad]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("zyx", angles).as_matrix()
