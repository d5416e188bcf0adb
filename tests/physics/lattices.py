"""Small bodies for the physics tests, as NumPy arrays in double precision."""

import numpy as np

from august_jax.physics import Cells


def sphere(radius, across):
    """A solid sphere of about across^3 pi/6 lattice cells, scaled so that the cells' volume is the sphere's."""
    steps = (np.arange(across) - (across - 1) / 2.0) * (2.0 / across)
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    points = points[np.linalg.norm(points, axis=1) < 1.0]
    edge = radius * (4.0 * np.pi / 3.0 / len(points)) ** (1.0 / 3.0)
    return Cells(points / (2.0 / across) * edge, np.full(len(points), edge**3))


def cross(arm=5, edge=0.012, fill=0.3):
    """A small drone-like cross of partly filled cells with sheet normals along z."""
    span = np.arange(-arm, arm + 1) * edge
    points = np.concatenate([
        np.stack([span, 0 * span, 0 * span], -1),
        np.stack([0 * span, span, 0 * span], -1)[np.abs(span) > 1e-9],
        np.array([[0.0, 0.0, edge], [edge, 0.0, edge], [0.0, edge, -edge]]),
    ])
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return Cells(points, np.full(len(points), edge**3), np.full(len(points), fill), normals)


def turned(angles):
    """Rotation matrix from three Euler angles [rad]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("zyx", angles).as_matrix()
