"""Where the target will be in the next slot, from the positions estimated so far (paper, Section III).

A predictor is added by one file that follows :class:`Predictor` and one line in :data:`PREDICTORS`.
"""

from typing import Any

from august_jax.config import FlightConfig
from august_jax.config.fields import near
from august_jax.tracking.predictors.finite_difference import FiniteDifference
from august_jax.tracking.predictors.kalman import Kalman
from august_jax.tracking.predictors.lstm import KalmanLSTM
from august_jax.tracking.predictors.protocol import Prediction, Predictor, predict_next

PREDICTORS: dict[str, Any] = {"finite_difference": FiniteDifference, "kalman": Kalman, "lstm": KalmanLSTM}
"""The predictors by name; each has ``for_flight``, a :class:`~august_jax.config.FlightConfig` -> predictor."""


def predictor_for(name: str, flight: FlightConfig) -> Predictor:
    """The predictor of that name for such flights.

    Raises:
        ValueError: there is none (names the nearest), or one that was trained for slots of another length.
    """
    if name not in PREDICTORS:
        hint = near(name, list(PREDICTORS))
        raise ValueError(
            f"predictor: unknown predictor {name!r}; {hint + ' ' if hint else ''}choose of {', '.join(PREDICTORS)}"
        )
    made: Predictor = PREDICTORS[name].for_flight(flight)
    return made


__all__ = [
    "PREDICTORS",
    "FiniteDifference",
    "Kalman",
    "KalmanLSTM",
    "Prediction",
    "Predictor",
    "predict_next",
    "predictor_for",
]
