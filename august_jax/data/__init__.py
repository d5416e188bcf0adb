"""Samples, from a key to a batch."""

from august_jax.data.batches import SPLITS, Dataset, TrainingBatches, as_stored, observed_anew
from august_jax.data.generate import (
    Target, generate, lattice_of, nearest_distance, pack, prepare_targets, split_of, unpack,
)
from august_jax.data.shards import DataError, read_manifest, simulate

__all__ = [
    "SPLITS", "DataError", "Dataset", "Target", "TrainingBatches", "as_stored", "generate", "lattice_of",
    "nearest_distance", "observed_anew", "pack", "prepare_targets", "read_manifest", "simulate", "split_of", "unpack",
]
