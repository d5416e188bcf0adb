"""Batches for training and evaluation: rows by memory map, observed as stored or observed anew.

Observing anew (``train.reobserve``) draws a new prediction, SNR, pilots and noise for the stored true channels in
every step, so that a network never sees the same echo twice; for the ``roi`` encoder the echo is formed in the
region's subspace, where it costs little.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.config import Config, read
from august_jax.data.generate import Sample, draw_level, draw_prediction, split_of, unpack
from august_jax.data.shards import DataError, read_manifest
from august_jax.scene.cloud import to_cloud
from august_jax.signal.estimation import observe, observe_roi

SPLITS = ("train", "validation", "test")
Batch = dict[str, jax.Array]
_OBSERVED = 1 << 20
"""Number of the stream that observes anew; small ones of the same seed are the networks' and the training step's."""


class Dataset:
    """Samples of a data folder, memory-mapped.

    Attributes:
        config: the configuration that made them.
        count: number of rows.
        flights: flight number of each row (count,).

    Raises:
        DataError: no manifest, fewer rows than wanted (a run that continues later would see others), or a shard that
            is damaged.
    """

    def __init__(self, folder: str | Path):
        folder = Path(folder)
        manifest = read_manifest(folder)
        self.config = read(folder / "config.yaml")
        self._shards: list[Sample] = []
        for name, (low, high) in manifest["shards"].items():
            try:
                meta = json.loads((folder / name / "meta.json").read_text())
                fields = {field: np.load(folder / name / f"{field}.npy", mmap_mode="r") for field in meta["arrays"]}
                short = [field for field, value in fields.items() if len(value) != high - low]
            except (OSError, ValueError, EOFError, TypeError):
                short = ["meta.json or an array"]
            if short:
                raise DataError(f"{folder / name}: {short[0]} is damaged; run the same `august simulate` once more "
                                "with --verify, which makes it again")
            self._shards.append(fields)
        if manifest["rows"] < manifest["wanted"]:
            raise DataError(f"{folder}: holds {manifest['rows']} of {manifest['wanted']} samples; run the `august "
                            "simulate` that made them once more: it makes what is missing")
        self._starts = np.cumsum([0, *(len(fields["flight"]) for fields in self._shards)])
        self.count = int(self._starts[-1])
        self.flights = np.concatenate([fields["flight"] for fields in self._shards])

    def rows(self, split: str) -> np.ndarray:
        """Places of the rows of ``train``, ``validation`` or ``test``."""
        return np.flatnonzero(split_of(self.flights, self.config) == SPLITS.index(split))

    def read(self, places: np.ndarray, fields: tuple[str, ...] | None = None) -> Sample:
        """The samples at ``places`` (n,), in that order."""
        shard = np.searchsorted(self._starts, places, side="right") - 1
        result: Sample = {}
        for number in np.unique(shard):
            mine = np.flatnonzero(shard == number)
            stored = self._shards[number]
            for name in fields or stored:
                store = result.setdefault(name, np.empty((len(places), *stored[name].shape[1:]), stored[name].dtype))
                store[mine] = stored[name][places[mine] - self._starts[number]]
        return result


class TrainingBatches:
    """Step number -> batch for the model; a function of the step, the seed and the data alone."""

    def __init__(self, dataset: Dataset, config: Config):
        self._dataset, self._config = dataset, config
        self._places = dataset.rows("train")
        if len(self._places) < config.train.batch:
            raise DataError(
                f"train.batch: {config.train.batch} is more than the {len(self._places)} training rows; "
                "simulate more samples or take a smaller batch"
            )
        self._key = jax.random.fold_in(jax.random.key(config.train.seed), _OBSERVED)

    def __call__(self, step: int) -> Batch:
        batch = self._config.train.batch
        epoch, place = divmod(step, len(self._places) // batch)
        order = np.random.default_rng((self._config.train.seed, epoch)).permutation(len(self._places))
        chosen = np.sort(self._places[order[place * batch : (place + 1) * batch]])
        if self._config.train.reobserve:
            stored = self._dataset.read(chosen, ("position", "permittivity", "conductivity", "points", "channel"))
            return observed_anew(jax.random.fold_in(self._key, step), stored, self._config)
        return as_stored(self._dataset.read(chosen), self._config)


def as_stored(samples: Sample, config: Config) -> Batch:
    """The model's batch of samples as they were observed when they were made.

    Returns:
        ``channel`` (B, F, N_b, N_b) H_est, ``predicted`` (B, 3) [m], ``snr_db`` (B,) as the receiver estimates it,
        ``cloud`` (B, M, 5).
    """
    samples = {name: jnp.asarray(value) for name, value in samples.items()}
    return {
        "channel": unpack(samples["estimate"]), "predicted": samples["predicted"],
        "snr_db": samples["snr_estimate_db"],
        "cloud": _cloud(samples, samples["predicted"], config),
    }


@partial(jax.jit, static_argnames="config")
def observed_anew(key: jax.Array, samples: Sample, config: Config, snr_db: jax.Array | None = None) -> Batch:
    """The model's batch of stored true channels under new predictions, SNRs, pilots and noise.

    Args:
        key: of all that is drawn.
        samples: with ``channel``, ``position``, ``permittivity``, ``conductivity`` and ``points``.
        config: static. With the encoder ``roi`` the result's ``channel`` holds coefficients (B, F, K, K).
        snr_db: () or None; None draws the level as the configuration says.
    """
    look = observe_roi if config.model.encoder == "roi" else observe

    def one(key, packed, position):
        predicted_key, level_key, echo_key = jax.random.split(key, 3)
        predicted = draw_prediction(predicted_key, position, config)
        level = draw_level(level_key, config) if snr_db is None else {"snr_db": snr_db}
        seen = look(echo_key, unpack(packed), predicted, array=config.array, signal=config.signal, region=config.region,
                    **level)
        return {"channel": seen[0], "predicted": predicted, "snr_db": seen.snr_estimate_db}

    keys = jax.random.split(key, samples["position"].shape[0])
    batch = jax.vmap(one)(keys, samples["channel"], samples["position"])
    return batch | {"cloud": _cloud(samples, batch["predicted"], config)}


def _cloud(samples, predicted, config: Config) -> jax.Array:
    return to_cloud(samples["points"], samples["position"], predicted, samples["permittivity"],
                    samples["conductivity"], config.region)
