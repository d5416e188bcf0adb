"""What survives the process: checkpoints of a run (orbax), and weights alone as a plain .npz file.

Both store arrays under dotted names, such as ``denoiser.layers.0.gate.kernel``, so that what is read is
compared with what is wanted leaf by leaf. A run killed while it saves leaves a temporary folder that the next start
removes; finished checkpoints are never touched by a save in progress. Beside the arrays a checkpoint holds their
SHA-256: what the disk has changed since is not gone on with.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from august_jax.config import Config
from august_jax.files import flush_tree, replacing
from august_jax.models import State, create
from august_jax.models.weights import FORMAT, compare, flatten, read_weights
from august_jax.progress import Progress
from august_jax.training.step import ParameterLayout, TrainState

_KEEP = 2
_TALKERS = ("asyncio", "absl")
"""Loggers to which orbax's threads write pages about what is told in a line here."""
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EFBIG)
"""What a disk may answer."""
_SUM = "sha256"
"""Of all other arrays, as an array beside them."""


class Checkpoints:
    """The checkpoints in one folder, one a saved step; the last two are kept. A context manager.

    Of several hosts each opens the same folder, saves and restores at the same time; the first alone writes.
    """

    def __init__(self, folder: str | Path):
        from orbax.checkpoint import v1 as ocp  # here, because it takes seconds to import

        self._levels = {name: logging.getLogger(name).level for name in _TALKERS}
        for name in _TALKERS:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        policies = ocp.training
        # The default policy drops a save while another is running; here the caller decides and every save is made.
        self._checkpointer = ocp.training.Checkpointer(
            Path(folder).resolve(),
            save_decision_policy=policies.save_decision_policies.FixedIntervalPolicy(1),
            preservation_policy=policies.preservation_policies.LatestN(_KEEP),
            cleanup_tmp_directories=True,
        )

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._checkpointer.close()
        except Exception:
            if kind is None:
                raise
        if kind is None:  # else there may be more to come
            for name, level in self._levels.items():
                logging.getLogger(name).setLevel(level)

    @property
    def latest(self) -> int | None:
        """The last saved step; None where there is none."""
        found = self._checkpointer.latest
        return None if found is None else found.step

    def save(self, state: TrainState) -> None:
        """Write ``state`` under its own step number, and wait until it is on disk.

        Raises:
            OSError: the disk is full or cannot be written; names the folder.
        """
        arrays: dict[str, Any] = flatten(_plain(state))
        if jax.process_count() > 1:  # of NumPy's arrays orbax leaves the writing to the first
            arrays = {name: np.asarray(leaf) for name, leaf in arrays.items()}
        try:
            self._checkpointer.save(int(state.step), arrays | {_SUM: _sum_of(arrays)}, force=True, overwrite=True)
            if jax.process_index() == 0:
                flush_tree(Path(str(self._checkpointer.directory)) / str(int(state.step)))  # which orbax leaves undone
        except Exception as error:  # of many kinds, some of which hold another's words alone
            text = f"{error!r}"
            for number in _DISK:
                if f"[Errno {number}]" in text or os.strerror(number) in text:
                    raise OSError(number, os.strerror(number), str(self._checkpointer.directory)) from error
            raise

    def check_room(self, state: TrainState, progress: Progress) -> None:
        """Say what the checkpoints of such a state will take, and refuse before the work where the disk has no room.

        Raises:
            ValueError: too little is free.
        """
        folder = Path(str(self._checkpointer.directory))
        kept = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        wanted, free = bytes_for(state), shutil.disk_usage(folder).free
        progress(f"checkpoints take up to {wanted / 1e6:.0f} MB in {folder}; {free / 1e9:.1f} GB are free there")
        if wanted > free + kept:
            raise ValueError(
                f"folder: checkpoints take up to {wanted / 1e6:.0f} MB, but {folder} has {free / 1e6:.0f} MB free; "
                "make room, or choose another folder"
            )

    def restore(self, like: TrainState) -> TrainState:
        """The last saved state, with the structure, types and placement of ``like``.

        Raises:
            ValueError: nothing is saved here, it is damaged, or it was saved from other networks.
        """
        if self.latest is None:
            raise ValueError(f"folder: no checkpoint in {self._checkpointer.directory}; train from the start")
        plain = _plain(like)
        wanted: dict[str, Any] = flatten(plain)
        with self._readable():
            metadata = self._checkpointer.metadata(self.latest).metadata
            stored = metadata["state"] if "state" in metadata else metadata
            shapes = {name: leaf.shape for name, leaf in stored.items()}
        summed = shapes.pop(_SUM, None) is not None  # those of older versions are not
        compare(shapes, wanted, self._checkpointer.directory)
        abstract: dict[str, Any] = {
            name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)
            if jax.process_count() == 1
            else np.empty(leaf.shape, leaf.dtype)
            for name, leaf in wanted.items()
        }
        if summed:
            abstract[_SUM] = _sum_of({})
        with self._readable():
            arrays = self._checkpointer.load(self.latest, abstract)
            if summed and not np.array_equal(arrays.pop(_SUM), _sum_of({name: arrays[name] for name in wanted})):
                raise ValueError("its arrays are not those that were saved")
        state = jax.tree.unflatten(jax.tree.structure(plain), [arrays[name] for name in wanted])
        return state._replace(key=jax.random.wrap_key_data(state.key, impl=jax.random.key_impl(like.key)))

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Whatever goes wrong within is told as a damaged checkpoint; orbax raises many kinds of errors for one."""
        try:
            yield
        except Exception as error:
            folder = Path(str(self._checkpointer.directory)) / str(self.latest)
            raise ValueError(
                f"{folder}: the checkpoint cannot be read ({type(error).__name__}); remove that folder, "
                "and the run continues from the one before, or from the start"
            ) from error


def save_weights(path: str | Path, state: State, *, half: bool = False) -> None:
    """Write the networks' parameters as .npz, one array a dotted name, and the ``format``; whole or not at all.

    Args:
        state: parameters as ``models.create`` returns them, or their moving average.
        half: store float16, at half the size; parameters beyond its range raise.

    Raises:
        ValueError: a parameter is not finite, or not in float16.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in flatten(state).items()}
    if half:
        with np.errstate(over="ignore"):
            arrays = {name: leaf.astype(np.float16) for name, leaf in arrays.items()}
    for name, leaf in arrays.items():
        if not np.isfinite(leaf).all():
            raise ValueError(f"state: {name} holds values that are not finite{' in float16' * half}; nothing written")
    # into an open file: to a path without the suffix NumPy would add it, and write beside what takes the place
    with replacing(path) as aside, aside.open("wb") as file:
        np.savez(file, **arrays, format=np.int32(FORMAT))  # type: ignore[arg-type]


def load_weights(path: str | Path, config: Config) -> tuple[nnx.GraphDef, State]:
    """Networks of ``config`` with the parameters that :func:`save_weights` wrote: (graphdef, state), float32.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, holds numbers that are not finite, or belongs to another configuration (the
            first array is named).
    """
    arrays = read_weights(path)
    graphdef, state = create(config, 0)
    wanted = flatten(state)
    compare({name: leaf.shape for name, leaf in arrays.items()}, wanted, path)
    leaves = [jnp.asarray(arrays[name], leaf.dtype) for name, leaf in wanted.items()]
    return graphdef, jax.tree.unflatten(jax.tree.structure(state), leaves)


def warm_start(layout: ParameterLayout, state: TrainState, path: str | Path) -> tuple[TrainState, list[str]]:
    """``state`` with the parameters of another run's weights, wherever name and shape agree.

    Returns:
        The state, and the names of the parameters that kept their own start.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, holds numbers that are not finite, or nothing in it fits.
    """
    stored, own = read_weights(path), flatten(layout.arrays(np.asarray(state.params)))
    kept = [name for name, leaf in own.items() if name not in stored or stored[name].shape != leaf.shape]
    if len(kept) == len(own):
        raise ValueError(
            f"path: no parameter in {path} fits these networks; give a run of a like model.* configuration"
        )
    params = jnp.asarray(
        np.concatenate([np.ravel(leaf if name in kept else stored[name]) for name, leaf in own.items()])
    )
    return state._replace(params=params, ema=jnp.copy(params)), kept


def bytes_for(state: TrainState) -> int:
    """What the checkpoints of a run take on the disk at most: those that are kept, and one more while it is written."""
    size = sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in flatten(_plain(state)).values())
    return (_KEEP + 1) * size


def _sum_of(arrays: Mapping[str, Any]) -> np.ndarray:
    """The SHA-256 (32,) of names, types, shapes and content."""
    digest = hashlib.sha256()
    for name, leaf in sorted(arrays.items()):
        digest.update(f"{name} {leaf.dtype} {leaf.shape} ".encode())
        digest.update(np.ascontiguousarray(leaf).data)
    return np.frombuffer(digest.digest(), np.uint8)


def _plain(state: TrainState) -> TrainState:
    return state._replace(key=jax.random.key_data(state.key))
