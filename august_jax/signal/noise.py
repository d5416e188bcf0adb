"""Energies, white noise and the SNR that a receiver can know."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike


def energy(array: Complex[Array, "*batch rows columns"]) -> Float[jax.Array, "*batch"]:
    """Squared Frobenius norm over the last two axes."""
    return jnp.sum(jnp.real(array) ** 2 + jnp.imag(array) ** 2, axis=(-2, -1))


def white_noise(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Circular Gaussian entries of unit power, complex64."""
    parts = np.float32(np.sqrt(0.5)) * jax.random.normal(key, (2, *shape), jnp.float32)
    return jax.lax.complex(parts[0], parts[1])


def estimate_snr(received: Complex[Array, "*batch antennas symbols"], noise_w: ArrayLike) -> Float[jax.Array, "*batch"]:
    """SNR (linear) that a receiver can know, (||Y||^2 - E||N||^2)/E||N||^2, floored at the spread of ||N||^2.

    Args:
        received: Y (..., N_b, L) [sqrt(W)].
        noise_w: sigma^2 [W].
    """
    return snr_above_noise(energy(received) / noise_w, received.shape[-2] * received.shape[-1])


def snr_above_noise(received_energy: ArrayLike, entries: int) -> jax.Array:
    """:func:`estimate_snr` from ||Y||^2/sigma^2 of so many entries."""
    return jnp.maximum(received_energy / entries - 1.0, 1.0 / np.sqrt(entries))
