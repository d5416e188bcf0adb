"""Green's function against its definition, and the fields of dipoles against it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.physics import PlanarArray, coupling_matrix, dipole_fields, dyadic_green, wavenumber
from august_jax.physics.green import path_difference

K = wavenumber(3e9)


@pytest.mark.parametrize("distance", [0.01, 0.1, 1.0])
def test_dyadic_is_the_scalar_green_function_differentiated_twice(distance):
    with jax.enable_x64(True):
        point = jnp.asarray([0.36, -0.48, 0.8]) * distance

        def scalar(part):
            def value(p):
                r = jnp.sqrt(jnp.sum(p**2))
                return part(jnp.exp(1j * K * r) / (4 * jnp.pi * r))

            return value

        hessian = jax.hessian(scalar(jnp.real))(point) + 1j * jax.hessian(scalar(jnp.imag))(point)
        plain = scalar(jnp.real)(point) + 1j * scalar(jnp.imag)(point)
        expected = plain * jnp.eye(3) + hessian / K**2
        # Second derivatives in double precision: rounding only.
        np.testing.assert_allclose(dyadic_green(point, K), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_coupling_is_symmetric_and_blockwise_the_dyadic():
    points = np.random.default_rng(0).normal(size=(5, 3))
    with jax.enable_x64(True):
        matrix = np.asarray(coupling_matrix(jnp.asarray(points), K))
        one = np.asarray(dyadic_green(jnp.asarray(points[1] - points[3]), K))
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-12)
    np.testing.assert_allclose(matrix[3:6, 9:12], one, rtol=1e-12)
    assert np.all(matrix[3:6, 3:6] == 0)


def test_single_precision_keeps_the_phase_at_25_m():
    """Float32 distances of 25 m carry phase errors of 1e-4 rad; the expansion about the centroids does not."""
    array = PlanarArray(16, 4, 3e9)
    random = np.random.default_rng(1)
    points = (np.array([17.3, 16.1, 9.2]) + random.uniform(-0.3, 0.3, (40, 3))).astype(np.float32)
    sources = array.positions.astype(np.float32)
    moment = np.array([0.0, 0.0, 1.0])
    # Compiled, because a compiler may undo what compensated arithmetic does.
    compiled = jax.jit(lambda *arrays: dipole_fields(*arrays, K))
    fast = np.asarray(compiled(jnp.asarray(points), jnp.asarray(sources), jnp.asarray(moment, jnp.float32)))
    offset = points.astype(float)[:, None] - sources.astype(float)
    with jax.enable_x64(True):
        exact = np.asarray(dyadic_green(jnp.asarray(offset), K)) @ moment
    exact = exact.transpose(0, 2, 1).reshape(120, 64)
    assert np.linalg.norm(fast - exact) < 2e-5 * np.linalg.norm(exact)


def test_the_phase_does_not_hang_on_how_a_body_s_middle_is_summed():
    """The middle of many points, as a mean that a compiler takes in two orders, may differ by 1e-6 m, 6e-5 rad."""
    points = np.random.default_rng(2).uniform(-0.3, 0.3, (951, 3)) + [12.3, 12.5, 9.3]
    points = points.astype(np.float32)
    array = PlanarArray(16, 4, 3e9)

    def fields(points, dtype):
        return dipole_fields(points, jnp.asarray(array.positions, dtype), jnp.asarray(array.moments, dtype), K)

    fast = np.asarray(jax.jit(lambda points: fields(points, jnp.float32))(jnp.asarray(points)))
    with jax.enable_x64(True):
        exact = np.asarray(fields(jnp.asarray(points, jnp.float64), jnp.float64))
    assert np.linalg.norm(fast - exact) < 5e-6 * np.linalg.norm(exact)


def test_steering_is_the_far_limit_of_the_spherical_wave():
    array = PlanarArray(8, 4, 3e9)
    azimuth, elevation = 0.9, 0.4
    unit = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    with jax.enable_x64(True):
        near = np.asarray(array.spherical(jnp.asarray(1e5 * unit))) * np.exp(-1j * array.wavenumber * 1e5)
        far = np.asarray(array.steering(jnp.asarray(azimuth), jnp.asarray(elevation)))
    # The curvature left at 100 km is k a^2 / 2r, some 1e-5 rad.
    np.testing.assert_allclose(near, far, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0, 4, 3e9), "nx, nz"), ((4, 4, -1.0), "frequency_hz"), ((4, 4, 3e9, (0.0, 0.0, 2.0)), "polarization")],
)
def test_bad_arrays_are_refused(arguments, message, unchecked):
    with pytest.raises(ValueError, match=message):
        PlanarArray(*arguments)


@pytest.mark.parametrize("shape", [(7, 3), (4, 7, 3)])
def test_path_differences_keep_their_digits_in_single_precision(shape):
    """The plain difference of distances of 40 m is rounded to 4e-6 m, 2.4e-4 rad; here to that of the difference."""
    random = np.random.default_rng(5)
    offset = random.uniform(-0.4, 0.4, shape).astype(np.float32)
    base = random.uniform(15.0, 25.0, (*shape[:-2], 1, 3)).astype(np.float32)
    exact = np.linalg.norm(base.astype(float) - offset, axis=-1) - np.linalg.norm(base.astype(float), axis=-1)
    np.testing.assert_allclose(path_difference(jnp.asarray(offset), jnp.asarray(base)), exact, rtol=0, atol=1e-7)
    assert path_difference(jnp.zeros(3), jnp.asarray(base[..., 0, :])).shape == shape[:-2]
    with jax.enable_x64(True):
        slope = jax.grad(lambda at: path_difference(jnp.zeros(3), at))(jnp.asarray([3.0, 4.0, 0.0]))
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)
