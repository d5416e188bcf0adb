"""Training on a stream against training on a data set: samples a second, in turn, and what a streamed batch takes.

    python benchmarks/training.py --json training.json
    python benchmarks/training.py --preset smoke --steps 4 --repeats 1       a minute, to see that it runs

Both train the same networks of a preset with the same batch, in the same process, in turn; the figures are medians over
the stretches of ``--steps`` steps, compiling and saving left out. The data set is made by table, so that it takes
seconds, and is read from the system's cache of files, as after the first epoch of any set that fits the memory. The
first run factors and tabulates the bodies: minutes, told apart as ``preparing``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from common import Figures, machine, medians, parsed, write

from august_jax.config import override, preset
from august_jax.data import Dataset, StreamedBatches, TrainingBatches, prepare_targets, simulate
from august_jax.training import train


def speed(config, batches, steps: int) -> list[float]:
    """Samples a second of three stretches of a run."""
    timed = replace(config, train=replace(config.train, steps=3 * steps, log_every=steps, save_every=3 * steps))
    with tempfile.TemporaryDirectory() as folder:
        train(timed, batches, folder)
        lines = (Path(folder) / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["samples_per_s"] for line in lines]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="laptop")
    parser.add_argument("--steps", type=int, default=20, help="of a stretch")
    parser.add_argument("--repeats", type=int, default=3, help="runs of three stretches, of either kind")
    args = parsed(parser)
    figures: Figures = {"machine": machine(), "preset": args.preset}
    config = override(preset(args.preset), ["data.solver=table", "train.reobserve=true"])
    config = replace(config, data=replace(config.data, count=max(20 * config.train.batch, 100), observed=False))
    streamed = override(config, ["train.source=stream"])
    start = time.perf_counter()
    targets = prepare_targets(streamed)
    stream = StreamedBatches(streamed, targets)
    figures["preparing_s"] = time.perf_counter() - start
    figures["table_errors"] = [np.asarray(target.table.errors).tolist() for target in targets if target.table]
    with tempfile.TemporaryDirectory() as folder:
        simulate(config, folder)
        stored = TrainingBatches(Dataset(folder), config)
        steps = iter(range(10**6))
        makers = {"stored": stored, "stream": stream}
        calls = {name: (lambda make=make: jax.tree.leaves(make(next(steps)))) for name, make in makers.items()}
        figures["batch_s"] = medians(calls, 5 * args.repeats)
        found: dict[str, list[float]] = {"stored": [], "stream": []}
        for _ in range(args.repeats):
            found["stored"] += speed(config, stored, args.steps)
            found["stream"] += speed(streamed, stream, args.steps)
    for name, values in found.items():
        figures[name] = {"samples_per_s": float(np.median(values)), "all": values}
        print(
            f"{name}: {np.median(values):.0f} samples/s ({min(values):.0f} to {max(values):.0f}); "
            f"a batch of {config.train.batch} alone {1e3 * figures['batch_s'][name]:.0f} ms"
        )
    figures["stream_over_stored"] = figures["stream"]["samples_per_s"] / figures["stored"]["samples_per_s"]
    print(f"stream / stored: {figures['stream_over_stored']:.2f}; preparing {figures['preparing_s']:.0f} s")
    write(args, figures)


if __name__ == "__main__":
    main()
