r"""A craft's signature: how many arms it has and where they point, drawn once a cloud.

Given z alone points are independent, so that headings, or craft, that the channel cannot tell apart come out laid over
each other: a disc. A cloud therefore first settles on one: its harmonics of heading c_1..c_8 (`craft.Reading`), which
1000 surface points fix to a percent, are drawn by a diffusion of their own, and the points given them,

    p(p_1 ... p_M | z) = int p(c | z) prod_i p(p_i | c, z) dc.

The points are diffused in axes turned to the heading that c states (`Reading.heading`), where the arms of all craft of
one kind coincide; what c says beyond it, turned alike, tells the kind (`Reading.kind`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float, Key

from august_jax.arrays import Array
from august_jax.config import TimeEmbedding
from august_jax.mesh import own_rows
from august_jax.models.craft import HARMONICS
from august_jax.models.denoiser import Denoiser
from august_jax.models.diffusion import PointSampler, Schedule, add_noise, draw_noise, draw_steps

_NUMBERS = 2 * HARMONICS
_WIDTHS = (256, 256, 256)
_SCALE = 4.0  # brings the harmonics of arms, some 0.3, to the size of the noise
_JITTER = 0.01


class Signature(nnx.Module):
    """The density p(c | z) of harmonics (B, 16) under a condition of ``condition`` numbers."""

    def __init__(self, condition: int, schedule: Schedule, time_embedding: TimeEmbedding, *, rngs: nnx.Rngs):
        self.schedule = schedule
        self.denoiser = Denoiser(_WIDTHS, condition, schedule, time_embedding, rngs=rngs, dimensions=_NUMBERS)

    def loss(
        self, key: Key[Array, ""], harmonics: Float[Array, "batch 16"], condition: Float[Array, "batch features"]
    ) -> Float[jax.Array, ""]:
        """Mean squared error of the estimated noise over the 16 numbers and the clouds, ()."""
        step_key, noise_key = jax.random.split(key)
        clean = _SCALE * harmonics[:, None]
        step, noise = draw_steps(step_key, len(clean), self.schedule), draw_noise(noise_key, clean)
        found = self.denoiser(add_noise(clean, noise, step, self.schedule), step, condition)
        return jnp.mean((noise - found) ** 2)

    def draw(
        self, key: Key[Array, ""], condition: Float[Array, "batch features"], sample: PointSampler
    ) -> Float[jax.Array, "batch 16"]:
        """Harmonics (B, 16) for conditions (B, C)."""
        shape = (len(condition), 1, _NUMBERS)
        return sample(key, lambda points, step: self.denoiser(points, step, condition), shape)[:, 0] / _SCALE


def shaken(key: Key[Array, ""], harmonics: Float[Array, "*batch 16"]) -> Float[jax.Array, "*batch 16"]:
    """For training: harmonics a little off, as those that are drawn will be."""
    noise = own_rows(lambda rows: jax.random.normal(key, (rows, *harmonics.shape[1:])), len(harmonics))
    return jnp.asarray(harmonics) + _JITTER * noise
