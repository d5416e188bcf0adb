"""``august train``: the networks, on a data set, continued where they were left."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, differences, folder
from august_jax.app.cli.messages import note, say
from august_jax.app.cli.parser import Command
from august_jax.config import Config, ConfigError


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", metavar="DIR", help="what august simulate wrote (default: august_data/PRESET)")
    parser.add_argument("--init", metavar="RUN",
                        help="start from another run's weights, or from the shipped ones (--init shipped)")


def _run(args: argparse.Namespace) -> dict[str, Any]:
    preset = args.preset or "laptop"
    data = Path(args.data or f"august_data/{preset}")
    if not (data / "manifest.json").exists():
        chosen_config(args)  # other mistakes are told first
        raise ConfigError(f"--data: {data} holds no data (no manifest.json)\n"
                          f"make them: august simulate --preset {preset} --out {data}")
    from august_jax import pipeline
    from august_jax.app.plotting import training_curves
    from august_jax.data import Dataset, TrainingBatches
    from august_jax.evaluation import validator
    from august_jax.training.loop import train

    weights = pipeline.run_files(None if args.init == "shipped" else args.init)[1] if args.init else None
    dataset = Dataset(data)
    config = _training_config(args, dataset.config, data)
    batches = TrainingBatches(dataset, config)
    out = folder(args, f"august_runs/{config.preset}", configured=True)
    note(f"{len(dataset.rows('train'))} of {dataset.count} samples are for training, {config.train.steps} steps")
    state = train(config, batches, out, validate=validator(dataset, config), draw=training_curves,
                  weights=weights, progress=note)
    metrics = out / "metrics.jsonl"
    logged = metrics.read_text().splitlines() if metrics.exists() else []  # gone where nothing was left to train
    last = json.loads(logged[-1]) if logged else {}
    say(args, f"trained to step {int(state.step)}: " + "  ".join(f"{name} {value:.4g}" for name, value in last.items()
                                                                 if name not in ("step", "seconds_left")))
    say(args, f"written to {out}/: weights.npz, config.yaml, metrics.jsonl, curves.png, checkpoints\n"
              f"next:  august evaluate {out} --seed 1")
    return {"out": str(out), "metrics": last}


def _training_config(args: argparse.Namespace, made: Config, data: Path) -> Config:
    """The preset's networks and training on what the data say about themselves, with the overrides."""
    if args.preset and args.preset != made.preset:
        raise ConfigError(f"preset: {args.preset!r}, but the data in {data} were made with preset {made.preset!r}\n"
                          f"pass --preset {made.preset}, or make other data with august simulate")
    sections = ("array", "target", "flight", "region", "signal", "data")
    base = dataclasses.replace(configuration.preset(made.preset), **{name: getattr(made, name) for name in sections})
    config = configuration.override(base, args.overrides)
    # what is observed anew in every step does not depend on how it was observed when the data were made
    fixed = sections[:3] + ("data",) + (() if config.train.reobserve else ("region", "signal"))
    if config.model.scheme == "refchannel":
        raise ConfigError("model.scheme=refchannel: the data hold no reference channels, which it learns from\n"
                          "choose august, noebd or nolatent")
    for path, has, wanted in differences(made, config, fixed):
        raise ConfigError(f"{path}={wanted}: the data in {data} were made with {has}\n"
                          "leave the override out, or make other data with august simulate")
    return config


COMMAND = Command("train the networks on a data set", _arguments, _run)
