"""Training steps: on a stream against on a data set, and against the same networks in PyTorch.

    python benchmarks/training.py --json training.json
    python benchmarks/training.py --preset smoke --steps 4 --repeats 1       a minute, to see that it runs
    python benchmarks/training.py --parts torch --preset paper train.batch=32

``stream`` trains the same networks of a preset with the same batch, in the same process, in turn; the figures are
medians over the stretches of ``--steps`` steps, compiling and saving left out. The data set is made by table, so that
it takes seconds, and is read from the system's cache of files, as after the first epoch of any set that fits the
memory. The first run factors and tabulates the bodies: minutes, told apart as ``preparing``.

``torch`` makes steps on one made-up batch with the paper's networks at the preset's widths (encoder ``paper``, frame
``region``, no readout), in turn with the same networks, parameters, optimiser and moving average in PyTorch, eager
(`torch_august.py`). Beside the ratio stand how far their losses and gradients lie apart on the same draws, and the
share of the machine's matrix-product rate: multiplications and additions of the layers, three passes a step. PyTorch is
no dependency: `pip install torch` adds this part, without it it is left out.

``observe`` times what a stream's batch takes at the station, by estimator, and least squares over the beams beside
the singular value decomposition of the pilots that it stands for, with how far the two lie apart.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
from common import Figures, machine, medians, parsed, write
from flax import nnx

from august_jax import streams
from august_jax.config import Config, override, preset
from august_jax.data import Dataset, StreamedBatches, TrainingBatches, prepare_targets, simulate
from august_jax.data.fields import Batch
from august_jax.models import August
from august_jax.signal import ESTIMATORS, ChannelEstimate, observe_for
from august_jax.training import train
from august_jax.training.step import ParameterLayout, compiled_step, laid_out

PEER = importlib.util.find_spec("torch") is not None
PARTS = ("observe", "stream", "torch")


def speed(config, batches, steps: int) -> list[float]:
    """Samples a second of three stretches of a run."""
    timed = replace(config, train=replace(config.train, steps=3 * steps, log_every=steps, save_every=3 * steps))
    with tempfile.TemporaryDirectory() as folder:
        train(timed, batches, folder)
        lines = (Path(folder) / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["samples_per_s"] for line in lines]


def stream_against_stored(config: Config, steps: int, repeats: int) -> Figures:
    """Samples a second of both, and what making a batch takes."""
    config = override(config, ["data.solver=table", "train.reobserve=true"])
    config = replace(config, data=replace(config.data, count=max(20 * config.train.batch, 100), observed=False))
    streamed = override(config, ["train.source=stream"])
    start = time.perf_counter()
    targets = prepare_targets(streamed)
    stream = StreamedBatches(streamed, targets)
    figures: Figures = {"preparing_s": time.perf_counter() - start}
    figures["table_errors"] = [np.asarray(target.table.errors).tolist() for target in targets if target.table]
    with tempfile.TemporaryDirectory() as folder:
        simulate(config, folder)
        stored = TrainingBatches(Dataset(folder), config)
        numbers = iter(range(10**6))
        makers = {"stored": stored, "stream": stream}
        calls = {name: (lambda make=make: jax.tree.leaves(make(next(numbers)))) for name, make in makers.items()}
        figures["batch_s"] = medians(calls, 5 * repeats)
        found: dict[str, list[float]] = {"stored": [], "stream": []}
        for _ in range(repeats):
            found["stored"] += speed(config, stored, steps)
            found["stream"] += speed(streamed, stream, steps)
    for name, values in found.items():
        figures[name] = {"samples_per_s": float(np.median(values)), "all": values}
        print(
            f"{name}: {np.median(values):.0f} samples/s ({min(values):.0f} to {max(values):.0f}); "
            f"a batch of {config.train.batch} alone {1e3 * figures['batch_s'][name]:.0f} ms"
        )
    figures["stream_over_stored"] = figures["stream"]["samples_per_s"] / figures["stored"]["samples_per_s"]
    print(f"stream / stored: {figures['stream_over_stored']:.2f}; preparing {figures['preparing_s']:.0f} s")
    return figures


def by_singular_values(received, pilots, noise_w=None, region=None) -> ChannelEstimate:
    """Least squares as it is written, on the singular values of the pilots above a tenth of the largest."""
    left, values, right = jnp.linalg.svd(pilots, full_matrices=False)
    kept = values > 0.1 * values[0]
    inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
    channel = ((received @ right.conj().T) * inverse) @ left.conj().T
    return ChannelEstimate(0.5 * (channel + channel.T), jnp.sum(kept, dtype=jnp.int32))


def observing(config: Config, repeats: int) -> Figures:
    """Seconds that the station takes over a batch, by estimator; ``svd`` is ``ls`` by singular values."""
    batch = jax.device_put(made_up(config))
    keys = jax.random.split(jax.random.key(config.train.seed), config.train.batch)

    def observed(name: str):
        changed = override(config, ["model.encoder=paper", f"signal.estimator={'ls' if name == 'svd' else name}"])

        def one(key, channel, predicted):
            return observe_for(changed, key, channel, predicted, snr_db=20.0).heard

        return jax.jit(jax.vmap(one))

    runs = {name: observed(name) for name in (*ESTIMATORS, "svd")}
    calls = {name: (lambda run=run: run(keys, batch.estimated_channel, batch.predicted)) for name, run in runs.items()}
    heard = {"ls": np.asarray(calls["ls"]())}
    with patch.dict(ESTIMATORS, ls=replace(ESTIMATORS["ls"], run_beams=by_singular_values)):
        heard["svd"] = np.asarray(calls["svd"]())  # compiled here, while the registry says this way
    taken = medians(calls, repeats)
    apart = [float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(heard["ls"], heard["svd"], strict=True)]
    for name, value in taken.items():
        print(
            f"{name}: {1e3 * value:.1f} ms a batch of {config.train.batch}, {config.train.batch / value:.0f} samples/s"
        )
    print(f"svd / ls: {taken['svd'] / taken['ls']:.1f}; apart by {np.median(apart):.1e} (at most {max(apart):.1e})")
    return {"batch_s": taken, "svd_over_ls": taken["svd"] / taken["ls"], "apart": apart}


def made_up(config: Config) -> Batch:
    """A batch of the shapes and scales of a real one; what it says does not matter to a step's time."""
    draw, size, clouds = np.random.default_rng(1), config.array.count, config.train.batch
    shape = (clouds, len(config.array.frequencies_hz), size, size)
    channel = 1e-6 * (draw.standard_normal(shape) + 1j * draw.standard_normal(shape)).astype(np.complex64)
    low, high = np.array(config.flight.box_m).T
    return Batch(
        predicted=draw.uniform(low, high, (clouds, 3)).astype(np.float32),
        snr_db=draw.uniform(0.0, 30.0, clouds).astype(np.float32),
        cloud=draw.standard_normal((clouds, config.train.points, 5)).astype(np.float32),
        estimated_channel=channel,
    )


def products(networks: August, clouds: int, points: int) -> float:
    """Multiplications and additions of the layers of one gradient step: forward, and two products of each backward."""
    each = {id(layer.linear) for layer in networks.denoiser.layers}
    rows = [
        (module.kernel[...].size, clouds * points if id(module) in each else clouds)
        for _, module in nnx.iter_modules(networks)
        if isinstance(module, nnx.Linear)
    ]
    return 3.0 * sum(2.0 * size * count for size, count in rows)


def against_torch(config: Config, steps: int, repeats: int, gflop_s: float) -> Figures:
    """Seconds of a step in turn, how far the two lie apart, and the share of the machine's matrix products."""
    from torch_august import TorchTraining, disagreement, heard

    config = override(config, ["model.encoder=paper", "model.frame=region", "train.weight_readout=0"])
    networks = August(config, nnx.Rngs(config.train.seed))
    graphdef, state = nnx.split(networks)
    # last layers start at zero, which would leave most of the gradient zero: a step from the start checks nothing
    draw = np.random.default_rng(2)
    state = jax.tree.map(lambda leaf: leaf + 0.02 * draw.standard_normal(leaf.shape).astype(np.float32), state)
    networks, batch = nnx.merge(graphdef, state), made_up(config)
    few = jax.tree.map(lambda leaf: leaf[:8], batch)
    loss_error, gradient_error = disagreement(networks, few, streams.key(0, "train.step"))
    layout, begun = laid_out(ParameterLayout, config.train, graphdef, state)
    peer, theirs = TorchTraining(networks), heard(batch)
    kept = [begun]
    on_device = jax.device_put(batch)

    def ours():
        for _ in range(steps):
            kept[0], numbers = compiled_step(layout.loss, config.train, kept[0], on_device)
        return numbers["loss"]

    def torch_steps():
        for _ in range(steps):
            loss = peer.step(theirs)
        return loss

    each = {name: value / steps for name, value in medians({"jax": ours, "torch": torch_steps}, repeats).items()}
    flop = products(networks, config.train.batch, config.train.points)
    figures = {
        "batch": config.train.batch,
        "points": config.train.points,
        "step_s": each,
        "samples_per_s": {name: config.train.batch / value for name, value in each.items()},
        "torch_over_jax": each["torch"] / each["jax"],
        "loss_error": loss_error,
        "gradient_error": gradient_error,
        "step_gflop": flop / 1e9,
        "rate_share": {name: flop / 1e9 / value / gflop_s for name, value in each.items()},
    }
    jax_share, torch_share = (100.0 * share for share in figures["rate_share"].values())
    print(
        f"a step of {config.train.batch} clouds of {config.train.points} points: {1e3 * each['jax']:.1f} ms, PyTorch "
        f"{1e3 * each['torch']:.1f} ms, {figures['torch_over_jax']:.2f} times as long; {flop / 1e9:.2f} Gflop, "
        f"{jax_share:.0f} % of the matrix-product rate ({torch_share:.0f} %); "
        f"apart by {loss_error:.1e} (loss) and {gradient_error:.1e} (gradient)"
    )
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", metavar="SECTION.FIELD=VALUE", help="that differ from the preset")
    parser.add_argument("--preset", default="laptop")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--steps", type=int, default=20, help="of a stretch")
    parser.add_argument("--repeats", type=int, default=3, help="runs of three stretches, of either kind")
    args = parsed(parser)
    config = override(preset(args.preset), args.overrides)
    figures: Figures = {"machine": machine(), "preset": args.preset, "overrides": args.overrides}
    if "torch" in args.parts and PEER:
        figures["torch"] = against_torch(config, args.steps, 3 * args.repeats, figures["machine"]["gflop_s"])
        write(args, figures)
    elif "torch" in args.parts:
        print("PyTorch is not installed: its part is left out; pip install torch adds it")
    if "observe" in args.parts:
        figures["observe"] = observing(config, 3 * args.repeats)
        write(args, figures)
    if "stream" in args.parts:
        figures |= stream_against_stored(config, args.steps, args.repeats)
    write(args, figures)


if __name__ == "__main__":
    main()
