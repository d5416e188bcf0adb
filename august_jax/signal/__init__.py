"""What the base station does: beams and pilots, echo and channel estimate, the region's field subspace."""

from august_jax.signal.beams import dbm_to_watt, direction_angles, pilot_symbols, pilots, roi_codebook, watt_to_dbm
from august_jax.signal.estimators import ESTIMATORS, ChannelEstimate, Estimator, Region, estimate_channel
from august_jax.signal.noise import estimate_snr
from august_jax.signal.roi import (
    Coefficients,
    Subspace,
    legendre_basis,
    legendre_degrees,
    lift,
    project,
    recentre,
    spherical_phases,
    towards,
)
from august_jax.signal.station import (
    Observation,
    RegionObservation,
    Statistics,
    echo,
    observe,
    observe_for,
    observe_region,
)

__all__ = [
    "ESTIMATORS",
    "ChannelEstimate",
    "Coefficients",
    "Estimator",
    "Observation",
    "Region",
    "RegionObservation",
    "Statistics",
    "Subspace",
    "dbm_to_watt",
    "direction_angles",
    "echo",
    "estimate_channel",
    "estimate_snr",
    "legendre_basis",
    "legendre_degrees",
    "lift",
    "observe",
    "observe_for",
    "observe_region",
    "pilot_symbols",
    "pilots",
    "project",
    "recentre",
    "roi_codebook",
    "spherical_phases",
    "towards",
    "watt_to_dbm",
]
