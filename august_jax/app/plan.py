"""What a command would do, and what that takes: ``--dry-run`` of simulate, train and evaluate.

Sizes are counted. Memory of training is asked of the compiled program, and its time of steps that are made here, on a
batch that is made up. Times of simulation and of a search go by rates that were measured on two quiet CPU cores
(docs/results.md) and by how much work a sample is, and may be off by two on another machine.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from august_jax.config import Config
from august_jax.memory import memory

Plan = Mapping[str, Any]
"""Names of what was found -> plain values; None where nothing is known."""

_CHANNELS_PER_S = 104.0
"""Samples a second of the preset laptop: one tone, 64 antennas, by factored bodies."""
_BY_TABLE = 10.0
"""How many times as many by table."""
_SEARCH_S = 5.0
"""A slot's search among five craft, one tone."""
_FACTORING_S = 40.0
"""A body and tone of a thousand cells, where it is not kept yet."""
_BASE_BYTES = 900 * 1024**2
"""The program, its libraries and the bodies."""
_SEARCH_BYTES = 700 * 1024**2
"""What a search compiles and keeps besides its tables: `august evaluate` of laptop's five craft took 2.74 GiB at most,
the tables made on the way."""
_TABLE_BYTES = 240 * 1024**2
"""A craft's table of one tone, and what making it takes."""
_TIMED = 3


def simulation(config: Config, out: Path, part: tuple[int, int] = (1, 1)) -> Plan:
    """Of ``august simulate``.

    Returns:
        ``rows`` of the whole set, ``rows_here`` that are there already, ``rows_left`` of this part, ``shards_left``,
        ``disk_bytes``, ``free_bytes``, ``memory_bytes``, ``free_memory_bytes`` (None where the system does not tell),
        ``seconds`` (None for a solver without a known rate) and ``factoring_seconds`` at most.

    Raises:
        DataError: what ``august simulate`` would refuse, too.
    """
    from august_jax.data import bytes_of
    from august_jax.data.shards import is_of_part, missing_shards

    count, size = config.data.count, config.data.shard_rows
    everywhere = missing_shards(config, out)
    left = {number: span for number, span in everywhere.items() if is_of_part(number, part)}
    rows = sum(high - low for low, high in left.values())
    rate = _rate(config)
    return {
        "rows": count,
        "rows_here": count - sum(high - low for low, high in everywhere.values()),
        "rows_left": rows,
        "shards_left": len(left),
        "disk_bytes": bytes_of(config, rows),
        "free_bytes": shutil.disk_usage(_existing(out)).free,
        # a shard is gathered in pieces and put together before it is written
        "memory_bytes": _BASE_BYTES
        + 2 * bytes_of(config, min(size, max(rows, 1)))
        + (_tables_bytes(config) if config.data.solver == "table" else 0),
        "free_memory_bytes": _free_memory(),
        "seconds": None if rate is None else rows / rate,
        "factoring_seconds": _factoring_s(config),
    }


def training(config: Config, out: Path, devices: int | None = None) -> Plan:
    """Of ``august train``: one step is compiled, and a few are made on a batch that is made up.

    Args:
        config: of the training.
        out: where it would write.
        devices: how many share each batch; None takes all that JAX sees.

    Returns:
        ``steps``, ``parameters``, ``compile_seconds``, ``seconds`` (None where the batch does not fit the memory),
        ``memory_bytes`` of the compiled step and ``available_bytes`` (None where nobody tells), each of one of the
        ``devices``, ``batch``, ``batch_fits`` (one that fits, where this one does not; 0 where none does),
        ``disk_bytes`` of weights and checkpoints, and ``free_bytes``.

    Raises:
        ValueError: more devices than there are, or a batch that they cannot share equally.
    """
    import jax

    from august_jax.mesh import SPLIT, WHOLE, check_divides, data_mesh, placed
    from august_jax.training import fit
    from august_jax.training.checkpoint import bytes_for
    from august_jax.training.step import initial_state

    settings, mesh = config.train, data_mesh(devices)
    check_divides(settings.batch, mesh)
    layout, state = initial_state(config)
    state, batch = placed(state, mesh, WHOLE), placed(_made_up_batch(config), mesh, SPLIT)
    began = time.perf_counter()
    program = fit.compiled(layout.loss, settings, state, batch, mesh)
    compile_s = time.perf_counter() - began
    needed, available = fit.bytes_needed(program), fit.bytes_available(state, mesh)
    seconds, most = None, None
    if fit.fits(needed, available):
        state, numbers = program(state, batch)
        jax.block_until_ready(numbers)
        began = time.perf_counter()
        for _ in range(_TIMED):
            state, numbers = program(state, batch)
        jax.block_until_ready(numbers)
        seconds = settings.steps * (time.perf_counter() - began) / _TIMED
    elif needed is not None and available is not None:
        most = fit.largest_batch(layout.loss, settings, state, batch, mesh, needed, available) or 0
    parameters = int(state.params.size)
    return {
        "steps": settings.steps,
        "batch": settings.batch,
        "devices": mesh.size,
        "parameters": parameters,
        "compile_seconds": compile_s,
        "seconds": seconds,
        "memory_bytes": needed,
        "available_bytes": available,
        "batch_fits": most,
        "disk_bytes": 4 * parameters + bytes_for(state),  # weights and checkpoints
        "free_bytes": shutil.disk_usage(_existing(out)).free,
    }


def evaluation(config: Config, networks: int, schemes: list[str] | None) -> Plan:
    """Of ``august evaluate``.

    Args:
        config: of the samples.
        networks: how many are compared.
        schemes: that are asked; None asks all.

    Returns:
        ``samples``, ``snr_db``, ``asked`` (schemes), ``searched`` slots in all, ``seconds`` at least (None for a solver
        without a known rate), ``search_seconds``, ``factoring_seconds`` at most, ``memory_bytes`` and
        ``free_memory_bytes`` (None where the system does not tell).

    Raises:
        ValueError: an unknown scheme.
        ConfigError: nobody is left to ask.
    """
    from august_jax.data import bytes_of
    from august_jax.evaluation.evaluate import asked_of
    from august_jax.schemes import SCHEMES

    asked = asked_of(config, schemes)
    evaluate, levels = config.evaluate, len(config.evaluate.snr_db)
    slow = [name for name in asked if SCHEMES[name].slow]
    searched = len(slow) * levels * min(evaluate.searched, evaluate.count)
    rate = _rate(config)
    tones = len(config.array.frequencies_hz)
    return {
        "samples": evaluate.count,
        "snr_db": list(evaluate.snr_db),
        "asked": asked,
        "networks": networks,
        "searched": searched,
        "seconds": None if rate is None else evaluate.count / rate,
        "search_seconds": searched * _SEARCH_S * len(config.target.airframes) / 5.0 * tones,
        "factoring_seconds": _factoring_s(config),
        "memory_bytes": _BASE_BYTES
        + 4 * bytes_of(config, evaluate.count)
        + (_SEARCH_BYTES + _tables_bytes(config) if searched else 0),
        "free_memory_bytes": _free_memory(),
    }


def _tables_bytes(config: Config) -> int:
    return _TABLE_BYTES * len(config.target.airframes) * len(config.array.frequencies_hz)


def _free_memory() -> int | None:
    found = memory()
    return None if found is None else found.free


def _rate(config: Config) -> float | None:
    """Samples a second."""
    work = len(config.array.frequencies_hz) * config.array.count / 64.0
    if config.data.solver not in ("mom", "table"):
        return None
    return _CHANNELS_PER_S / work * (_BY_TABLE if config.data.solver == "table" else 1.0)


def _factoring_s(config: Config) -> float:
    each = _FACTORING_S * len(config.array.frequencies_hz) * (2.0 if config.data.solver == "table" else 1.0)
    return each * len(config.target.airframes)


def _made_up_batch(config: Config) -> Any:
    """A batch of the right shapes whose echoes are noise: steps take as long as on any other."""
    import jax
    import jax.numpy as jnp

    from august_jax.data import Sample, observed_anew

    rng, rows, array = np.random.default_rng(0), config.train.batch, config.array
    low, high = np.array(config.flight.box_m).T
    triangle = array.count * (array.count + 1) // 2
    shape = (rows, len(array.frequencies_hz), triangle)
    none = np.zeros(rows, np.int32)
    samples = Sample(
        position=rng.uniform(low, high, (rows, 3)).astype(np.float32),
        rotation=np.broadcast_to(np.eye(3, dtype=np.float32), (rows, 3, 3)),
        permittivity=np.full(rows, np.mean(config.target.permittivity), np.float32),
        conductivity=np.full(rows, np.mean(config.target.conductivity_s_m), np.float32),
        airframe=none,
        flight=none,
        slot=none,
        points=(0.1 * rng.normal(size=(rows, config.target.points, 3))).astype(np.float32),
        true_channel=(1e-4 * (rng.normal(size=shape) + 1j * rng.normal(size=shape))).astype(np.complex64),
    )
    batch = observed_anew(jax.random.key(0), samples.each(jnp.asarray), config)
    if config.model.scheme == "refchannel":
        batch = batch._replace(reference_channel=batch.heard)
    return batch


def _existing(out: Path) -> Path:
    return next(path for path in (out, *out.absolute().parents) if path.is_dir())
