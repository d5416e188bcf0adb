"""How large the region about a prediction must be, from how far the predictor says that it may miss.

The region is the cube of half edge s = (half-wheelbase) + (threshold) about q_pre: a prediction may miss by up to the
threshold along each axis. With the covariance S of the innovation, which a predictor states, the variance R of the
estimate's own error, which is part of it, and Gaussian errors, all three axes are within

    threshold = sigma z,   sigma^2 = max_i S_ii - R,   (2 Phi(z) - 1)^3 = SHARE

in the share SHARE of slots at least. R is what predictors take for granted (ESTIMATE_M); where estimates are worse, and
S has grown with them, that is rather too much than too little.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.tracking.predictors import Predictor
from august_jax.tracking.predictors.protocol import ESTIMATE_M

SHARE = 0.95
"""Of the predictions, which are to miss by no more than the threshold along each axis."""
_SETTLED = 30
"""Slots after which a predictor's covariance stays as it is."""


def needed_threshold(covariance: Float[Array, "*batch 3 3"]) -> Float[jax.Array, "*batch"]:
    """The threshold (...) [m] that a region must allow for innovations of these covariances (..., 3, 3) [m^2].

    Infinite where nothing is known of them.
    """
    quantile = NormalDist().inv_cdf(0.5 + 0.5 * SHARE ** (1.0 / 3.0))
    largest = jnp.max(jnp.diagonal(covariance, axis1=-2, axis2=-1), axis=-1)
    return quantile * jnp.sqrt(jnp.maximum(largest - ESTIMATE_M**2, 0.0))


def settled_threshold(predictor: Predictor) -> float:
    """The threshold [m] that a predictor needs once it has followed for seconds: before a flight, the best guess."""

    def slot(state, _):
        state, ahead = predictor.predict(state)
        return predictor.update(state, ahead.position), ahead.covariance

    stated = jax.lax.scan(slot, predictor.start(jnp.zeros(3)), length=_SETTLED)[1][-1]
    return float(needed_threshold(predictor.spread * stated))


def smallest_region(thresholds_m: Sequence[float], needed_m: float) -> int:
    """Which of some regions, told by their thresholds [m], is the smallest that allows ``needed_m``; where none does,
    the largest.

    Raises:
        ValueError: no region.
    """
    if not len(thresholds_m):
        raise ValueError("thresholds_m: got none; give the threshold of one region or more")
    enough = [row for row, threshold in enumerate(thresholds_m) if threshold >= needed_m]
    if enough:
        return min(enough, key=lambda row: thresholds_m[row])
    return max(range(len(thresholds_m)), key=lambda row: thresholds_m[row])
