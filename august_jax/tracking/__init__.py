"""From clouds to tracks: predictors of the next position and the attitude of a cloud."""

from august_jax.tracking.attitude import plane_normal, rotor_points, triple_normal
from august_jax.tracking.predictors import (
    KalmanState,
    Prediction,
    finite_difference,
    kalman,
    kalman_predict,
    kalman_start,
    kalman_update,
)

__all__ = [
    "KalmanState",
    "Prediction",
    "finite_difference",
    "kalman",
    "kalman_predict",
    "kalman_start",
    "kalman_update",
    "plane_normal",
    "rotor_points",
    "triple_normal",
]
