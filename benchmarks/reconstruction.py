"""Clouds from echoes: how long one takes, how many a second, and what fewer evaluations of the network cost.

    python benchmarks/reconstruction.py --json reconstruction.json
    python benchmarks/reconstruction.py --run august_runs/smoke --count 4 --repeats 1      a minute: does it run

Networks, the shipped ones or those of a training run, draw clouds of fresh slots at one SNR by the paper's sampler (all
steps of the schedule) and by DPM-Solver++ with fewer evaluations. What is compared is called in turn on the same slots;
times are medians, compiling left out: of one cloud, as a station that tracks one drone waits for it, and of a batch.
Beside them stand the Chamfer distance to the truth with its standard error, its ratio to the paper's sampler on the
same slots, and the share of the machine's matrix-product rate that the denoiser takes.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from common import Figures, machine, medians, parsed, write

from august_jax import streams
from august_jax.config import Config
from august_jax.data import fresh_samples, observed_anew, prepare_targets
from august_jax.evaluation import metrics
from august_jax.models import Networks
from august_jax.pipeline import load_networks
from august_jax.scene.cloud import from_cloud

SEED = 1
SNR_DB = 20.0
EVALUATIONS = (5, 10, 20)
HEADINGS = (
    "sampler, evaluations",
    "one cloud [ms]",
    "clouds a second",
    "MCD [dB]",
    "Chamfer against the paper's sampler",
    "times as fast: one, many",
    "of the matrix-product rate",
)


def samplers(config: Config) -> dict[str, Config]:
    """Name -> the configuration with this sampler, the paper's first."""
    steps = config.model.steps
    settings = {f"ancestral, {steps}": replace(config.evaluate, sampler="ancestral")}
    settings |= {
        f"dpm, {count}": replace(config.evaluate, sampler="dpm", sampler_steps=count)
        for count in EVALUATIONS
        if count < steps
    }
    return {name: replace(config, evaluate=evaluate) for name, evaluate in settings.items()}


def flop(config: Config, evaluations: int) -> float:
    """Multiplications and additions of the denoiser's layers on all points of one cloud."""
    widths = (5, *config.model.denoiser, 5)
    return 2.0 * evaluations * config.target.points * sum(a * b for a, b in zip(widths, widths[1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="what august train wrote (the shipped weights)")
    parser.add_argument("--count", type=int, default=200, help="slots whose clouds are judged (%(default)s)")
    parser.add_argument("--batch", type=int, default=50, help="clouds at once (%(default)s)")
    parser.add_argument("--repeats", type=int, default=5)
    args = parsed(parser)
    networks = load_networks(args.run)
    figures: Figures = {"machine": machine(), "networks": networks.name, "snr_db": SNR_DB, "count": args.count}
    figures["rows"] = measured(networks, args.count, min(args.batch, args.count), args.repeats, figures)
    print(f"| {' | '.join(HEADINGS)} |\n{'| --- ' * len(HEADINGS)}|")
    for row in figures["rows"]:
        cells = (
            row["sampler"],
            f"{1e3 * row['one_s']:.1f}",
            f"{row['clouds_per_s']:.1f}",
            f"{row['mcd_db']:.2f} ± {row['mcd_se_db']:.2f}",
            f"{row['chamfer_ratio']:.3f}",
            f"{row['one_faster']:.1f}, {row['many_faster']:.1f}",
            f"{100 * row['rate_share']:.0f} %",
        )
        print(f"| {' | '.join(cells)} |")
    write(args, figures)


@streams.pin
def measured(networks: Networks, count: int, batch: int, repeats: int, figures: Figures) -> list[Figures]:
    """A row a sampler."""
    config = networks.config
    samples = fresh_samples(config, np.arange(count), prepare_targets(config), seed=SEED, domain="evaluate")
    seen = observed_anew(streams.key(SEED, "evaluate.observation"), samples, config, SNR_DB)
    key = streams.key(SEED, "evaluate.answer")
    settings = samplers(config)

    def clouds(name: str, rows: slice) -> jax.Array:
        heard, predicted, snr = jax.tree.map(lambda leaf: leaf[rows], (seen.heard, seen.predicted, seen.snr_db))
        return networks.reconstruct(jax.random.fold_in(key, rows.start), heard, predicted, snr, settings[name])

    one = medians({name: lambda name=name: clouds(name, slice(0, 1)) for name in settings}, 3 * repeats)
    many = medians({name: lambda name=name: clouds(name, slice(0, batch)) for name in settings}, repeats)
    rows: list[Figures] = []
    for name, chosen in settings.items():
        apart = []
        for start in range(0, count - count % batch, batch):
            part = slice(start, start + batch)
            world = from_cloud(clouds(name, part), seen.predicted[part], config.region)
            apart.append(np.asarray(metrics.shape_distances(world.points, samples.points[part])))
        distances = np.concatenate(apart)
        mcd, error = metrics.decibels(distances)
        evaluations = chosen.evaluate.sampler_steps if chosen.evaluate.sampler == "dpm" else config.model.steps
        rows.append(
            {
                "sampler": name,
                "one_s": one[name],
                "clouds_per_s": batch / many[name],
                "mcd_db": mcd,
                "mcd_se_db": error or 0.0,
                "mean_m2": float(distances.mean()),
                "rate_share": flop(config, evaluations) * batch / many[name] / 1e9
                / figures["machine"]["gflop_s"],
            }
        )  # fmt: skip
    for row in rows:
        row["chamfer_ratio"] = row["mean_m2"] / rows[0]["mean_m2"]
        row["one_faster"] = rows[0]["one_s"] / row["one_s"]
        row["many_faster"] = row["clouds_per_s"] / rows[0]["clouds_per_s"]
    return rows


if __name__ == "__main__":
    main()
