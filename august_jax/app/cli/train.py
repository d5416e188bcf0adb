"""``august train``: the networks, on a data set, continued where they were left."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, folder
from august_jax.app.cli.messages import command_line, note, say
from august_jax.app.cli.parser import Command, presets_help
from august_jax.config import ConfigError


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = presets_help()
    parser.add_argument("--data", metavar="DIR", help="what august simulate wrote (default: august_data/PRESET)")
    parser.add_argument(
        "--init", metavar="RUN", help="start from another run's weights, or from the shipped ones (--init shipped)"
    )


def _run(args: argparse.Namespace) -> dict[str, Any]:
    preset = args.preset or "laptop"
    data = Path(args.data or f"august_data/{preset}")
    if not (data / "manifest.json").exists():
        chosen_config(args)  # other mistakes are told first
        raise ConfigError(
            f"--data: {data} holds no data (no manifest.json)\n"
            f"make them: {command_line('simulate', '--preset', preset, '--out', str(data))}"
        )
    from august_jax import pipeline
    from august_jax.app.plotting import training_curves
    from august_jax.data import Dataset, TrainingBatches
    from august_jax.evaluation import validator
    from august_jax.training.loop import train

    weights = pipeline.run_files(None if args.init == "shipped" else args.init)[1] if args.init else None
    dataset = Dataset(data)
    config = configuration.training_config(dataset.config, args.overrides, name=args.preset, data=data)
    batches = TrainingBatches(dataset, config)
    out = folder(args, f"august_runs/{config.preset}", configured=True)
    note(f"{len(dataset.rows('train'))} of {dataset.count} samples are for training, {config.train.steps} steps")
    state = train(
        config, batches, out, validate=validator(dataset, config), draw=training_curves, weights=weights, progress=note
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


COMMAND = Command("train the networks on a data set", _arguments, _run)
