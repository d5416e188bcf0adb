"""Signatures: clouds that settle on one of several craft."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from august_jax.models.craft import HARMONICS
from august_jax.models.diffusion import Schedule, dpm
from august_jax.models.signature import Signature, shaken

NUMBERS = 2 * HARMONICS


def test_shaking_is_small():
    harmonics = jnp.zeros((500, NUMBERS))
    np.testing.assert_allclose(np.std(shaken(jax.random.key(0), harmonics)), 0.01, rtol=0.05)


def test_a_draw_is_one_craft_and_not_the_mean_of_two():
    """The condition leaves two signatures open: draws must be either, half of them each."""
    schedule, batch = Schedule(20, (1e-3, 0.4)), 256
    one = np.zeros(NUMBERS, np.float32)
    one[[3, 11]] = 0.3, 0.2
    graphdef, state = nnx.split(Signature(1, schedule, "log_snr", rngs=nnx.Rngs(0)))
    optimiser = optax.adam(2e-3)
    condition = jnp.zeros((batch, 1))

    @jax.jit
    def step(carry, key):
        state, memory = carry
        side, inner = jax.random.split(key)

        def loss(state):
            sign = jnp.where(jax.random.bernoulli(side, 0.5, (batch, 1)), 1.0, -1.0)
            return nnx.merge(graphdef, state).loss(inner, sign * one, condition)

        updates, memory = optimiser.update(jax.grad(loss)(state), memory, state)
        return (optax.apply_updates(state, updates), memory), None

    keys = jax.random.split(jax.random.key(0), 400)
    (state, _), _ = jax.jit(lambda carry: jax.lax.scan(step, carry, keys))((state, optimiser.init(state)))
    sample = partial(dpm, schedule=schedule, evaluations=10)
    draw = jax.jit(lambda state: nnx.merge(graphdef, state).draw(jax.random.key(1), condition, sample))
    draws = np.asarray(draw(state))
    share = draws @ one / (one @ one)
    assert np.mean(np.abs(np.abs(share) - 1.0) < 0.25) > 0.9
    assert 0.3 < np.mean(share > 0) < 0.7
