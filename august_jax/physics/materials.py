"""Complex contrast of a material (paper, eq. contrast function)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.constants import VACUUM_PERMITTIVITY


def contrast(
    permittivity: float | jax.Array, conductivity_s_m: float | jax.Array, frequency_hz: float | jax.Array
) -> jax.Array:
    """chi = (eps_r - 1) + j sigma / (2 pi f eps0), under e^{-jwt}; arguments broadcast.

    Args:
        permittivity: relative permittivity eps_r, at least 1 for ordinary matter.
        conductivity_s_m: conductivity sigma [S/m], not negative for passive matter.
        frequency_hz: f [Hz].
    """
    loss = jnp.asarray(conductivity_s_m) / (2.0 * np.pi * VACUUM_PERMITTIVITY * jnp.asarray(frequency_hz))
    return (jnp.asarray(permittivity) - 1.0) + 1j * loss
