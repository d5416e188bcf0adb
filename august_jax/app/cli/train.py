"""``august train``: the networks, on a data set or on a stream of samples, or a predictor, on flights made for it;
continued where they were left."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from august_jax import config as configuration
from august_jax.app.cli.clock import told_s
from august_jax.app.cli.common import check_hosts, chosen_config, devices, devices_argument, folder, hosts_arguments
from august_jax.app.cli.dry import about, dry_run_argument, size, told_plan
from august_jax.app.cli.messages import command_line, note, say
from august_jax.app.cli.parser import Command, presets_help
from august_jax.app.cli.results import look, needed
from august_jax.config import Config, ConfigError

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from august_jax.data import Batch, Dataset, Sample, StreamedBatches, TrainingBatches
    from august_jax.training.loop import Draw


TARGETS = ("networks", "predictor")
_NOTE = (
    "Validation is by the moving average of the weights, on samples that are not trained on. A term tells how far "
    "learning has come, not how good a cloud is."
)
_PREDICTORS_NOTE = "Validation is by the moving average of the weights, on flights that are not trained on."


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = presets_help()
    parser.add_argument(
        "--target",
        choices=TARGETS,
        default=TARGETS[0],
        help="networks (default), or predictor: the LSTM that corrects the Kalman filter, which needs no data",
    )
    parser.add_argument(
        "--data",
        metavar="DIR",
        help="what august simulate wrote (default: august_data/PRESET; with train.source=stream none is needed)",
    )
    parser.add_argument(
        "--init",
        metavar="RUN",
        help="start from another run's weights, or from the shipped ones (--init shipped; default: new ones)",
    )

    devices_argument(parser, "each batch")
    hosts_arguments(parser)
    dry_run_argument(parser)


def _run(args: argparse.Namespace) -> dict[str, Any]:
    if args.target == "predictor":
        if args.dry_run:
            raise ConfigError(
                "--dry-run: a predictor trains in about a minute; leave it out, or take --target networks"
            )
        return _predictor(args)
    if args.dry_run:
        check_hosts(args)
        if args.host:
            raise ConfigError("--host: a dry run is of one host; leave it out, or leave out --dry-run")
        return _plan(args)
    mesh = devices(args)
    make: Callable[[Config], tuple[Callable[[int], Batch], Dataset | Sample]]
    if _streams(args):
        config, make, source = chosen_config(args), partial(_streamed, mesh), "a stream that never repeats"
    else:
        dataset, config = _stored(args)
        make, source = partial(_batches, dataset), f"{_data(args)}/"
    from august_jax.evaluation import validator
    from august_jax.hosts import is_first
    from august_jax.training.loop import train

    weights, out = _weights(args), _out(args, config)
    batches, held_out = make(config)
    following = [(command_line("evaluate", str(out), "--seed", "1"), "its accuracy over SNR, on fresh samples")]
    state = train(
        config,
        batches,
        out,
        validate=validator(held_out, config),
        draw=_drawn(args, config, f"Networks, scheme {config.model.scheme}", source, following, _NOTE),
        weights=weights,
        mesh=mesh,
        progress=note,
    )
    if not is_first():
        return _elsewhere(args, int(state.step))
    last = _told(args, out, int(state.step))
    say(args, f"written to {out}/: weights.npz, config.yaml, report.html, metrics.jsonl, curves.png, checkpoints")
    look(args, out, following)
    return {"out": str(out), "metrics": last}


def _streams(args: argparse.Namespace) -> bool:
    """Whether samples are made as training goes."""
    asked = any(text.startswith("train.source=") for text in args.overrides)
    if not asked or chosen_config(args).train.source != "stream":
        return False
    if args.data:
        raise ConfigError(
            f"--data: {args.data}, but train.source=stream makes its samples as it trains\n"
            "leave --data out, or set train.source=stored"
        )
    return True


def _weights(args: argparse.Namespace) -> Path | None:
    """The weights that networks start from, which must be there."""
    from august_jax import pipeline

    if not args.init:
        return None
    try:
        return pipeline.run_files(None if args.init == "shipped" else args.init)[1]
    except ValueError as error:
        raise ConfigError(str(error).replace("run: ", "--init: ", 1)) from None


def _out(args: argparse.Namespace, config: Config) -> Path:
    """Where networks are written to."""
    return _apart(folder(args, f"august_runs/{config.preset}", configured=True), "predictor.npz", "a predictor")


def _plan(args: argparse.Namespace) -> dict[str, Any]:
    """On the configuration of the data where they are there, else of the preset: what data are needed is said."""
    from august_jax.app.plan import training

    data, config = _data(args), chosen_config(args)
    _weights(args)
    if _streams(args):
        needs = "none: made as training goes"
    elif (data / "manifest.json").exists():
        _, config = _stored(args)
        needs = f"{data}/, which is there"
    else:
        make = command_line("simulate", "--preset", config.preset, "--out", str(data))
        needs = f"{data}/, which is not there yet: {make}"
    out = _out(args, config)
    note("compiling one step and timing a few, on a batch that is made up")
    plan = training(config, out, args.devices)
    each = f" on each of {plan['devices']} devices" if plan["devices"] > 1 else ""
    lines = [
        ("data", needs),
        ("steps", f"{plan['steps']} of {plan['batch']} samples, {plan['parameters'] / 1e6:.2f} million parameters"),
        ("time", f"{about(plan['seconds'])} for the steps as timed here, {told_s(plan['compile_seconds'])} to compile"),
        ("disk", f"{size(plan['disk_bytes'])} in {out}/; {size(plan['free_bytes'])} are free"),
        ("memory", f"{size(plan['memory_bytes'])} for a step{each}; {size(plan['available_bytes'])} are free"),
    ]
    return told_plan(args, plan, lines)


def _predictor(args: argparse.Namespace) -> dict[str, Any]:
    config, mesh = chosen_config(args), devices(args)
    if args.data:
        raise ConfigError(
            f"--data: {args.data}, but a predictor learns from flights that are made for it\nleave --data out"
        )
    from august_jax.hosts import is_first
    from august_jax.tracking.predictors.lstm import SHIPPED, WEIGHTS
    from august_jax.training.predictor import train_predictor

    weights = None
    if args.init:
        weights = (SHIPPED if args.init == "shipped" else Path(args.init)) / WEIGHTS
        if not weights.is_file():
            raise ConfigError(
                f"--init: {weights} is not there; give what august train --target predictor wrote, or shipped"
            )
    default = f"august_runs/predictor_{config.preset}"
    out = _apart(folder(args, default, configured=True), "weights.npz", "networks")
    study = ["python", "experiments/prediction.py", "compute", "--run", str(out), "--results", f"{out}/prediction.npz"]
    following = [(shlex.join(study), "how far its predictions err in closed loop, beside the Kalman filter's")]
    draw = _drawn(args, config, "Predictor", "flights that are flown for it", following, _PREDICTORS_NOTE)
    state = train_predictor(config, out, draw=draw, weights=weights, mesh=mesh, progress=note)
    if not is_first():
        return _elsewhere(args, int(state.step))
    last = _told(args, out, int(state.step))
    say(args, f"written to {out}/: {WEIGHTS}, config.yaml, report.html, metrics.jsonl, curves.png, checkpoints")
    look(args, out, following)
    say(args, f"or in Python: sense(..., predictor=KalmanLSTM.for_flight(config.flight, {str(out)!r}))")
    return {"out": str(out), "metrics": last}


def _drawn(
    args: argparse.Namespace, config: Config, what: str, source: str, following: list[tuple[str, str]], remark: str
) -> Draw:
    """Draws a run's picture and its report; see :class:`august_jax.app.page.About` for ``following`` and ``remark``."""
    from august_jax.app.learning import write_learning
    from august_jax.app.page import About
    from august_jax.app.plotting import read_metrics, training_curves

    settings = config.train
    told = About(
        title=f"{what}, preset {config.preset}",
        lead=f"Trained on {source}, {settings.steps} steps of {settings.batch}. This page is written again at "
        f"every save, after each {settings.save_every} steps: load it anew.",
        note=remark,
        setup=[
            ("trained on", source),
            ("learning rate", " to ".join(f"{rate:g}" for rate in settings.learning_rate)),
            ("seed", str(settings.seed)),
            *([("started from", args.init)] if args.init else []),
        ],
        following=following,
        repeat=[(command_line(*args.words), f"goes on where the run stands; anew in another folder; {needed()}")],
        configuration=configuration.to_yaml(config),
    )

    def draw(metrics: Path, picture: Path) -> None:
        training_curves(metrics, picture)
        write_learning(picture.with_name("report.html"), read_metrics(metrics), settings.steps, told)

    return draw


def _apart(out: Path, mark: str, held: str) -> Path:
    """``out``, refused where it holds what was trained for something else."""
    if (out / mark).exists():
        raise ConfigError(f"--out: {out} holds {held} ({mark}); choose another folder")
    return out


def _elsewhere(args: argparse.Namespace, step: int) -> dict[str, Any]:
    say(args, f"trained to step {step}; the first host has written it")
    return {"host": args.host[0], "step": step}


def _told(args: argparse.Namespace, out: Path, step: int) -> dict[str, Any]:
    """The last numbers that were logged, after a line about them."""
    metrics = out / "metrics.jsonl"
    logged = metrics.read_text().splitlines() if metrics.exists() else []  # gone where nothing was left to train
    last: dict[str, Any] = json.loads(logged[-1]) if logged else {}
    shown = (f"{name} {value:.4g}" for name, value in last.items() if name not in ("step", "seconds_left"))
    say(args, f"trained to step {step}: " + "  ".join(shown))
    return last


def _data(args: argparse.Namespace) -> Path:
    """Where the data set is."""
    return Path(args.data or f"august_data/{args.preset or 'laptop'}")


def _stored(args: argparse.Namespace) -> tuple[Dataset, Config]:
    """The data set, and the configuration to train with on it."""
    data = _data(args)
    if not (data / "manifest.json").exists():
        preset = chosen_config(args).preset  # other mistakes are told first
        raise ConfigError(
            f"--data: {data} holds no data (no manifest.json)\n"
            f"make them: {command_line('simulate', '--preset', preset, '--out', str(data))}\n"
            "or train without: train.source=stream"
        )
    from august_jax.data import Dataset

    dataset = Dataset(data)
    return dataset, configuration.training_config(dataset.config, args.overrides, name=args.preset, data=data)


def _batches(dataset: Dataset, config: Config) -> tuple[TrainingBatches, Dataset]:
    from august_jax.data import TrainingBatches, prepare_targets

    targets = []
    if config.model.scheme == "refchannel":  # what it learns from is made by table
        targets = prepare_targets(
            dataclasses.replace(config, data=dataclasses.replace(config.data, solver="table")), note
        )
    batches = TrainingBatches(dataset, config, targets)
    note(f"{len(dataset.rows('train'))} of {dataset.count} samples are for training, {config.train.steps} steps")
    return batches, dataset


def _streamed(mesh: Mesh, config: Config) -> tuple[StreamedBatches, Sample]:
    from august_jax.data import open_stream

    made = open_stream(config, note, mesh=mesh)
    note(f"samples are made as training goes, {config.train.batch} new ones in each of {config.train.steps} steps")
    return made


COMMAND = Command(
    "train the networks on a data set or a stream, or a predictor",
    _arguments,
    _run,
    out="august_runs/PRESET",
    first="half a minute to compile on two quiet CPU cores, with train.source=stream some minutes for tables first",
)
