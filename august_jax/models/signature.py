r"""A craft's signature: how many arms it has and where they point, drawn once a cloud.

Given z alone points are independent, so that headings, or craft, that the channel cannot tell apart come out laid over
each other: a disc. A cloud therefore first settles on one: its harmonics of heading c_1..c_8 (`frame.moments`), which
1000 surface points fix to a percent, are drawn by a diffusion of their own, and the points given them,

    p(p_1 ... p_M | z) = int p(c | z) prod_i p(p_i | c, z) dc.

The points are diffused in axes turned to the heading that c states (`frame.heading`), where the arms of all craft of
one kind coincide; what c says beyond it, turned alike, tells the kind.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx

from august_jax.models.denoiser import Denoiser
from august_jax.models.diffusion import Schedule, add_noise, draw_steps
from august_jax.models.frame import HARMONICS

NUMBERS = 2 * HARMONICS
"""Real and imaginary parts of c_1..c_8."""
_WIDTHS = (256, 256, 256)
_SCALE = 4.0  # brings the harmonics of arms, some 0.3, to the size of the noise
_JITTER = 0.01


class Signature(nnx.Module):
    """The density p(c | z) of harmonics (B, 16) under a condition of ``condition`` numbers."""

    def __init__(self, condition: int, schedule: Schedule, time_embedding: str, *, rngs: nnx.Rngs):
        self.schedule = schedule
        self.denoiser = Denoiser(_WIDTHS, condition, schedule, time_embedding, rngs=rngs, dimensions=NUMBERS)

    def loss(self, key: jax.Array, harmonics: jax.Array, condition: jax.Array) -> jax.Array:
        """Mean squared error of the estimated noise over the 16 numbers and the clouds, ()."""
        step_key, noise_key = jax.random.split(key)
        clean = _SCALE * harmonics[:, None]
        step, noise = draw_steps(step_key, len(clean), self.schedule), jax.random.normal(noise_key, clean.shape)
        found = self.denoiser(add_noise(clean, noise, step, self.schedule), step, condition)
        return jnp.mean((noise - found) ** 2)

    def draw(self, key: jax.Array, condition: jax.Array, sample) -> jax.Array:
        """Harmonics (B, 16) for conditions (B, C); ``sample`` is a sampler, (key, denoise, shape) -> draws."""
        shape = (len(condition), 1, NUMBERS)
        return sample(key, lambda points, step: self.denoiser(points, step, condition), shape)[:, 0] / _SCALE


def shaken(key: jax.Array, harmonics: jax.Array) -> jax.Array:
    """For training: harmonics a little off, as those that are drawn will be."""
    return harmonics + _JITTER * jax.random.normal(key, harmonics.shape)
