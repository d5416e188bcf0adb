"""What a predictor of the next position is: a state that starts, is predicted over a slot and updated by an estimate.

States are pytrees of fixed shapes and predictors are hashable, so that a flight is one ``jax.lax.scan``.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Float, Num

from august_jax.arrays import Array

ESTIMATE_M = 0.1
"""What a predictor for flights takes an estimate to err by, a standard deviation along an axis [m]: networks do in some
12 cm at 20 dB, all axes together."""
State = Any
"""A pytree of arrays whose shapes never change."""


class Prediction(NamedTuple):
    """Where the target will be.

    Attributes:
        position: (3,) [m].
        covariance: of the innovation, next estimate minus prediction (3, 3) [m^2]; infinite variances where nothing is
            known of it.
    """

    position: Float[Array, "3"]
    covariance: Float[Array, "3 3"]


@runtime_checkable
class Predictor(Protocol):
    """Three functions of positions [m], pure and mappable, and how far their covariance is to be trusted."""

    @property
    def spread(self) -> float:
        """Mean squared innovation in units of the stated covariance, an axis, as measured on flights; 1 where it is
        right."""
        ...

    def start(self, position: Float[Array, "3"]) -> State:
        """The state after the first estimate (3,) [m]."""
        ...

    def predict(self, state: State) -> tuple[State, Prediction]:
        """The state one slot later, and what it expects there."""
        ...

    def update(self, state: State, position: Float[Array, "3"]) -> State:
        """A predicted state after the estimate (3,) [m] of its slot."""
        ...


def real(positions: Num[Array, "*slots 3"]) -> Float[jax.Array, "*slots 3"]:
    """Places (..., 3) [m] as real numbers: whole ones would round all that follows."""
    positions = jnp.asarray(positions)
    return positions if jnp.issubdtype(positions.dtype, jnp.floating) else positions.astype(jnp.float32)


def predict_next(predictor: Predictor, positions: Float[Array, "slots 3"]) -> Prediction:
    """The next position from past estimates (T, 3) [m], oldest first, T >= 1.

    Raises:
        ValueError: no position, or a shape other than (T, 3).
    """
    if positions.ndim != 2 or positions.shape[-1] != 3 or positions.shape[0] < 1:
        raise ValueError(f"positions: got shape {positions.shape}; give one past position or more, (T, 3) in metres")
    positions = real(positions)

    def slot(state: State, position: jax.Array) -> tuple[State, None]:
        return predictor.update(predictor.predict(state)[0], position), None

    state, _ = jax.lax.scan(slot, predictor.start(positions[0]), positions[1:])
    return predictor.predict(state)[1]
