"""Signatures: what harmonics say of a craft, and clouds that settle on one of several."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from august_jax.models.diffusion import Schedule, dpm
from august_jax.models.frame import heading, into_craft, moments, out_of_craft, straightened
from august_jax.models.signature import NUMBERS, Signature, shaken
from august_jax.scene import AIRFRAMES, procedural_airframe

ARMS = {"quad_x": 4, "quad_plus": 4, "hexa": 6, "octo": 8, "coaxial_y6": 3}


def cloud(name, yaw, seed=0):
    body = np.asarray(procedural_airframe(name).sample_surface(jax.random.key(seed), 1000))
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return jnp.asarray(np.concatenate([body @ turn.T, np.full((1000, 2), 0.5)], -1), jnp.float32)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_heading_turns_with_the_craft(name):
    readings = [np.asarray(moments(cloud(name, yaw))) for yaw in (0.0, 0.05)]
    strengths = np.hypot(readings[0][14:22], readings[0][22:])
    assert np.argmax(strengths) + 1 == ARMS[name]
    first, second = (float(heading(jnp.asarray(reading[14:]))) for reading in readings)
    sector = 2 * np.pi / ARMS[name]
    assert (second - first - 0.05 + sector / 2) % sector - sector / 2 == pytest.approx(0.0, abs=0.005)
    # whichever of its arms the heading is taken along, the harmonics that its arms share come out the same
    shared = np.arange(ARMS[name] - 1, 8, ARMS[name])
    rows = [np.asarray(straightened(jnp.asarray(reading[14:])))[np.append(shared, 8 + shared)] for reading in readings]
    np.testing.assert_allclose(*rows, atol=0.01)
    assert rows[0][0] > 0.3 and abs(rows[0][len(shared)]) < 1e-5


def test_arms_of_a_kind_coincide_in_the_craft_s_axes():
    """Two headings and two samples of one craft: its points come to lie on each other, and find back."""
    clouds = [cloud("hexa", 0.3, 1), cloud("hexa", 1.1, 2)]
    readings = [moments(each) for each in clouds]
    first, second = (np.asarray(into_craft(c, r, 4.0)) for c, r in zip(clouds, readings))

    def apart(a, b):
        return np.mean(np.min(np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1), axis=1))

    turned = second[:, :2] @ np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    assert apart(first, second) < 0.35 * apart(first, turned)
    np.testing.assert_allclose(out_of_craft(first, readings[0], 4.0), clouds[0], atol=1e-5)


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
    draws = np.asarray(nnx.merge(graphdef, state).draw(
        jax.random.key(1), condition, lambda key, denoise, shape: dpm(key, denoise, shape, schedule, 10)))
    share = draws @ one / (one @ one)
    assert np.mean(np.abs(np.abs(share) - 1.0) < 0.25) > 0.9
    assert 0.3 < np.mean(share > 0) < 0.7
