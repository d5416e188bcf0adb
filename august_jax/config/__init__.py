"""Configurations: every number of a run, checked at the door; presets; YAML and dotted overrides.

Only the standard library and, where text is read or written, PyYAML are imported, so that the command line stays quick.
"""

from august_jax.config.describe import Field, describe
from august_jax.config.fields import Bounds, ConfigError
from august_jax.config.presets import PRESETS, Preset, preset, training_config
from august_jax.config.schema import (
    SNR_LIMIT_DB, ArrayConfig, Config, DataConfig, Draw, Encoder, Estimator, EvaluateConfig, Family, FlightConfig,
    Frame, ModelConfig, Pilots, PresetName, Range, RegionConfig, Sampler, Scheme, SignalConfig, Solver, Style,
    TargetConfig, TimeEmbedding, TrainConfig, bounds,
)
from august_jax.config.text import (
    data_digest, digest, from_dict, from_yaml, override, read, to_dict, to_yaml,
)
from august_jax.config.ties import check_data, check_weights, differences, leaves

__all__ = [
    "PRESETS", "SNR_LIMIT_DB", "ArrayConfig", "Bounds", "Config", "ConfigError", "DataConfig", "Draw", "Encoder",
    "Estimator", "EvaluateConfig", "Family", "Field", "FlightConfig", "Frame", "ModelConfig", "Pilots", "Preset",
    "PresetName", "Range", "RegionConfig", "Sampler", "Scheme", "SignalConfig", "Solver", "Style", "TargetConfig",
    "TimeEmbedding", "TrainConfig", "bounds", "check_data", "check_weights", "data_digest", "describe", "differences",
    "digest", "from_dict", "from_yaml", "leaves", "override", "preset", "read", "to_dict", "to_yaml",
    "training_config",
]
