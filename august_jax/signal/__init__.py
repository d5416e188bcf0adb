"""What the base station does: beams and pilots, echo and channel estimate, the region's field subspace."""

from august_jax.signal.beams import (
    dbm_to_watt,
    direction_angles,
    pilot_symbols,
    pilots,
    roi_codebook,
    watt_to_dbm,
)
from august_jax.signal.estimation import (
    ESTIMATORS,
    Estimate,
    Observation,
    Region,
    RegionObservation,
    echo,
    estimate,
    estimate_snr,
    observe,
    observe_roi,
)
from august_jax.signal.roi import legendre_basis, legendre_degrees, lift, project, spherical_phases

__all__ = [
    "ESTIMATORS",
    "Estimate",
    "Observation",
    "Region",
    "RegionObservation",
    "dbm_to_watt",
    "direction_angles",
    "echo",
    "estimate",
    "estimate_snr",
    "legendre_basis",
    "legendre_degrees",
    "lift",
    "observe",
    "observe_roi",
    "pilot_symbols",
    "pilots",
    "project",
    "roi_codebook",
    "spherical_phases",
    "watt_to_dbm",
]
