r"""The learnable prior p_psi(z): RealNVP with affine couplings (paper, eq. loss z; Dinh et al., 2017).

z = F_psi(nu), nu standard normal. A coupling keeps the coordinates of its mask and maps the others by
z_i = nu_i exp(a_i) + b_i, where a, b are functions of the kept ones; masks of even and odd coordinates alternate.
a is bounded by a scaled tanh, which keeps the density finite wherever the encoder wanders.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float, Key

from august_jax.arrays import Array
from august_jax.models.layers import MLP

if TYPE_CHECKING:
    from distrax import Distribution

_LOG_SCALE_LIMIT = 2.0


class Conditioner(nnx.Module):
    """(..., D) -> the bounded log-scale and the shift of a coupling, (..., D, 2); zero at the start."""

    def __init__(self, size: int, features: int, *, rngs: nnx.Rngs):
        self.network = MLP(size, features, features, 2 * size, last_gain=0.0, rngs=rngs)

    def __call__(self, kept: Float[Array, "*batch size"]) -> Float[jax.Array, "*batch size 2"]:
        raw, shift = jnp.split(self.network(kept), 2, axis=-1)
        return jnp.stack([_LOG_SCALE_LIMIT * jnp.tanh(raw / _LOG_SCALE_LIMIT), shift], axis=-1)


class RealNVP(nnx.Module):
    """A density over ``size`` coordinates by ``layers`` couplings of ``features`` hidden units."""

    def __init__(self, size: int, layers: int, features: int, *, rngs: nnx.Rngs):
        self.size = size
        self.conditioners = nnx.List(Conditioner(size, features, rngs=rngs) for _ in range(layers))

    def distribution(self) -> Distribution:
        """The distrax distribution of z; its bijector maps nu to z."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            import distrax  # here, because it takes seconds to import

        def affine(parameters):
            return distrax.ScalarAffine(shift=parameters[..., 1], log_scale=parameters[..., 0])

        couplings = [
            distrax.MaskedCoupling(jnp.arange(self.size) % 2 == index % 2, conditioner, affine)
            for index, conditioner in enumerate(self.conditioners)
        ]
        base = distrax.MultivariateNormalDiag(jnp.zeros(self.size), jnp.ones(self.size))
        return distrax.Transformed(base, distrax.Chain(couplings[::-1]))  # a Chain applies its last member first

    def log_prob(self, latent: Float[Array, "*batch size"]) -> Float[jax.Array, "*batch"]:
        """log p_psi(z) (...,) of latent codes (..., D)."""
        return self.distribution().log_prob(latent)

    def sample(self, key: Key[Array, ""], count: int) -> Float[jax.Array, "{count} size"]:
        """``count`` latent codes (count, D) of the prior."""
        return self.distribution().sample(seed=key, sample_shape=(count,))
