"""The one parametrisation of pose, material and gain: rotations against SciPy's, and zero as what it starts from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, turned
from scipy.spatial.transform import Rotation

from august_jax.physics import (
    PARAMETERS,
    Parameters,
    PlanarArray,
    body_channel,
    contrast,
    factor_body,
    moved,
    parameter_channel,
    rotation_from_vector,
)

ARRAY = PlanarArray(3, 2, 3e9)
TURN, PLACE = turned([0.4, -0.2, 0.3]).astype(np.float32), np.array([1.0, 2.5, 0.7], np.float32)


# on both sides of where the series take over, |w|^2 = 0.05, and at the half turn
@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.2236, 0.2237, 1.0, np.pi, 5.0])
def test_rotations_are_those_of_scipy(angle):
    vector = angle * np.array([0.36, -0.48, 0.8])
    with jax.enable_x64(True):
        found = np.asarray(rotation_from_vector(jnp.asarray(vector)))
    np.testing.assert_allclose(found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


def test_rotations_have_derivatives_at_zero_and_beside_it():
    with jax.enable_x64(True):
        slopes = np.asarray(jax.jacfwd(rotation_from_vector)(jnp.zeros(3)))
        second = np.asarray(jax.hessian(lambda w: rotation_from_vector(w)[0, 0])(jnp.zeros(3)))
    levi_civita = np.zeros((3, 3, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        levi_civita[a, b, c], levi_civita[b, a, c] = -1.0, 1.0
    np.testing.assert_allclose(slopes, levi_civita, atol=1e-12)
    np.testing.assert_allclose(second, np.diag([0.0, -1.0, -1.0]), atol=1e-12)  # 1 - (y^2 + z^2)/2


def test_names_parts_and_poses_agree():
    theta = jnp.arange(10.0)
    parts = Parameters.split(theta)
    assert len(PARAMETERS) == 10 and parts.permittivity == 6.0 and parts.phase == 9.0
    np.testing.assert_array_equal(jnp.concatenate([jnp.ravel(jnp.asarray(part)) for part in parts]), theta)
    turn, place = moved(Parameters((0.1, 0.0, 0.2), (0.0, 0.0, np.pi / 2)), TURN, PLACE)
    np.testing.assert_allclose(turn, Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix() @ TURN, atol=1e-6)
    np.testing.assert_allclose(place, PLACE + [0.1, 0.0, 0.2], atol=1e-6)


@pytest.mark.parametrize("tones", [3e9, (2.95e9, 3.05e9)])
def test_the_channel_is_that_of_the_moved_body_times_the_gain(tones):
    body = factor_body(cross(arm=3), tones)
    theta = Parameters((0.1, 0.0, 0.2), (0.1, -0.2, 0.3), 0.5, 1e-3, 0.3, 0.7)
    found = parameter_channel(body, ARRAY, theta, TURN, PLACE, 2.5, 5e-3)
    chi = contrast(3.0, 6e-3, jnp.asarray(tones))
    expected = np.exp(0.3 + 0.7j) * np.asarray(body_channel(body, ARRAY, *moved(theta, TURN, PLACE), chi))
    expected = expected.reshape(found.shape)
    assert found.shape == (np.size(tones), 6, 6)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
