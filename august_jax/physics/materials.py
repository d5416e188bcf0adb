"""Complex contrast of a material (paper, eq. contrast function)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex

from august_jax.arrays import ArrayLike
from august_jax.constants import VACUUM_PERMITTIVITY
from august_jax.physics.checks import check_finite, is_concrete


def contrast(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, frequency_hz: ArrayLike
) -> Complex[jax.Array, "..."]:
    """chi = (eps_r - 1) + j sigma / (2 pi f eps0), under e^{-jwt}; arguments broadcast.

    Args:
        permittivity: relative permittivity eps_r, at least 1 for ordinary matter.
        conductivity_s_m: conductivity sigma [S/m], not negative for passive matter.
        frequency_hz: f [Hz].

    Raises:
        ValueError: numbers that are not finite, or a frequency that is not positive.
    """
    check_finite("permittivity", permittivity, "give a number, 1 for air")
    check_finite("conductivity_s_m", conductivity_s_m, "give a number, and a large one for metal")
    if is_concrete(frequency_hz) and not (np.all(np.isfinite(frequency_hz)) and np.all(np.asarray(frequency_hz) > 0)):
        raise ValueError(f"frequency_hz: got {frequency_hz!r}; give positive frequencies in Hz, e.g. 3e9")
    loss = jnp.asarray(conductivity_s_m) / (2.0 * np.pi * VACUUM_PERMITTIVITY * jnp.asarray(frequency_hz))
    return (jnp.asarray(permittivity) - 1.0) + 1j * loss
