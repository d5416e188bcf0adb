"""The differentiable full-wave simulator: pure functions of arrays, e^{-jwt}, SI units."""

from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body import (
    Body,
    alike,
    body_channel,
    cache_folder,
    evened,
    factor_bodies,
    factor_body,
    judge_contrast,
)
from august_jax.physics.body.table import Table, stack_tables, table_channel
from august_jax.physics.body.tabulate import tabulate, tabulate_bodies
from august_jax.physics.cells import Cells
from august_jax.physics.channel import SOLVERS, sensing_channel, sensing_channels
from august_jax.physics.doppler import (
    DopplerMap,
    Spinning,
    blade_flash_rate,
    doppler_shift,
    doppler_spectrum,
    range_doppler,
    slow_time_channels,
    spectrogram,
)
from august_jax.physics.environment import Plane, environment_channel, environment_sensing_channel, fresnel, mirrored
from august_jax.physics.green import coupling_matrix, dipole_fields, dyadic_green, path_difference
from august_jax.physics.information import (
    Spread,
    fisher_information,
    mean_position_error,
    position_bound,
    tilt_bound,
    unknown_gain_position_bound,
    without_gain,
)
from august_jax.physics.krylov import KrylovSolution, solve_krylov
from august_jax.physics.materials import contrast
from august_jax.physics.mom import Solution, interaction_matrix, self_term, solve_dense
from august_jax.physics.parameters import PARAMETERS, Parameters, moved, parameter_channel, rotation_from_vector
from august_jax.physics.rcs import POLARISATIONS, dbsm, looking, polarisations, scattering_matrix, seen_from
from august_jax.physics.refinement import Refined, channel_with_error, extrapolated
from august_jax.physics.tmatrix import (
    SphericalBasis,
    degree_for,
    regular_waves,
    scattering_from_t_matrix,
    spherical_basis,
    t_matrix,
)

__all__ = [
    "PARAMETERS",
    "POLARISATIONS",
    "SOLVERS",
    "AntennaArray",
    "Body",
    "Cells",
    "DopplerMap",
    "KrylovSolution",
    "Parameters",
    "PlanarArray",
    "Plane",
    "Refined",
    "Solution",
    "SphericalBasis",
    "Spinning",
    "Spread",
    "Table",
    "alike",
    "blade_flash_rate",
    "body_channel",
    "cache_folder",
    "channel_with_error",
    "contrast",
    "coupling_matrix",
    "dbsm",
    "degree_for",
    "dipole_fields",
    "doppler_shift",
    "doppler_spectrum",
    "dyadic_green",
    "environment_channel",
    "environment_sensing_channel",
    "evened",
    "extrapolated",
    "factor_bodies",
    "factor_body",
    "fisher_information",
    "fresnel",
    "interaction_matrix",
    "judge_contrast",
    "looking",
    "mean_position_error",
    "mirrored",
    "moved",
    "parameter_channel",
    "path_difference",
    "polarisations",
    "position_bound",
    "range_doppler",
    "regular_waves",
    "rotation_from_vector",
    "scattering_from_t_matrix",
    "scattering_matrix",
    "seen_from",
    "self_term",
    "sensing_channel",
    "sensing_channels",
    "slow_time_channels",
    "solve_dense",
    "solve_krylov",
    "spectrogram",
    "spherical_basis",
    "stack_tables",
    "t_matrix",
    "table_channel",
    "tabulate",
    "tabulate_bodies",
    "tilt_bound",
    "unknown_gain_position_bound",
    "wavenumber",
    "without_gain",
]
