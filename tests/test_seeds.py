"""Seed points: a set's features, and clouds that settle on one of several craft."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from august_jax.models.denoiser import Denoiser
from august_jax.models.diffusion import Schedule, add_noise, dpm, draw_steps
from august_jax.models.seeds import Seeds, draw_seeds


def test_the_features_are_those_of_a_set():
    network = Seeds(4, 3, rngs=nnx.Rngs(0))
    condition = jnp.ones((2, 3))

    def seeds(points, known):
        return network(points, known, condition)

    points = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4, 5)), jnp.float32)
    known = jnp.array([3, 0])
    features = seeds(points, known)
    assert features.shape == (2, network.size)
    np.testing.assert_allclose(seeds(points[:, jnp.array([2, 0, 1, 3])], known), features, atol=1e-5)  # any order
    np.testing.assert_allclose(seeds(points.at[:, 3].add(9.0), known), features, atol=1e-5)  # what is not known yet
    assert np.abs(seeds(points.at[:, 2].add(1.0), known) - features)[0].max() > 0.01
    assert np.abs(features[0] - features[1]).max() > 0.01  # three seeds and none
    assert np.abs(network(points, known, 2 * condition) - features).max() > 0.01


def test_any_number_of_seeds_is_trained_on():
    cloud = jnp.asarray(np.random.default_rng(0).normal(size=(4000, 3, 5)), jnp.float32)
    shaken, known = draw_seeds(jax.random.key(0), cloud)
    np.testing.assert_allclose(np.bincount(known) / 4000, 0.25, atol=0.03)
    np.testing.assert_allclose(np.std(shaken - cloud), 0.02, rtol=0.05)


def test_a_cloud_settles_on_one_of_two_craft():
    """Points lie all on the left or all on the right, and nothing else tells: seeds keep a cloud together."""
    schedule, rngs, batch = Schedule(20, (1e-3, 0.4)), nnx.Rngs(0), 128
    model = nnx.Dict(seeds=Seeds(2, 1, rngs=rngs), denoiser=Denoiser((64, 64), Seeds.size, schedule, "log_snr", rngs=rngs))
    graphdef, state = nnx.split(model)
    optimiser = optax.adam(3e-3)

    @jax.jit
    def step(carry, key):
        state, memory = carry
        side, place, number, when, noise = jax.random.split(key, 5)

        def loss(state):
            model = nnx.merge(graphdef, state)
            left = jnp.where(jax.random.bernoulli(side, 0.5, (batch, 1)), 1.0, -1.0)
            points = 0.05 * jax.random.normal(place, (batch, 10, 5)).at[..., 0].add(20 * left)
            context = model["seeds"](*draw_seeds(number, points[:, :2]), jnp.zeros((batch, 1)))
            steps, eps = draw_steps(when, batch, schedule), jax.random.normal(noise, (batch, 8, 5))
            found = model["denoiser"](add_noise(points[:, 2:], eps, steps, schedule), steps, context)
            return jnp.mean((found - eps) ** 2)

        updates, memory = optimiser.update(jax.grad(loss)(state), memory, state)
        return (optax.apply_updates(state, updates), memory), None

    keys = jax.random.split(jax.random.key(0), 800)
    (state, _), _ = jax.jit(lambda carry: jax.lax.scan(step, carry, keys))((state, optimiser.init(state)))
    model = nnx.merge(graphdef, state)

    def clouds(seeds, known):
        context = model["seeds"](seeds, jnp.full(100, known), jnp.zeros((100, 1)))
        return dpm(jax.random.key(1), lambda p, s: model["denoiser"](p, s, context), (100, 40, 5), schedule, 10)

    alone = np.asarray(clouds(jnp.zeros((100, 2, 5)), 0))[..., 0]
    assert 0.3 < np.mean(alone > 0) < 0.7 and np.abs(np.mean(alone > 0, axis=1) - 0.5).mean() < 0.2  # a mixture
    side = np.sign(np.random.default_rng(0).normal(size=100)).astype(np.float32)
    settled = np.asarray(clouds(jnp.zeros((100, 2, 5)).at[:, 0, 0].set(side), 1))[..., 0]
    assert np.mean(settled * side[:, None] > 0.5) > 0.97
