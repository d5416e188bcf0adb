"""Fisher information against differences of the exact channel, and what it must say about single tones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross

from august_jax.physics import (
    PlanarArray, contrast, factor_body, fisher_information, mean_position_error, position_bound, sensing_channel,
    tilt_bound,
)
from august_jax.physics.information import KNOWN_GAIN

ARRAY = PlanarArray(8, 4, 3e9)
CELLS = cross(arm=9)
PLACE = np.array([2.0, 3.0, 1.5])


@pytest.fixture(scope="module")
def information():
    body = factor_body(CELLS, 3e9)
    return fisher_information(body, ARRAY, np.eye(3), PLACE, 3.0, 5e-3, 100.0)


def test_information_is_that_of_differences_of_the_channel(information):
    from scipy.spatial.transform import Rotation

    def channel(theta):
        with jax.enable_x64(True):
            turn = Rotation.from_rotvec(theta[3:6]).as_matrix()
            moved = CELLS.moved(jnp.asarray(turn), jnp.asarray(PLACE + theta[:3]))
            chi = complex(contrast(3.0 + theta[6], 5e-3 + theta[7], 3e9))
            return np.asarray(sensing_channel(ARRAY, moved, chi)) * np.exp(theta[8] + 1j * theta[9])

    steps = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-3, 1e-4, 1e-4, 1e-4])
    slopes = [(channel(step * axis) - channel(-step * axis)) / (2 * step) for step, axis in zip(steps, np.eye(10))]
    gram = np.real(np.einsum("amn,bmn->ab", slopes, np.conj(slopes)))
    expected = 2 * 100.0 * ARRAY.count**2 * gram / np.linalg.norm(channel(np.zeros(10))) ** 2
    scale = np.sqrt(np.diag(expected))
    # Derivatives in float32 through a response good to 3e-5.
    np.testing.assert_allclose(information / scale / scale[:, None], expected / scale / scale[:, None], atol=2e-3)


def test_an_unknown_gain_takes_the_range_away(information):
    known, unknown = position_bound(information, KNOWN_GAIN), position_bound(information)
    assert known < 0.01 < unknown
    assert 0.7 * unknown < mean_position_error(information) < unknown
    assert position_bound(information / 100.0) > unknown
    assert position_bound(np.zeros((10, 10))) == pytest.approx(0.5)  # the prior alone, 0.5/sqrt(3) along three axes
    normal = np.array([0.0, 0.0, 1.0])
    assert 0.0 < tilt_bound(information, normal) < tilt_bound(information / 100.0, normal) < np.deg2rad(30)
