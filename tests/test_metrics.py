"""The paper's metrics against slow loops and against clouds whose distances are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.evaluation import metrics


def slow_chamfer(first, second):
    one = np.mean([min(np.sum((p - q) ** 2) for q in second) for p in first])
    other = np.mean([min(np.sum((p - q) ** 2) for p in first) for q in second])
    return one + other


def test_chamfer_against_a_loop():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(30, 3)), rng.normal(size=(40, 3)) + 0.5
    np.testing.assert_allclose(
        metrics.chamfer(jnp.asarray(first), jnp.asarray(second)), slow_chamfer(first, second), rtol=1e-5
    )
    centred = slow_chamfer(first - first.mean(0), second - second.mean(0))
    np.testing.assert_allclose(metrics.shape_distance(jnp.asarray(first), jnp.asarray(second)), centred, rtol=1e-5)


def test_offset_grid_has_a_closed_form():
    """Two sparse lattices, one shifted by d along x: every nearest distance is d, both ways."""
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)
    np.testing.assert_allclose(metrics.chamfer(grid + [0.1, 0, 0], grid), 2 * 0.1**2, rtol=1e-5)
    np.testing.assert_allclose(metrics.shape_distance(grid + [0.1, 0, 0], grid), 0.0, atol=1e-12)


def test_logarithm_follows_the_mean():
    """Same shapes, position errors of 0.1 and 0.3 m: WD = 10 log10((0.01 + 0.09)/2)."""
    clouds = np.random.default_rng(1).normal(size=(2, 50, 3)).astype(np.float32)
    truth = np.zeros((2, 3))
    found = np.array([[0.1, 0, 0], [0, 0, 0.3]])
    np.testing.assert_allclose(metrics.wd_db(clouds, clouds, found, truth), 10 * np.log10(0.05), rtol=1e-5)
    np.testing.assert_allclose(metrics.wd_db(clouds, clouds, found, truth, size_m=0.5), 10 * np.log10(0.2), rtol=1e-5)
    np.testing.assert_allclose(metrics.wd_db(clouds, clouds, found, truth, size_m=np.array([0.1, 0.3])), 0.0, atol=1e-5)
    np.testing.assert_allclose(metrics.mpe_m(found, truth), 0.2, rtol=1e-6)


def test_batch_metrics_are_means_of_samples():
    rng = np.random.default_rng(2)
    first, second = rng.normal(size=(37, 20, 3)), rng.normal(size=(37, 25, 3))  # not a multiple of the chunk
    each = [float(metrics.weighted_distance(a, b, jnp.ones(3), jnp.zeros(3))) for a, b in zip(first, second)]
    ones = np.ones((37, 3))
    np.testing.assert_allclose(metrics.wd_db(first, second, ones, 0 * ones), 10 * np.log10(np.mean(each)), rtol=1e-5)
    np.testing.assert_allclose(metrics.mcd_db(first, second), 10 * np.log10(np.mean(each) - 3.0), rtol=1e-4)


def test_resampling_floor_falls_with_the_number_of_points():
    """Two samples of one flat unit square: nearest squared distances go as 1/(pi M), so 3 dB for twice the points."""
    floors = []
    for points in (250, 1000):
        keys = jax.random.split(jax.random.key(points))
        clouds = [jnp.pad(jax.random.uniform(key, (20, points, 2)), ((0, 0), (0, 0), (0, 1))) for key in keys]
        floors.append(float(metrics.mcd_db(*clouds)))
    assert abs(floors[1] - 10 * np.log10(2 / (np.pi * 1000))) < 0.7  # edges and the shifted means cost a little
    assert abs(floors[0] - floors[1] - 6.0) < 0.7


def test_directional_error():
    tilt = np.deg2rad(20.0)
    up = np.array([[0.0, 0.0, 1.0]] * 3)
    normals = np.array([[0.0, 0.0, 1.0], [np.sin(tilt), 0.0, np.cos(tilt)], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(metrics.mde(up, normals), (0.0 + 1 - np.cos(tilt) + 2.0) / 3, rtol=1e-5)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: metrics.mcd_db(np.ones((2, 5, 5)), np.ones((2, 5, 3))), "material columns"),
        (lambda: metrics.mcd_db(np.ones((2, 5, 3)), np.ones((3, 5, 3))), r"\(3, 5, 3\)"),
        (lambda: metrics.mpe_m(np.ones(3), np.ones(3)), "estimated_position"),
        (lambda: metrics.mde(np.ones((2, 3)), np.ones((1, 3))), "estimated_normal"),
    ],
)
def test_bad_input_is_named(unchecked, call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_errors_along_and_across_the_line_of_sight():
    places = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 5.0]])
    errors = np.array([[0.6, 0.8, 0.5], [0.3, 0.4, -1.0]])  # 1 m along and 0.5 m across, both
    along, across = metrics.along_and_across_m(places + errors, places)
    assert float(along) == pytest.approx(1.0, abs=1e-6) and float(across) == pytest.approx(0.5, abs=1e-6)


def test_an_empty_cloud_is_refused_by_name():
    with pytest.raises(ValueError, match="source, target: clouds of 0 and 5 points; give at least one"):
        metrics.shape_distances(np.zeros((2, 0, 3), np.float32), np.zeros((2, 5, 3), np.float32))
