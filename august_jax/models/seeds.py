r"""Seed points: a few of a cloud's own points, which tell the others what the condition leaves open.

Given z alone points are independent, so that two headings, or two craft, that the channel cannot tell apart come out
laid over each other. The points of one cloud are exchangeable, though: drawn one after the other, each given those
before it, they settle on one craft,

    p(x_1 ... x_M | z) ~ p(x_1 | z) p(x_2 | x_1, z) ... p(x_K | x_1 ... x_{K-1}, z) prod_i p(x_i | x_1 ... x_K, z).

After K seeds the rest is drawn at once. A set of any number of seeds up to K enters through the sum of a network's
features of each (Zaheer et al., "Deep Sets", 2017), which a second network reads together with the condition: where
the arms of a craft point follows from all seeds at once. In training the number is uniform in 0..K.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx

from august_jax.models.embedding import fourier_features
from august_jax.models.layers import MLP

_OCTAVES = 3
_WIDTH = 96
_JITTER = 0.02
"""Standard deviation of what is added to seeds in training: those of a reconstruction are not exactly on a craft."""


class Seeds(nnx.Module):
    """A condition of ``condition`` numbers and up to ``count`` points of five -> features (B, ``size``)."""

    size = 64

    def __init__(self, count: int, condition: int, *, rngs: nnx.Rngs):
        self.count = count
        self.each = MLP(5 * (2 * _OCTAVES + 1), _WIDTH, _WIDTH, rngs=rngs)
        self.together = MLP(_WIDTH + 1 + condition, 2 * _WIDTH, 2 * _WIDTH, self.size, rngs=rngs)

    def __call__(self, points: jax.Array, known: jax.Array, condition: jax.Array) -> jax.Array:
        """Features of the first ``known`` (B,) int32 of the points (B, count, 5) and the condition (B, C)."""
        mask = (jnp.arange(self.count) < known[:, None]).astype(points.dtype)
        features = self.each(fourier_features(0.5 * points, _OCTAVES))
        pooled = jnp.sum(mask[..., None] * features, axis=1) / self.count**0.5
        return self.together(jnp.concatenate([pooled, jnp.mean(mask, axis=1, keepdims=True), condition], axis=-1))


def draw_seeds(key: jax.Array, cloud: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For training: the points (B, K, 5) of a cloud, shaken a little, and how many count, uniform in 0..K."""
    number_key, shake_key = jax.random.split(key)
    known = jax.random.randint(number_key, cloud.shape[:1], 0, cloud.shape[1] + 1)
    return cloud + _JITTER * jax.random.normal(shake_key, cloud.shape), known
