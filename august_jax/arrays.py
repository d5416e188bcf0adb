"""Types of arrays at public edges; shapes are written with jaxtyping, ``Float[Array, "n 3"]``. And what numbers are."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

Array = jax.Array | np.ndarray
"""An array of JAX or of NumPy."""
ArrayLike = Array | np.number | float | int | complex
"""An array or a plain number."""


def rows_not_finite(value: Any) -> np.ndarray:
    """Which rows of arrays that share their first axis hold NaN or infinity, in order; none of the abstract values
    inside jit, grad and vmap, whose numbers cannot be looked at.

    Args:
        value: an array, or a pytree of them.
    """
    found = np.zeros(0, np.int64)
    for leaf in jax.tree.leaves(value):
        if not isinstance(leaf, jax.core.Tracer):
            leaf = np.atleast_1d(leaf)
            if leaf.size and not np.isfinite(leaf).all():
                found = np.union1d(found, np.flatnonzero(~np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1)))
    return found
