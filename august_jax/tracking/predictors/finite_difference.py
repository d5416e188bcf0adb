"""The paper's kinematic prediction (Section III): velocity and acceleration by backward differences,

    q + v dt + a dt^2 / 2 = 2.5 q_1 - 2 q_2 + 0.5 q_3

with q_1 the latest position. It multiplies the error of an estimate by 3.2. Two positions are continued at constant
velocity, one is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Float, Int

from august_jax.arrays import Array
from august_jax.config import FlightConfig
from august_jax.tracking.predictors.protocol import Prediction, real

GAINS = ((1.0, 0.0, 0.0), (2.0, -1.0, 0.0), (2.5, -2.0, 0.5))
"""Weights of the latest, last but one and last but two positions, where one, two, or three and more are known."""
_INNOVATION_M = {"smooth": 0.34, "dynamic": 0.35, "jump": 1.0}
"""By style, of estimates that err by 10 cm along an axis: experiments/prediction.py, mean of both boxes; the innovation
has the error of the next estimate, too."""


class Past(NamedTuple):
    """The last three positions (3, 3) [m], latest first, and how many there have been ()."""

    positions: Float[Array, "3 3"]
    count: Int[Array, ""]


@dataclass(frozen=True)
class FiniteDifference:
    """The paper's predictor.

    Attributes:
        innovation_m: standard deviation of its innovations along an axis, where three positions are known [m].
        spread: see :class:`Predictor`.
    """

    innovation_m: float = float("inf")
    spread: float = 1.0

    @classmethod
    def for_flight(cls, flight: FlightConfig) -> FiniteDifference:
        """With what was measured on flights of the style."""
        return cls(_INNOVATION_M[flight.style])

    def start(self, position: Float[Array, "3"]) -> Past:
        """See :class:`Predictor`."""
        return Past(jnp.tile(real(position), (3, 1)), jnp.asarray(1, jnp.int32))

    def predict(self, state: Past) -> tuple[Past, Prediction]:
        """See :class:`Predictor`."""
        gains = jnp.asarray(GAINS, state.positions.dtype)[jnp.minimum(state.count, 3) - 1]
        innovation = jnp.where(state.count < 3, jnp.inf, jnp.asarray(self.innovation_m, state.positions.dtype))
        return state, Prediction(gains @ state.positions, jnp.diag(jnp.full(3, innovation**2)))

    def update(self, state: Past, position: Float[Array, "3"]) -> Past:
        """See :class:`Predictor`."""
        return Past(jnp.concatenate([position[None], state.positions[:2]]), state.count + 1)
