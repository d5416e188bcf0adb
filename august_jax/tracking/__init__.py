"""From clouds to tracks: the attitude of a cloud, predictors of the next position, and the loop over slots."""

from august_jax.tracking.attitude import cloud_normals, plane_normal, rotor_plane_normal, rotor_points, triple_normal
from august_jax.tracking.loop import Followed, Located, follow
from august_jax.tracking.predictors import (
    PREDICTORS,
    FiniteDifference,
    Kalman,
    KalmanLSTM,
    Prediction,
    Predictor,
    predict_next,
)
from august_jax.tracking.track import Track

__all__ = [
    "PREDICTORS",
    "FiniteDifference",
    "Followed",
    "Kalman",
    "KalmanLSTM",
    "Located",
    "Prediction",
    "Predictor",
    "Track",
    "cloud_normals",
    "follow",
    "plane_normal",
    "predict_next",
    "rotor_plane_normal",
    "rotor_points",
    "triple_normal",
]
