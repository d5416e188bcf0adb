"""The closed loop, slot after slot: predict, place the region, listen there, find the target, tell the predictor.

In the first three slots a detection says where to listen, from then on the predictor. A craft that is lost
(:mod:`august_jax.tracking.loss`) is detected anew: the next three slots are as the first ones, and the predictor
starts again with the first of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import Config
from august_jax.signal.roi import Coefficients
from august_jax.signal.station import Statistics, observe_for
from august_jax.tracking.loss import Spread, from_elsewhere, gate, out_of_bounds, silent, surprise
from august_jax.tracking.predictors import Predictor
from august_jax.tracking.region import needed_threshold

DETECTED_SLOTS = 3
"""Slots whose predicted position comes from detection: a position, a speed and an acceleration take three."""


@runtime_checkable
class Located(Protocol):
    """What is found of the target in one slot: a pytree with a position (3,) [m], whatever else it holds."""

    @property
    def position(self) -> Any:
        """(3,) [m], or (T, 3) of T slots."""


Locate = Callable[[jax.Array, Array | Coefficients, jax.Array, jax.Array, Statistics], Located]
"""(key, what is heard of one slot, q_pre (3,) [m], SNR () [dB], all that the echo says) -> what is found."""


class Followed(NamedTuple):
    """A loop over T slots.

    Attributes:
        predicted: q_pre, about which was listened (T, 3) [m].
        snr_db: the realised SNR (T,) [dB].
        found: what was found, with a leading T.
        statistics: what the echoes say, with a leading T.
        detected: whether a detection said where to listen (T,), and not the predictor.
        lost: whether what was heard or found shows that the target is not where it was looked for (T,).
        threshold_m: what the region must allow for the prediction (T,) [m]; NaN where a detection said where to listen.
    """

    predicted: Float[Array, "slots 3"]
    snr_db: Float[Array, " slots"]
    found: Located
    statistics: Statistics
    detected: Bool[Array, " slots"]
    lost: Bool[Array, " slots"]
    threshold_m: Float[Array, " slots"]


def follow(
    key: jax.Array,
    channels: Complex[Array, "slots tones antennas antennas"],
    detected: Float[Array, "slots 3"],
    snr_db: ArrayLike,
    config: Config,
    predictor: Predictor,
    locate: Locate,
) -> Followed:
    """Follow one target through its true channels; pure, to be jitted by the caller.

    Args:
        key: slot t draws from ``fold_in(key, t)``.
        channels: H in each slot (T, F, N_b, N_b).
        detected: where a detection puts the target (T, 3) [m]; taken in the first three slots, and in three after a
            loss.
        snr_db: to which the power is set in each slot [dB].
        config: of the station and of what it tells.
        predictor: of the positions from the fourth slot on.
        locate: what finds the target in what is heard.
    """

    def slot(state, now):
        known, age, spread = state
        number, channel, detection = now
        ahead, expected = predictor.predict(known)
        blind = age < DETECTED_SLOTS
        predicted = jnp.where(blind, detection, expected.position)
        echo_key, found_key = jax.random.split(jax.random.fold_in(key, number))
        seen = observe_for(config, echo_key, channel, predicted, snr_db=snr_db)
        found = locate(found_key, seen.heard, predicted, seen.snr_estimate_db, seen.statistics)

        factor = spread.factor(predictor.spread)
        square, outside = surprise(found.position - predicted, expected.covariance, config.region.scale_m)
        unheard = silent(seen.statistics) | from_elsewhere(seen, predicted, config)
        unheard |= out_of_bounds(predicted, config) | out_of_bounds(found.position, config)
        lost = unheard | (~blind & ((square > gate(3) * factor) | outside))
        threshold = jnp.where(blind, jnp.nan, needed_threshold(factor * expected.covariance))

        begun, updated = predictor.start(found.position), predictor.update(ahead, found.position)
        known = jax.tree.map(lambda first, later: jnp.where(age == 0, first, later), begun, updated)
        state = known, jnp.where(lost, 0, age + 1), spread.heard(square, factor, ~(blind | unheard))
        return state, Followed(predicted, seen.snr_db, found, seen.statistics, blind, lost, threshold)

    numbers = jnp.arange(channels.shape[0])
    start = predictor.start(detected[0]), jnp.asarray(0, jnp.int32), Spread.of(predictor.spread)
    return jax.lax.scan(slot, start, (numbers, channels, detected))[1]
