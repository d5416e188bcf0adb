"""The run: batches in, a folder out that can be continued after any interruption to the same numbers.

The folder holds ``config.yaml``; ``metrics.jsonl``, one object a log point; ``curves.png`` if the caller says who
draws it; ``checkpoints/``; and ``weights.npz``, the moving average of the parameters as of the last save, which is
what evaluation loads.
"""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

from august_jax import config as configuration
from august_jax.config import Config
from august_jax.files import write_text
from august_jax.training.checkpoint import Checkpoints, save_weights, warm_start
from august_jax.training.step import TrainState, compiled_step, initial_state

NextBatch = Callable[[int], Mapping[str, Any]]
"""Step (0 at first) -> batch; the same step gives the same batch."""

Validate = Callable[[nnx.GraphDef, nnx.State, int], Mapping[str, float]]
"""(graphdef, averaged parameters, steps done) -> numbers to log."""

Draw = Callable[[Path, Path], None]
"""(metrics.jsonl, picture to write); ``plotting.training_curves`` is one."""


def train(config: Config, next_batch: NextBatch, out_dir: str | os.PathLike, *, validate: Validate | None = None,
          draw: Draw | None = None, weights: str | os.PathLike | None = None,
          printer: Callable[[str], None] = print) -> TrainState:
    """Train to ``config.train.steps`` and return the last state.

    The next batch is made in a thread while a step runs. Every ``save_every`` steps, and at the end, the state is
    saved, ``validate`` is called, whose numbers join the metrics, and ``draw`` draws these.

    It continues from the folder's last checkpoint. Where there is none but a run's weights are, these and its metrics
    are set aside as ``weights.previous.npz`` and ``metrics.previous.jsonl``.

    Args:
        config: everything; written to the folder.
        next_batch: must depend on the step alone, or a continued run sees other data.
        out_dir: made if missing.
        weights: another run's weights, from which a run that starts anew takes what fits.
        printer: takes progress lines.

    Raises:
        ValueError: nothing in ``weights`` fits, or the folder holds a run of another configuration, of more steps, or
            with a damaged checkpoint.
        FloatingPointError: the loss is not finite; names the step and the terms.
    """
    train = config.train
    networks, state = initial_state(config)
    if weights is not None:  # before anything is written: it may not fit
        state, kept = warm_start(networks, state, weights)
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    with Checkpoints(out / "checkpoints") as checkpoints, ThreadPoolExecutor(1) as pool:
        start = 0
        if checkpoints.latest is not None:
            _check_same_run(config, out / "config.yaml")
            if checkpoints.latest > train.steps:
                raise ValueError(f"train.steps: {train.steps} is less than the {checkpoints.latest} steps that {out} "
                                 "has done; ask for as many, or choose another folder")
            state = checkpoints.restore(state)
            start = int(state.step)
            printer(f"continuing from step {start} of {train.steps}"
                    + ("; --init is for new runs, and this one goes on from its own weights" if weights else ""))
        elif weights is not None:
            printer(f"starting from {weights}" + (f", but for {len(kept)} arrays that it lacks, such as {kept[0]}"
                                                  if kept else ""))
        metrics = out / "metrics.jsonl"
        if start == 0:
            _set_aside(out / "weights.npz", printer)
            _set_aside(metrics, printer)
        write_text(out / "config.yaml", configuration.to_yaml(config))
        _forget_after(metrics, start)
        waiting = pool.submit(next_batch, start) if start < train.steps else None
        reports, mark, began = [], time.perf_counter(), None
        for done in range(start + 1, train.steps + 1):
            batch = waiting.result()
            if done < train.steps:
                waiting = pool.submit(next_batch, done)
            state, report = compiled_step(networks, train, state, batch)
            reports.append(report)
            if began is None:
                jax.block_until_ready(report)
                printer(f"first step compiled and run in {time.perf_counter() - mark:.0f} s")
                began = mark = time.perf_counter()
            saving = done % train.save_every == 0 or done == train.steps
            if not (saving or done % train.log_every == 0):
                continue
            line = {"step": done, **_average(jax.device_get(reports), done)}
            now = time.perf_counter()
            timed = len(reports) - (done - len(reports) == start)  # the first step compiled
            line["samples_per_s"] = timed * train.batch / max(now - mark, 1e-9)
            line["seconds_left"] = (train.steps - done) * (now - began) / max(done - start - 1, 1)
            if saving:
                averaged = networks.arrays(np.asarray(state.ema))
                save_weights(out / "weights.npz", averaged)
                if validate is not None:
                    line |= validate(networks.graphdef, averaged, done)
            with metrics.open("a", encoding="utf-8") as file:
                file.write(json.dumps({name: float(f"{value:.6g}") for name, value in line.items()}) + "\n")
            printer(_progress(line, train.steps))
            if saving:
                if draw is not None:
                    draw(metrics, out / "curves.png")
                checkpoints.save(state)  # last: what a run continues from has all that goes with it on disk
            reports, mark = [], time.perf_counter()
    return state


def _average(reports: list[Mapping[str, np.ndarray]], done: int) -> dict[str, float]:
    for index, report in enumerate(reports):
        wrong = [name for name, value in report.items() if not np.isfinite(value)]
        if wrong:
            raise FloatingPointError(
                f"training: step {done - len(reports) + index + 1} gave values that are not finite in "
                f"{', '.join(wrong)}; lower train.learning_rate, or look for such values in the data"
            )
    return {name: float(np.mean([report[name] for report in reports])) for name in reports[0]}


def _progress(line: Mapping[str, float], steps: int) -> str:
    known = ("step", "samples_per_s", "seconds_left")
    numbers = "  ".join(f"{name} {value:.4g}" for name, value in line.items() if name not in known)
    minutes, seconds = divmod(round(line["seconds_left"]), 60)
    return (f"step {line['step']}/{steps}  {numbers}  {line['samples_per_s']:.0f} samples/s  "
            f"{minutes}:{seconds:02d} left")


def _check_same_run(config: Config, path: Path) -> None:
    """Compare with the folder's configuration, apart from how long it runs and what it reports."""
    def core(config: Config) -> dict[str, Any]:
        train = dataclasses.replace(config.train, steps=1, log_every=1, save_every=1)
        tree = configuration.to_dict(dataclasses.replace(config, train=train, evaluate=configuration.EvaluateConfig()))
        return {f"{section}.{name}": value for section, fields in tree.items() if isinstance(fields, dict)
                for name, value in fields.items()}

    before, now = core(configuration.read(path)), core(config)
    for name, value in now.items():
        if before[name] != value:
            raise ValueError(f"{name}: the run in {path.parent} was started with {before[name]!r}, now it is "
                             f"{value!r}; continue with the old value or choose another folder")


def _set_aside(path: Path, printer: Callable[[str], None]) -> None:
    """Rename what a run without checkpoints left, so that a new one does not overwrite it."""
    if path.exists():
        aside = path.with_name(f"{path.stem}.previous{path.suffix}")
        path.replace(aside)
        printer(f"no checkpoint to continue from: {path.name} of the run before is now {aside.name}")


def _forget_after(metrics: Path, step: int) -> None:
    """Drop what a killed run logged beyond its last checkpoint, and lines that are no log points."""
    def kept(line: str) -> bool:
        try:
            return json.loads(line)["step"] <= step
        except (ValueError, KeyError, TypeError):
            return False

    if metrics.exists():
        lines = metrics.read_text(encoding="utf-8", errors="replace").splitlines()
        write_text(metrics, "".join(line + "\n" for line in lines if kept(line)))
