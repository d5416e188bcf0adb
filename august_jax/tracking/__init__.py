"""From clouds to tracks: the attitude of a cloud, predictors of the next position, the region about it, and the loop
over slots with what tells that a craft is lost."""

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
    predictor_for,
)
from august_jax.tracking.region import needed_threshold, settled_threshold, smallest_region
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
    "needed_threshold",
    "plane_normal",
    "predict_next",
    "predictor_for",
    "rotor_plane_normal",
    "rotor_points",
    "settled_threshold",
    "smallest_region",
    "triple_normal",
]
