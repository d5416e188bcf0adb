"""The closed loop, slot after slot: predict, listen there, find the target, tell the predictor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import Config
from august_jax.signal.roi import Coefficients
from august_jax.signal.station import Statistics, observe_for
from august_jax.tracking.predictors import Predictor

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
    """A loop over T slots: q_pre (T, 3) [m], the realised SNR (T,) [dB], what was found and what the echoes say, with a
    leading T."""

    predicted: Float[Array, "slots 3"]
    snr_db: Float[Array, " slots"]
    found: Located
    statistics: Statistics


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
        detected: where a detection puts the target (T, 3) [m]; the first three are used.
        snr_db: to which the power is set in each slot [dB].
        config: of the station and of what it tells.
        predictor: of the positions from the fourth slot on.
        locate: what finds the target in what is heard.
    """

    def slot(state, now):
        number, channel, detection = now
        expected = predictor.predict(state)[1].position
        predicted = jnp.where(number < DETECTED_SLOTS, detection, expected)
        echo_key, found_key = jax.random.split(jax.random.fold_in(key, number))
        seen = observe_for(config, echo_key, channel, predicted, snr_db=snr_db)
        found = locate(found_key, seen.heard, predicted, seen.snr_estimate_db, seen.statistics)
        begun, updated = predictor.start(found.position), predictor.update(predictor.predict(state)[0], found.position)
        state = jax.tree.map(lambda first, later: jnp.where(number == 0, first, later), begun, updated)
        return state, Followed(predicted, seen.snr_db, found, seen.statistics)

    numbers = jnp.arange(channels.shape[0])
    return jax.lax.scan(slot, predictor.start(detected[0]), (numbers, channels, detected))[1]
