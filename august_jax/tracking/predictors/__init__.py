"""Where the target will be in the next slot, from the positions estimated so far (paper, Section III).

A predictor is added by one file that follows :class:`Predictor` and one line in :data:`PREDICTORS`.
"""

from august_jax.tracking.predictors.finite_difference import FiniteDifference
from august_jax.tracking.predictors.kalman import Kalman
from august_jax.tracking.predictors.lstm import KalmanLSTM
from august_jax.tracking.predictors.protocol import Prediction, Predictor, predict_next

PREDICTORS = {"finite_difference": FiniteDifference, "kalman": Kalman, "lstm": KalmanLSTM}
"""The predictors by name; each has ``for_flight``, a :class:`~august_jax.config.FlightConfig` -> predictor."""

__all__ = ["PREDICTORS", "FiniteDifference", "Kalman", "KalmanLSTM", "Prediction", "Predictor", "predict_next"]
