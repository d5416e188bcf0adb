"""``august train``: the networks, on a data set or on a stream of samples, continued where they were left."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, folder
from august_jax.app.cli.messages import command_line, note, say
from august_jax.app.cli.parser import Command, presets_help
from august_jax.config import Config, ConfigError

if TYPE_CHECKING:
    from august_jax.data import Batch, Dataset, Sample, StreamedBatches, TrainingBatches


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = presets_help()
    parser.add_argument(
        "--data",
        metavar="DIR",
        help="what august simulate wrote (default: august_data/PRESET; with train.source=stream none is needed)",
    )
    parser.add_argument(
        "--init", metavar="RUN", help="start from another run's weights, or from the shipped ones (--init shipped)"
    )


def _run(args: argparse.Namespace) -> dict[str, Any]:
    make: Callable[[Config], tuple[Callable[[int], Batch], Dataset | Sample]]
    if (
        any(text.startswith("train.source=") for text in args.overrides)
        and chosen_config(args).train.source == "stream"
    ):
        config, make = chosen_config(args), _streamed
        if args.data:
            raise ConfigError(
                f"--data: {args.data}, but train.source=stream makes its samples as it trains\n"
                "leave --data out, or set train.source=stored"
            )
    else:
        dataset, config = _stored(args)
        make = partial(_batches, dataset)
    from august_jax import pipeline
    from august_jax.app.plotting import training_curves
    from august_jax.evaluation import validator
    from august_jax.training.loop import train

    weights = pipeline.run_files(None if args.init == "shipped" else args.init)[1] if args.init else None
    out = folder(args, f"august_runs/{config.preset}", configured=True)
    batches, held_out = make(config)
    state = train(
        config, batches, out, validate=validator(held_out, config), draw=training_curves, weights=weights, progress=note
    )
    metrics = out / "metrics.jsonl"
    logged = metrics.read_text().splitlines() if metrics.exists() else []  # gone where nothing was left to train
    last = json.loads(logged[-1]) if logged else {}
    say(
        args,
        f"trained to step {int(state.step)}: "
        + "  ".join(f"{name} {value:.4g}" for name, value in last.items() if name not in ("step", "seconds_left")),
    )
    say(
        args,
        f"written to {out}/: weights.npz, config.yaml, metrics.jsonl, curves.png, checkpoints\n"
        f"next:  {command_line('evaluate', str(out), '--seed', '1')}",
    )
    return {"out": str(out), "metrics": last}


def _stored(args: argparse.Namespace) -> tuple[Dataset, Config]:
    """The data set, and the configuration to train with on it."""
    preset = args.preset or "laptop"
    data = Path(args.data or f"august_data/{preset}")
    if not (data / "manifest.json").exists():
        chosen_config(args)  # other mistakes are told first
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


def _streamed(config: Config) -> tuple[StreamedBatches, Sample]:
    from august_jax.data import open_stream

    made = open_stream(config, note)
    note(f"samples are made as training goes, {config.train.batch} new ones in each of {config.train.steps} steps")
    return made


COMMAND = Command("train the networks on a data set, or on a stream", _arguments, _run)
