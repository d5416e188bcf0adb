"""Stored samples: rows by memory map, split by flight, and the batches that training takes of them."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Int

from august_jax import streams
from august_jax.arrays import rows_not_finite
from august_jax.config import Config, read
from august_jax.data.fields import Batch, Observed, Sample
from august_jax.data.generate import split_of
from august_jax.data.observe import as_observed, batch_of
from august_jax.data.reference import reference_channels
from august_jax.data.shards import ROW_SUMS, DataError, read_manifest, read_meta, row_sums, simulate_again
from august_jax.data.simulator import Target, tables_of
from august_jax.files import sha256_of

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
_MOST_FILES = 32_768


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
        if manifest.get("config", "") not in ("", _sum_of(folder / "config.yaml")):
            raise DataError(
                f"{folder / 'config.yaml'}: is not what the data were made with; run the `august simulate` that made "
                "them once more, which writes it again"
            )
        self.config = read(folder / "config.yaml")
        names, rows = list(manifest["shards"]), [high - low for low, high in manifest["shards"].values()]
        arrays = 1 + max((len((read_meta(folder / name) or {"arrays": ()})["arrays"]) for name in names[:1]), default=0)
        self._opened = lru_cache(_most_opened(arrays))(lambda number: _open(folder / names[number], rows[number]))
        # looks at every shard
        flights = [self._taken(number, "flight", np.arange(count)) for number, count in enumerate(rows)]
        if manifest["rows"] < manifest["wanted"]:
            raise DataError(
                f"folder: {folder} holds {manifest['rows']} of {manifest['wanted']} samples\n"
                f"make what is missing: {simulate_again(folder)}"
            )
        self._starts = np.cumsum([0, *rows])
        self.count = int(self._starts[-1])
        self.flights = np.concatenate(flights)

    def _taken(self, number: int, column: str, rows: Int[np.ndarray, " n"]) -> np.ndarray:
        """Rows of a column of a shard, compared with their check sums, and finite."""
        shard = self._opened(number)
        taken = shard.columns[column][rows]
        sums = shard.sums.get(column)
        if sums is not None and not np.array_equal(row_sums(taken), sums[rows]):
            raise _damaged(shard.path, f"{column}.npy")
        if len(wrong := rows_not_finite(taken)):
            raise DataError(
                f"{shard.path}: {column}.npy holds NaN or infinity in {len(wrong)} of {len(rows)} rows, the first is "
                f"row {self._starts[number] + rows[wrong[0]]} of the data, as they were written\n"
                f"remove that shard, and make it again: {simulate_again(shard.path.parent)}"
            )
        return taken

    def rows(self, split: Split) -> Int[np.ndarray, " n"]:
        """Places of the rows of ``train``, ``validation`` or ``test``."""
        return np.flatnonzero(split_of(self.flights, self.config) == SPLITS.index(split))

    def read(self, places: Int[np.ndarray, " n"], *, observed: bool = True) -> Sample:
        """The samples at ``places`` (n,), in that order, as NumPy arrays.

        Args:
            places: row numbers; negative ones count from the end.
            observed: with what the base station made of them, where it was kept.

        Raises:
            ValueError: places that are no row numbers, out of range, or none.
            DataError: a row is damaged, or holds numbers that are not finite.
        """
        places = np.asarray(places)
        if places.ndim != 1 or not (np.issubdtype(places.dtype, np.integer)):
            raise ValueError(
                f"places: got {places.dtype} of shape {places.shape}; give row numbers (n,), of a mask m "
                "np.flatnonzero(m)"
            )
        if not places.size:
            raise ValueError("places: got none; give the numbers of one row or more")
        if not -self.count <= places.min() <= places.max() < self.count:
            raise ValueError(
                f"places: {places.min()} to {places.max()} are out of range; the rows are 0 to {self.count - 1}"
            )
        places = places.astype(np.int64) % max(self.count, 1)
        shard = np.searchsorted(self._starts, places, side="right") - 1
        result: dict[str, np.ndarray] = {}
        names = [name for name in self._opened(0).columns if observed or name not in Observed._fields]
        for number in np.unique(shard).tolist():
            mine = np.flatnonzero(shard == number)
            for name in names:
                taken = self._taken(number, name, places[mine] - self._starts[number])
                result.setdefault(name, np.empty((len(places), *taken.shape[1:]), taken.dtype))[mine] = taken
        return Sample.of_columns(result)


class _Shard(NamedTuple):
    """A shard's arrays, memory-mapped: its columns, and the check sums of each one's rows."""

    path: Path
    columns: dict[str, np.ndarray]
    sums: dict[str, np.ndarray]


def _most_opened(arrays: int) -> int:
    """Shards of so many arrays that are open at once: each array is a file that stays open and a mapping, of which a
    process gets so many (often 1024, and 65,530)."""
    try:
        import resource

        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    except ImportError:  # not on Windows
        files = 512
    if files < 0:  # no limit
        files = _MOST_FILES
    return max(int(0.8 * min(files, _MOST_FILES)) // arrays, 1)


def _open(path: Path, rows: int) -> _Shard:
    meta = read_meta(path) or {"arrays": {}}
    columns = {
        column: _mapped(path, f"{column}.npy", (about.get("shape"), about.get("dtype")), rows)
        for column, about in meta["arrays"].items()
    }
    sums = {}
    if "row_sums" in meta:
        kept = _mapped(path, ROW_SUMS, ([rows, len(columns)], "uint32"), rows)
        sums = dict(zip(columns, kept.T, strict=True))
    return _Shard(path, columns, sums)


def _mapped(shard: Path, file: str, form: tuple[Any, Any], rows: int) -> np.ndarray:
    """An array of a shard, as its description says it is."""
    try:
        array = np.load(shard / file, mmap_mode="r", allow_pickle=False)
        found = [list(array.shape), str(array.dtype)]
        whole = len(array) == rows and array.flags.c_contiguous and found == list(form)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise
        whole = False
    except (ValueError, EOFError, TypeError, SyntaxError, TokenError):
        whole = False
    if not whole:
        raise _damaged(shard, file)
    return array


def _damaged(shard: Path, file: str) -> DataError:
    again = simulate_again(shard.parent, "--verify")
    return DataError(f"{shard}: {file} is damaged\nmake it again: {again}")


def _sum_of(path: Path) -> str:
    return sha256_of(path) if path.exists() else "none"


class TrainingBatches:
    """Step number -> batch for the networks; a function of the step, the seed and the data alone.

    Args:
        dataset: what is stored.
        config: of the training.
        targets: for the scheme ``refchannel``, whose reference channels are made by table for every batch: with tables,
            from :func:`~august_jax.data.simulator.prepare_targets` with ``data.solver=table``. Others need none.

    Raises:
        DataError: fewer training rows than a batch has.
        ValueError: the samples were stored without what was made of them, and the configuration wants that; or the
            scheme needs tables, and the targets have none that fit.
    """

    def __init__(self, dataset: Dataset, config: Config, targets: Sequence[Target] = ()):
        self._dataset, self._config = dataset, config
        self._tables = tables_of(config, targets) if config.model.scheme == "refchannel" else None
        self._places = dataset.rows("train")
        if len(self._places) < config.train.batch:
            raise DataError(
                f"train.batch: {config.train.batch} is more than the {len(self._places)} training rows; "
                "simulate more samples or take a smaller batch"
            )
        if not config.train.reobserve:
            as_observed(dataset.read(self._places[:1]), config)

    @streams.pin  # whoever calls, from whatever thread
    def __call__(self, step: int) -> Batch:
        train = self._config.train
        epoch, place = divmod(step, len(self._places) // train.batch)
        entropy = jax.random.key_data(streams.key(train.seed, "train.order", epoch))
        order = np.random.default_rng(np.asarray(entropy)).permutation(len(self._places))
        chosen = np.sort(self._places[order[place * train.batch : (place + 1) * train.batch]])
        samples = self._dataset.read(chosen, observed=not train.reobserve)
        batch = batch_of(streams.key(train.seed, "train.observation", step), samples, self._config)
        if self._tables is None:
            return batch
        material = np.stack([samples.permittivity, samples.conductivity], axis=-1)
        craft, config = samples.airframe, self._config
        reference = reference_channels(
            config, self._tables, craft, samples.rotation, samples.position, material, batch.predicted
        )
        return batch._replace(reference_channel=reference)
