"""The run: batches in, a folder out that can be continued after any interruption to the same numbers.

The folder holds ``config.yaml``; ``metrics.jsonl``, one object a log point; ``curves.png`` if the caller says who
draws it; ``checkpoints/``; and ``weights.npz``, the moving average of the parameters as of the last save, which is
what evaluation loads. Where numbers were not finite it also holds the batch that they came of.
"""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh

from august_jax import config as configuration
from august_jax import hosts, streams
from august_jax.config import Config
from august_jax.files import DamagedFile, naming, occupying, read_npz, rename, write_text
from august_jax.mesh import SPLIT, WHOLE, brought_home, check_divides, data_mesh, placed, rows_kept_here
from august_jax.models import State
from august_jax.progress import Progress, silent
from august_jax.training.checkpoint import Checkpoints, save_weights, warm_start
from august_jax.training.fit import fitted_step
from august_jax.training.not_finite import not_finite, stopped
from august_jax.training.step import ParameterLayout, TrainState, initial_state

NextBatch = Callable[[int], Any]
"""Step (0 at first) -> batch, of what is trained; the same step gives the same batch."""

Begin = Callable[[Config], tuple[ParameterLayout, TrainState]]
"""Configuration -> what is trained, and its state before the first step."""

Validate = Callable[[nnx.GraphDef, State, int], Mapping[str, float | int]]
"""(graphdef, averaged parameters, steps done) -> finite numbers to log."""

Draw = Callable[[Path, Path], None]
"""(metrics.jsonl, picture to write); ``plotting.training_curves`` is one."""


@streams.pin
def train(
    config: Config,
    next_batch: NextBatch,
    out_dir: str | Path,
    *,
    validate: Validate | None = None,
    draw: Draw | None = None,
    weights: str | Path | None = None,
    begin: Begin = initial_state,
    weights_file: str = "weights.npz",
    mesh: Mesh | None = None,
    progress: Progress = silent,
) -> TrainState:
    """Train to ``config.train.steps`` and return the last state.

    The next batch is made in a thread while a step runs. Every ``save_every`` steps, and at the end, the state is
    saved, ``validate`` is called, whose numbers join the metrics, and ``draw`` draws these.

    It continues from the folder's last checkpoint, and writes weights that are gone or damaged again from it. Where
    there is none but a run's weights or metrics are, these and its configuration are set aside as
    ``weights.previous.npz`` and so on, or ``weights.previous-2.npz`` where that name is taken: nothing is ever written
    over.

    The devices of a mesh share each batch, and losses differ from those of one device by rounding alone. A checkpoint
    goes on on any number of devices. Of several hosts (:mod:`august_jax.hosts`) each calls this alike, and the first
    alone writes the folder, from which all read checkpoints.

    Args:
        config: everything; written to the folder.
        next_batch: must depend on the step alone, or a continued run sees other data.
        out_dir: made if missing.
        weights: another run's weights, from which a run that starts anew takes what fits.
        begin: what is trained; the configuration's networks if left out.
        weights_file: name of the file of weights in the folder.
        mesh: the devices; None takes all that JAX sees.
        progress: takes lines of progress.

    Raises:
        FileNotFoundError: no file ``weights``.
        ValueError: ``weights`` is damaged, holds numbers that are not finite or nothing that fits; the folder holds
            a run of another configuration, of more steps, or with a damaged checkpoint; the devices cannot share the
            batch equally, or have no memory for it, either answered with one that they can; or another host gave up.
        Occupied: another process trains in that folder.
        FloatingPointError: the loss, its gradient or what ``validate`` says is not finite. It names the step and the
            terms, whether the step's batch is to blame, and the file that keeps it, ``not-finite-step-N.npz``
            (:mod:`august_jax.training.not_finite`). The folder goes on from its last checkpoint as before.
    """
    settings, out, first = config.train, Path(out_dir), hosts.is_first()
    mesh = data_mesh() if mesh is None else mesh
    check_divides(settings.batch, mesh)
    hosts.agreed("config", configuration.to_yaml(config))
    progress = progress if first else silent
    metrics = out / "metrics.jsonl"
    layout, state = begin(config)
    with ExitStack() as held, ThreadPoolExecutor(1) as pool:

        def logged(state: TrainState, line: dict[str, float | int], saving: bool) -> None:
            """A log point on the disk; ``saving``, with the weights."""
            if not first:
                return
            if saving:
                averaged = layout.arrays(np.asarray(state.ema))
                save_weights(out / weights_file, averaged)
                if validate is not None:
                    line |= _validated(validate, layout.graphdef, averaged, int(line["step"]))
            with naming(metrics), metrics.open("a", encoding="utf-8") as file:
                file.write(json.dumps({name: float(f"{value:.6g}") for name, value in line.items()}) + "\n")
                file.flush()
                os.fsync(file.fileno())
            progress(_told(line, settings.steps))
            if saving and draw is not None:
                draw(metrics, out / "curves.png")

        state, checkpoints = hosts.together(
            partial(_opened, config, layout, state, out, weights, weights_file, held, progress)
        )
        state = placed(hosts.from_first(state), mesh, WHOLE)
        start = int(state.step)
        if mesh.size > 1:
            progress(f"{mesh.size} devices share each batch, {settings.batch // mesh.size} samples each")
        mark, began = time.perf_counter(), None
        if start < settings.steps:
            batch = hosts.together(lambda: placed(next_batch(start), mesh, SPLIT))
            step = hosts.together(lambda: fitted_step(layout.loss, settings, state, batch, mesh))
        if first:
            if start == 0:
                _set_aside(out, weights_file, progress)
            write_text(out / "config.yaml", configuration.to_summed_yaml(config))
            _forget_after(metrics, start)
        gathered: list[Mapping[str, Any]] = []
        for done in range(start + 1, settings.steps + 1):
            if done < settings.steps:
                waiting = pool.submit(next_batch, done)
            state, numbers = step(state, batch)
            gathered.append(numbers)
            if began is None:
                jax.block_until_ready(numbers)
                progress(f"first step compiled and run in {time.perf_counter() - mark:.0f} s")
                began = mark = time.perf_counter()
            saving = done % settings.save_every == 0 or done == settings.steps
            if saving or done % settings.log_every == 0:
                gathered = jax.device_get(gathered)
                for number, found in enumerate(gathered, done - len(gathered) + 1):
                    if wrong := not_finite(found):
                        made = pool.submit(next_batch, number - 1)
                        raise _stopped(number, wrong, made.result, out, checkpoints.latest)
                now = time.perf_counter()
                timed = len(gathered) - (done - len(gathered) == start)  # the first step compiled
                line = {
                    "step": done,
                    **_average(gathered),
                    "samples_per_s": timed * settings.batch / max(now - mark, 1e-9),
                    "seconds_left": (settings.steps - done) * (now - began) / max(done - start - 1, 1),
                }
                hosts.together(partial(logged, state, line, saving))
                if saving:  # last: what a run continues from has all that goes with it on disk
                    checkpoints.save(brought_home(state))
                gathered, mark = [], time.perf_counter()
            if done < settings.steps:
                batch = placed(waiting.result(), mesh, SPLIT)
    return brought_home(state)


def _opened(
    config: Config,
    layout: ParameterLayout,
    state: TrainState,
    out: Path,
    weights: str | Path | None,
    weights_file: str,
    held: ExitStack,
    progress: Progress,
) -> tuple[TrainState, Checkpoints]:
    """The state to go on from and the folder's checkpoints, with the folder ``held`` for this process."""
    steps, first, kept = config.train.steps, hosts.is_first(), list[str]()

    def taken() -> TrainState:
        if not first:
            return state
        begun = state
        if weights is not None:  # before anything is written: they may not fit
            begun, kept[:] = warm_start(layout, state, weights)
        held.enter_context(occupying(out))
        return begun

    def checked() -> None:
        if not first or checkpoints.latest is None:
            return
        _check_same_run(config, out / "config.yaml")
        if checkpoints.latest > steps:
            raise ValueError(
                f"train.steps: {steps} is less than the {checkpoints.latest} steps that "
                f"{out} has done; ask for as many, or choose another folder"
            )

    state = hosts.together(taken)
    checkpoints = held.enter_context(Checkpoints(out / "checkpoints"))
    hosts.together(checked)
    if checkpoints.latest is not None:
        state = checkpoints.restore(state)
        if first and not _readable(out / weights_file):  # made of the same state
            save_weights(out / weights_file, layout.arrays(np.asarray(state.ema)))
        progress(
            f"continuing from step {int(state.step)} of {steps}"
            + ("; other weights are for new runs, and this one goes on from its own" if weights else "")
        )
    elif weights is not None:
        progress(
            f"starting from {weights}"
            + (f", but for {len(kept)} arrays that it lacks, such as {kept[0]}" if kept else "")
        )
    if first:
        checkpoints.check_room(state, progress)
    return state, checkpoints


def _validated(validate: Validate, graphdef: nnx.GraphDef, averaged: State, done: int) -> Mapping[str, float | int]:
    numbers = validate(graphdef, averaged, done)
    if wrong := not_finite(numbers):
        raise FloatingPointError(
            f"training: after step {done} the validation gave values that are not finite in {', '.join(wrong)}; look "
            "for them in what it is validated on, or train in another folder with a lower train.learning_rate"
        )
    return numbers


def _stopped(
    step: int, terms: list[str], make: Callable[[], Any], out: Path, checkpoint: int | None
) -> FloatingPointError:
    if hosts.is_first():
        return stopped(step, terms, lambda: rows_kept_here(make()), out, checkpoint)
    return FloatingPointError(f"training: step {step} gave values that are not finite; the first host says of what")


def _average(gathered: list[Mapping[str, np.ndarray]]) -> dict[str, float]:
    return {name: float(np.mean([numbers[name] for numbers in gathered])) for name in gathered[0]}


def _told(line: Mapping[str, float | int], steps: int) -> str:
    known = ("step", "samples_per_s", "seconds_left")
    numbers = "  ".join(f"{name} {value:.4g}" for name, value in line.items() if name not in known)
    minutes, seconds = divmod(round(line["seconds_left"]), 60)
    return (
        f"step {line['step']}/{steps}  {numbers}  {line['samples_per_s']:.0f} samples/s  {minutes}:{seconds:02d} left"
    )


def _check_same_run(config: Config, path: Path) -> None:
    """Compare with the folder's configuration, apart from how long it runs and what it reports."""

    def core(config: Config) -> dict[str, Any]:
        train = dataclasses.replace(config.train, steps=1, log_every=1, save_every=1)
        tree = configuration.to_dict(dataclasses.replace(config, train=train, evaluate=configuration.EvaluateConfig()))
        return {
            f"{section}.{name}": value
            for section, fields in tree.items()
            if isinstance(fields, dict)
            for name, value in fields.items()
        }

    before, now = core(configuration.read(path)), core(config)
    for name, value in now.items():
        if before[name] != value:
            raise ValueError(
                f"{name}: the run in {path.parent} was started with {before[name]!r}, now it is "
                f"{value!r}; continue with the old value or choose another folder"
            )


def _readable(path: Path) -> bool:
    try:
        return bool(read_npz(path))
    except (FileNotFoundError, DamagedFile):
        return False


def _set_aside(out: Path, weights_file: str, progress: Progress) -> None:
    """Rename what a run without checkpoints left, to names that are free: it may be the only copy."""
    names = ["metrics.jsonl", weights_file]
    if (out / weights_file).exists():
        # weights mean nothing without it; first, so that who is stopped between the two goes on with the other
        names.insert(0, "config.yaml")
    found = [out / name for name in names if (out / name).exists()]
    for number in count(1):
        tag = "previous" if number == 1 else f"previous-{number}"
        aside = [path.with_name(f"{path.stem}.{tag}{path.suffix}") for path in found]
        if not any(path.exists() for path in aside):
            break
    for path, other in zip(found, aside):
        rename(path, other)
        progress(f"no checkpoint to continue from: {path.name} of the run before is now {other.name}")


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
