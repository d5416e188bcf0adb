"""The 5-D cloud and its region."""

import jax
import numpy as np
import pytest

from august_jax.config import RegionConfig
from august_jax.scene.cloud import from_cloud, position_estimate, to_cloud

REGION = RegionConfig(scale_m=0.8, permittivity_max=5.0, conductivity_max_s_m=0.01)


def test_one_point_by_hand():
    points, position, predicted = map(np.array, ([[0.1, 0.2, 0.3]], [10.0, 20.0, 15.0], [10.4, 19.8, 15.0]))
    cloud = to_cloud(points, position, predicted, 2.5, 0.002, REGION)
    np.testing.assert_allclose(cloud, [[-0.375, 0.5, 0.375, 0.5, 0.2]], atol=1e-5)


def test_reading_inverts_writing_over_a_batch():
    generator = np.random.default_rng(0)
    points = generator.normal(scale=0.2, size=(4, 7, 3)).astype(np.float32)
    position = generator.uniform(10, 20, (4, 3)).astype(np.float32)
    predicted = position + generator.uniform(-0.5, 0.5, (4, 3)).astype(np.float32)
    permittivity, conductivity = generator.uniform(1.5, 5, 4), generator.uniform(0.001, 0.01, 4)
    cloud = to_cloud(points, position, predicted, permittivity, conductivity, REGION)
    assert cloud.shape == (4, 7, 5)
    reading = from_cloud(cloud, predicted, REGION)
    # float32 at 20 m resolves 2 micrometres
    np.testing.assert_allclose(reading.points, points + position[:, None], atol=1e-5)
    np.testing.assert_allclose(reading.permittivity, np.repeat(permittivity[:, None], 7, 1), rtol=1e-6)
    np.testing.assert_allclose(reading.conductivity, np.repeat(conductivity[:, None], 7, 1), rtol=1e-6)
    one = jax.vmap(lambda *each: to_cloud(*each, REGION))(points, position, predicted, permittivity, conductivity)
    np.testing.assert_allclose(one, cloud, atol=1e-6)


def test_a_centred_body_gives_its_position_back():
    generator = np.random.default_rng(1)
    points = generator.normal(size=(50, 3))
    points -= points.mean(axis=0)
    position, predicted = np.array([12.0, 25.0, 11.0]), np.array([12.3, 24.6, 11.2])
    cloud = to_cloud(points, position, predicted, 3.0, 0.005, REGION)
    np.testing.assert_allclose(position_estimate(cloud, predicted, REGION), position, atol=1e-5)


def test_materials_within_their_limits_stay_below_one():
    cloud = to_cloud(np.zeros((1, 3)), np.zeros(3), np.zeros(3), 5.0, 0.01, REGION)
    np.testing.assert_allclose(cloud[0, 3:], 1.0, rtol=1e-6)
    assert float(to_cloud(np.zeros((1, 3)), np.zeros(3), np.zeros(3), 1.5, 0.001, REGION)[0, 4]) == pytest.approx(0.1)
