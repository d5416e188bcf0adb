"""Coupling in planes against the plain complex matrix: products, and derivatives in either direction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.physics import coupling_matrix, wavenumber
from august_jax.physics.planes import _cosine_and_sine, coupled_fields, coupling_change, coupling_planes

K = wavenumber(3e9)


def setting(count):
    """Points on a body half a metre across, and three vectors."""
    random = np.random.default_rng(count)
    vectors = random.normal(size=(2, 3 * count, 3))
    return jnp.asarray(random.uniform(-0.25, 0.25, (count, 3))), jnp.asarray(vectors[0] + 1j * vectors[1])


def plain(points, k, vectors):
    return vectors.T @ coupling_matrix(points, k) @ vectors


def close(found, expected, tolerance):
    assert jnp.linalg.norm(expected) > 0
    assert jnp.linalg.norm(found - expected) < tolerance * jnp.linalg.norm(expected)


# One point; less than a block of rows; several blocks, of which the last is filled up.
@pytest.mark.parametrize("count", [1, 7, 301])
def test_products_equal_those_of_the_matrix(count):
    for double, tolerance in ((True, 1e-13), (False, 3e-6)):
        with jax.enable_x64(double):
            points, vectors = setting(count)
            expected = jax.jit(lambda x, v: coupling_matrix(x, K) @ v)(points, vectors)
            found = jax.jit(lambda x, v: coupled_fields(coupling_planes(x, K), v))(points, vectors)
            assert jnp.linalg.norm(found - expected) <= tolerance * jnp.linalg.norm(expected)


@pytest.mark.parametrize("count", [7, 301])
def test_the_change_is_the_derivative_of_the_quadratic_form(count):
    """In positions and frequency, forwards, backwards, and both of them in batches."""
    with jax.enable_x64(True):
        points, vectors = setting(count)
        random = np.random.default_rng(1)
        moved, weights = jnp.asarray(random.normal(size=points.shape)), jnp.asarray(random.normal(size=(2, 3, 3)))

        def derivatives(form):
            def loss(points, k):
                value = form(points, k, vectors)
                return jnp.sum(weights[0] * value.real + weights[1] * value.imag)

            forwards = jax.jit(
                lambda points, k: jax.jvp(lambda points, k: form(points, k, vectors), (points, k), (moved, 0.3))[1]
            )
            return forwards(points, K), *jax.jit(jax.grad(loss, (0, 1)))(points, K)

        expected = derivatives(plain)
        for found, wanted in zip(derivatives(coupling_change), expected):
            close(found, wanted, 1e-12)
        both = jnp.stack([points + 0.1 * moved, points])
        batched = jax.vmap(lambda points: coupling_change(points, K, vectors))
        assert not jnp.any(batched(both))
        gradient = jax.grad(lambda both: jnp.sum(weights[0] * batched(both).real + weights[1] * batched(both).imag))
        close(jax.jit(gradient)(both)[1], expected[1], 1e-12)
        close(
            jax.jit(lambda both: jax.jvp(batched, (both,), (jnp.stack([moved, moved]),))[1])(both)[1],
            jax.jit(lambda points: jax.jvp(lambda points: plain(points, K, vectors), (points,), (moved,))[1])(points),
            1e-12,
        )


def test_cosines_and_sines_of_turns():
    turns = np.linspace(-20.0, 20.0, 40_001).astype(np.float32)
    cosine, sine = _cosine_and_sine(jnp.asarray(turns))
    np.testing.assert_allclose(cosine, np.cos(2 * np.pi * turns.astype(float)), atol=1e-6)
    np.testing.assert_allclose(sine, np.sin(2 * np.pi * turns.astype(float)), atol=1e-6)
