r"""Fourier features of the predicted position and of the SNR (paper, eqs. position encoding and SNR encoding).

For every coordinate x the features are x, sin(2^0 pi x), cos(2^0 pi x), ..., sin(2^(d-1) pi x), cos(2^(d-1) pi x)
with d = d_xi octaves. The paper feeds metres and a plain ratio; in metres the lowest octave already repeats every
2 m, so by default the position is first mapped from the flight box to [-1, 1] and the SNR enters as (dB - 15)/20.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.config import FlightConfig


def fourier_features(values: Float[Array, "*batch values"], octaves: int) -> Float[jax.Array, "*batch features"]:
    """Features (..., D (2 d + 1)) of dimensionless ``values`` (..., D) with d = ``octaves``."""
    angles = jnp.pi * 2.0 ** jnp.arange(octaves, dtype=values.dtype) * values[..., None]
    waves = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=-1)
    return jnp.concatenate([values, waves.reshape(*values.shape[:-1], -1)], axis=-1)


def position_features(
    predicted: Float[Array, "*batch 3"], octaves: int, flight: FlightConfig, *, raw_metres: bool
) -> Float[jax.Array, "*batch features"]:
    """xi(q_pre), (..., 3 (2 d + 1)), of predicted positions (..., 3) [m].

    ``raw_metres`` keeps the metres, as the paper prints; otherwise the flight box spans [-1, 1].
    """
    if not raw_metres:
        low, high = jnp.asarray(flight.box_m, predicted.dtype).T
        predicted = (2.0 * predicted - low - high) / jnp.maximum(high - low, 1e-3)
    return fourier_features(predicted, octaves)


def snr_features(snr_db: Float[Array, "*batch"], octaves: int) -> Float[jax.Array, "*batch features"]:
    """xi(P_snr), (..., 2 d + 1), of the SNR (...,) [dB]."""
    return fourier_features((snr_db[..., None] - 15.0) / 20.0, octaves)
