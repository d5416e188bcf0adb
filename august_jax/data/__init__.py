"""Samples, from a row's number to a batch."""

from august_jax.data.dataset import SPLITS, Dataset, TrainingBatches
from august_jax.data.fields import Batch, Observed, Sample, pack, unpack
from august_jax.data.generate import fresh_samples, generate, split_of
from august_jax.data.observe import as_observed, batch_of, observed_anew
from august_jax.data.reference import reference_channels
from august_jax.data.shards import DataError, bytes_of, content_sum, read_manifest, simulate
from august_jax.data.simulator import (
    Target,
    channels_along,
    check_table,
    contrast_of,
    lattice_of,
    lattices_of,
    nearest_distance,
    prepare_targets,
    simulated_channel,
    tables_of,
    tabulate_targets,
)
from august_jax.data.stream import StreamedBatches, open_stream

__all__ = [
    "SPLITS",
    "Batch",
    "DataError",
    "Dataset",
    "Observed",
    "Sample",
    "StreamedBatches",
    "Target",
    "TrainingBatches",
    "as_observed",
    "batch_of",
    "bytes_of",
    "channels_along",
    "check_table",
    "content_sum",
    "contrast_of",
    "fresh_samples",
    "generate",
    "lattice_of",
    "lattices_of",
    "nearest_distance",
    "observed_anew",
    "open_stream",
    "pack",
    "prepare_targets",
    "read_manifest",
    "reference_channels",
    "simulate",
    "simulated_channel",
    "split_of",
    "tables_of",
    "tabulate_targets",
    "unpack",
]
