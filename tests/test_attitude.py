"""Normals of a made-up multirotor: four rings above a box, at a known tilt, with noise and outliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.scene.pose import rotation_from_euler
from august_jax.tracking import plane_normal, rotor_points, triple_normal

COUNT = 1000


def copter(seed, tilt_deg, noise_m=0.0):
    """Points (M, 3), which of them are rotor points, and the true normal."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, COUNT)
    arm = np.pi / 4 + np.pi / 2 * rng.integers(0, 4, COUNT)
    rings = np.stack(
        [0.25 * np.cos(arm) + 0.1 * np.cos(angle), 0.25 * np.sin(arm) + 0.1 * np.sin(angle), np.full(COUNT, 0.03)], 1
    )
    along = rng.uniform(-0.25, 0.25, COUNT)
    arms = np.stack([along * np.cos(arm), along * np.sin(arm), rng.uniform(-0.01, 0.01, COUNT)], 1)
    body = rng.uniform(-1, 1, (COUNT, 3)) * [0.08, 0.05, 0.03]
    legs = np.stack([0.06 * np.sign(along), rng.uniform(-0.08, 0.08, COUNT), rng.uniform(-0.12, 0.0, COUNT)], 1)
    part = rng.choice(4, COUNT, p=[0.5, 0.2, 0.2, 0.1])
    points = np.choose(part[:, None], [rings, arms, body, legs]) + noise_m * rng.normal(size=(COUNT, 3))
    axis = rng.uniform(0, 2 * np.pi)
    tilt = np.deg2rad(tilt_deg)
    rotation = np.asarray(rotation_from_euler(tilt * np.cos(axis), tilt * np.sin(axis), rng.uniform(-3, 3)))
    offset = np.array([12.0, 20.0, 11.0])
    return (jnp.asarray(points @ rotation.T + offset, jnp.float32), jnp.asarray(part == 0), rotation[:, 2])


def degrees_apart(first, second):
    return np.rad2deg(np.arccos(np.clip(np.dot(first, second), -1, 1)))


@pytest.mark.parametrize("tilt", [0.0, 15.0, 30.0])
def test_true_rotor_points_give_the_normal(tilt):
    points, rotor, normal = copter(0, tilt, noise_m=0.01)
    key = jax.random.key(0)
    # 500 points with 1 cm noise on rings 0.35 m wide: the least-squares plane errs by some 0.1 degree, the mean of
    # triples by a few times that.
    assert degrees_apart(plane_normal(key, points, weights=rotor), normal) < 0.5
    assert degrees_apart(triple_normal(key, points, weights=rotor), normal) < 2.0


def test_consensus_resists_what_the_average_does_not():
    """A third of the points far off on one side: the plane of the majority stays."""
    points, rotor, normal = copter(1, 20.0, noise_m=0.005)
    spread = np.random.default_rng(0).uniform(-0.3, 0.3, points.shape) + [0.2, 0.0, 0.4]
    spoilt = jnp.where(rotor[:, None], points, points + jnp.asarray(spread, jnp.float32))
    robust = degrees_apart(plane_normal(jax.random.key(1), spoilt), normal)
    plain = degrees_apart(triple_normal(jax.random.key(1), spoilt), normal)
    assert robust < 1.5 < plain


def test_rotor_points_are_found_without_truth():
    for seed in range(5):
        points, rotor, normal = copter(seed, 25.0, noise_m=0.01)
        found = rotor_points(points)
        assert np.mean(rotor[found]) > 0.85
        assert np.sum(found) > 200
        assert degrees_apart(plane_normal(jax.random.key(seed), points, weights=found), normal) < 2.0


def test_normals_point_up_and_have_unit_length():
    points, *_ = copter(2, 30.0)
    for flipped in (points, points * jnp.array([1.0, 1.0, -1.0])):
        for function in (plane_normal, triple_normal):
            normal = function(jax.random.key(0), flipped)
            assert normal[2] > 0.0
            np.testing.assert_allclose(jnp.linalg.norm(normal), 1.0, rtol=1e-5)


def test_degenerate_triples_do_no_harm():
    """All points on one line: no plane; still an answer without NaN."""
    line = jnp.linspace(0.0, 1.0, 50)[:, None] * jnp.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(triple_normal(jax.random.key(0), line), [0.0, 0.0, 1.0])
    assert np.isfinite(plane_normal(jax.random.key(0), line)).all()


def test_maps_over_clouds():
    clouds = jnp.stack([copter(seed, 10.0)[0] for seed in range(3)])
    keys = jax.random.split(jax.random.key(0), 3)
    mapped = jax.vmap(lambda key, cloud: plane_normal(key, cloud, weights=rotor_points(cloud)))(keys, clouds)
    alone = plane_normal(keys[1], clouds[1], weights=rotor_points(clouds[1]))
    np.testing.assert_allclose(mapped[1], alone, atol=1e-4)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"\(2, 3\)"):
        plane_normal(jax.random.key(0), jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match="at least 1"):
        triple_normal(jax.random.key(0), jnp.zeros((9, 3)), 0)
