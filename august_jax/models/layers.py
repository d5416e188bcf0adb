"""Linear layers and the small networks made of them, shared by the other modules."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from august_jax.arrays import Array

PRECISION = jax.lax.Precision.DEFAULT
"""Of the networks' products: what the device does fastest, on NVIDIA's GPUs factors of 10 binary digits (TF32)."""


def dense(features_in: int, features_out: int, *, rngs: nnx.Rngs, gain: float = 1.0, bias: bool = True) -> nnx.Linear:
    """A linear layer with Gaussian weights of variance gain/features_in (1: LeCun, 2: He, 0: zeros), zero bias.

    NumPy draws the weights, from the key's bits: a jax sampler compiles anew for every shape, which took 20 s for
    the networks of the laptop preset. Modules must therefore be built outside of any jax transformation.
    """

    def weights(key, shape, dtype):
        draw = np.random.default_rng(np.asarray(jax.random.key_data(key))).standard_normal(shape)
        return jnp.asarray((draw * math.sqrt(gain / features_in)).astype(dtype))

    def zeros(_, shape, dtype):
        return jnp.asarray(np.zeros(shape, dtype))

    return nnx.Linear(
        features_in, features_out, use_bias=bias, kernel_init=weights, bias_init=zeros, precision=PRECISION, rngs=rngs
    )


class MLP(nnx.Module):
    """Linear layers of the given ``sizes`` with LeakyReLU between them; the last one's gain is ``last_gain``."""

    def __init__(self, *sizes: int, rngs: nnx.Rngs, last_gain: float = 1.0):
        gains = [2.0] * (len(sizes) - 2) + [last_gain]
        gains[0] = min(gains[0], 1.0)  # the inputs did not pass an activation
        self.layers = nnx.List(dense(a, b, gain=g, rngs=rngs) for a, b, g in zip(sizes, sizes[1:], gains))

    def __call__(self, x: Float[Array, "*batch features"]) -> Float[jax.Array, "*batch out"]:
        hidden = jnp.asarray(x)
        for index, layer in enumerate(self.layers):
            hidden = layer(jax.nn.leaky_relu(hidden) if index else hidden)
        return hidden


class ResidualMLP(nnx.Module):
    """A linear map to ``features``, then ``layers`` blocks x + LeakyReLU(Linear(x))/sqrt(layers).

    The division keeps the scale of x through any number of blocks.
    """

    def __init__(self, features_in: int, features: int, layers: int, *, rngs: nnx.Rngs):
        self.stem = dense(features_in, features, rngs=rngs)
        self.blocks = nnx.List(dense(features, features, gain=2.0, rngs=rngs) for _ in range(layers))

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[jax.Array, "*batch features"]:
        hidden = self.stem(x)
        for block in self.blocks:
            hidden = hidden + jax.nn.leaky_relu(block(hidden)) / len(self.blocks) ** 0.5
        return hidden
