"""Types of arrays at public edges; shapes are written with jaxtyping, ``Float[Array, "n 3"]``."""

from __future__ import annotations

import jax
import numpy as np

Array = jax.Array | np.ndarray
"""An array of JAX or of NumPy."""
ArrayLike = Array | np.number | float | int | complex
"""An array or a plain number."""
