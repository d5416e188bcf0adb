"""The latent prior: an invertible map with a known determinant, whose density integrates to one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from august_jax.models.flow import RealNVP


def flow(size, layers=3, features=8):
    """A flow away from its start, where it is the identity."""
    graphdef, state = nnx.split(RealNVP(size, layers, features, rngs=nnx.Rngs(0)))
    generator = np.random.default_rng(1)
    state = jax.tree.map(lambda leaf: leaf + 0.3 * generator.normal(size=leaf.shape).astype("f"), state)
    return nnx.merge(graphdef, state)


def test_the_start_is_the_standard_normal():
    latent = np.random.default_rng(0).normal(size=(4, 6)).astype(np.float32)
    model = RealNVP(6, 4, 8, rngs=nnx.Rngs(0))
    expected = -0.5 * np.sum(latent**2 + np.log(2 * np.pi), axis=-1)
    np.testing.assert_allclose(model.log_prob(latent), expected, rtol=1e-5)


@pytest.mark.parametrize("size", [5, 6])
def test_density_is_the_base_density_over_the_jacobian(size):
    model = flow(size)
    bijector = model.distribution().bijector

    @jax.jit
    def answers(base):
        latent = bijector.forward(base)
        determinant = jnp.linalg.slogdet(jax.jacobian(bijector.forward)(base))
        return bijector.inverse(latent), determinant, model.log_prob(latent)

    for base in np.random.default_rng(2).normal(size=(3, size)).astype(np.float32):
        back, (sign, log_determinant), log_prob = answers(base)
        np.testing.assert_allclose(back, base, atol=1e-5)
        expected = -0.5 * np.sum(base**2 + np.log(2 * np.pi)) - log_determinant
        assert sign > 0 and abs(log_determinant) > 0.05
        np.testing.assert_allclose(log_prob, expected, rtol=1e-4)


def test_couplings_act_in_order_with_alternating_masks():
    model = flow(4)
    base = np.random.default_rng(3).normal(size=4).astype(np.float32)
    expected = base.copy()
    for index, conditioner in enumerate(model.conditioners):
        kept = np.arange(4) % 2 == index % 2
        log_scale, shift = np.asarray(conditioner(np.where(kept, expected, 0.0).astype(np.float32))).T
        expected = np.where(kept, expected, expected * np.exp(log_scale) + shift)
    np.testing.assert_allclose(model.distribution().bijector.forward(base), expected, rtol=1e-5)


def test_density_integrates_to_one_and_samples_follow_it():
    model = flow(2)
    edges = np.linspace(-14, 14, 561)
    grid = np.stack(np.meshgrid(edges, edges, indexing="ij"), -1).astype(np.float32)
    density = np.exp(np.asarray(jax.jit(model.log_prob)(grid), np.float64)) * (edges[1] - edges[0]) ** 2
    np.testing.assert_allclose(density.sum(), 1.0, atol=0.01)
    samples = np.asarray(model.sample(jax.random.key(0), 20_000))
    assert samples.shape == (20_000, 2)
    mean = np.einsum("ij,ijk->k", density, grid)
    spread = np.sqrt(np.einsum("ij,ijk->k", density, (grid - mean) ** 2))
    # five standard errors of the mean of 20,000 samples, and the grid's own error
    assert (np.abs(samples.mean(0) - mean) < 5 * spread / np.sqrt(20_000) + 0.01).all()


def test_far_codes_have_a_finite_density_and_gradient():
    model = flow(4)
    value, gradient = jax.jit(jax.value_and_grad(model.log_prob))(jnp.full(4, 1e3))
    assert np.isfinite(value) and np.isfinite(gradient).all()
