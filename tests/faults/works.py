"""The commands' writers at stand-in work: all that reaches the disk is theirs, what is computed takes no time.

Each work runs in a folder of its own, as often as one likes, and goes on with what is there. It tells its ledger what
it computes, so that work done twice shows. Nothing here may use JAX when it is imported: children are forked.
"""

import argparse
import hashlib
import json
import os
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments" / "paper"))

import campaign as campaigns
import figure as figures

import august_jax.app.report
import august_jax.evaluation
import august_jax.physics.body.cache as bodies
import august_jax.training.loop as training
from august_jax import data
from august_jax.app.cli import results
from august_jax.config import override, preset, read
from august_jax.data import shards
from august_jax.data.fields import Sample
from august_jax.files import read_json, read_npz, replacing
from august_jax.models import Networks
from august_jax.models.weights import read_weights
from august_jax.tracking import Track
from august_jax.training.checkpoint import Checkpoints
from august_jax.training.step import TrainState

WARM = august_jax.app.report, august_jax.evaluation
"""Imported before children are forked, rather than by each of them."""
CONFIG = override(preset("smoke"), ["data.count=9", "data.shard_rows=3", "data.observed=false"])
TRAINED = override(preset("smoke"), ["train.steps=6", "train.save_every=2", "train.log_every=1"])
CLOCK = ("samples_per_s", "seconds_left")
SAVE_EVERY = TRAINED.train.save_every


class Work:
    """What is killed.

    Attributes:
        once_more: how many entries of the ledger may be there twice after a kill and another run.
    """

    once_more = 1

    def run(self, folder: Path, ledger) -> None:
        """Make everything that is missing in ``folder``; ``ledger(entry)`` before each piece of work."""
        raise NotImplementedError

    def result(self, folder: Path) -> dict[str, str]:
        """Name -> hash of what an uninterrupted run gives; nothing that depends on the clock."""
        return {name: sha for name, sha in hashes(folder).items() if not name.startswith(".")}

    def look(self, folder: Path) -> None:
        """Open whatever is there as a user would; raises where something is damaged."""

    def whole(self, name: str) -> bool:
        """Whether the file of this name must always be one of those that a whole run leaves at some time."""
        return True


def hashes(folder: Path) -> dict[str, str]:
    """Hash by name of all files, hidden ones too."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Simulate(Work):
    """A data set of three shards."""

    def run(self, folder, ledger):
        def made(config, rows, targets, **_):
            ledger(f"shard {rows[0]}")
            return samples(rows, config)

        shards.generate, shards.prepare_targets = made, lambda config, progress: []
        data.simulate(CONFIG, folder)

    def look(self, folder):
        if (folder / "manifest.json").exists():
            manifest = shards.read_manifest(folder)
            assert read_json(folder / "manifest.json")["digest"] == shards.identity(CONFIG)
            if manifest["rows"] == manifest["wanted"]:
                rows = np.arange(CONFIG.data.count)
                found, wanted = data.Dataset(folder).read(rows), samples(rows, CONFIG)
                for name, value in wanted.columns().items():
                    np.testing.assert_array_equal(found.columns()[name], value)
        for shard in folder.glob("shard-*"):  # whole or absent
            meta = shards.read_meta(shard)
            assert meta is not None, f"{shard.name} without its description"
            assert shards._complete(shard, tuple(meta["rows"]), meta["digest"], True), f"{shard.name} damaged"


def samples(rows, config) -> Sample:
    """Numbers that depend on the row alone."""
    rows = np.asarray(rows)
    array, count = config.array, len(rows)
    shapes = {"position": (3,), "rotation": (3, 3), "permittivity": (), "conductivity": (), "airframe": (),
              "flight": (), "slot": (), "points": (config.target.points, 3),
              "true_channel": (1, array.count * (array.count + 1) // 2)}  # fmt: skip
    columns: dict[str, Any] = {}
    for place, (name, shape) in enumerate(shapes.items()):
        values = np.cos(rows.reshape(count, *(1 for _ in shape)) + np.arange(np.prod(shape)).reshape(shape) + place)
        kind = {"true_channel": np.complex64}.get(name, np.float32)
        columns[name] = values.astype(np.int32 if name in ("airframe", "flight", "slot") else kind)
    return Sample.of_columns(columns)


class Layout:
    """Of three parameters."""

    graphdef = None

    def arrays(self, params):
        return {"kernel": np.asarray(params)}

    def loss(self, *_):
        raise AssertionError("the step is made up")


def begin(config):
    import jax

    def put(values):
        return jax.device_put(np.asarray(values))

    params = np.linspace(0.0, 1.0, 300, dtype=np.float32)
    key = jax.random.wrap_key_data(put(np.array([3, 4], np.uint32)))
    return Layout(), TrainState(put(params), put(params), {"mu": put(params)}, put(np.int32(0)), key)


def step(loss, settings, state, batch):
    import jax

    done = int(state.step) + 1
    params = np.asarray(state.params) * np.float32(0.9) + np.float32(batch)
    ema = np.asarray(state.ema) * np.float32(0.5) + np.float32(0.5) * params
    new = state._replace(params=jax.device_put(params), ema=jax.device_put(ema), step=jax.device_put(np.int32(done)))
    return new, {"loss": np.float32(params.sum())}


def draw(metrics: Path, picture: Path) -> None:
    lines = len(metrics.read_text().splitlines())
    with replacing(picture) as aside:
        aside.write_bytes(b"picture of %d points" % lines)


def trained(config, folder, ledger, **rest) -> None:
    """A training at made-up steps."""

    def batch(number: int) -> float:
        return number / 7.0

    def told(line: str) -> None:
        if line.startswith("step "):
            ledger(line.split("/")[0])

    training.fitted_step = lambda loss, settings, *_: lambda state, batch: step(loss, settings, state, batch)
    training.time = SimpleNamespace(perf_counter=lambda: 0.0)
    training.train(
        config, batch, folder, begin=begin, draw=draw, validate=lambda *_: {"error": 1.0}, progress=told, **rest
    )


def restored(folder: Path) -> tuple[int, str]:
    """Step and hash of the last checkpoint."""
    _, state = begin(None)
    with Checkpoints(folder / "checkpoints") as checkpoints:
        state = checkpoints.restore(state)
    digest = hashlib.sha256()
    for leaf in (state.params, state.ema, state.opt_state["mu"], state.step):
        digest.update(np.asarray(leaf).tobytes())
    return int(state.step), digest.hexdigest()


def look_at_run(folder: Path) -> None:
    if (folder / "weights.npz").exists():
        assert set(read_weights(folder / "weights.npz")) == {"kernel"}
    if (folder / "config.yaml").exists():
        read(folder / "config.yaml")
    if any(path.name.isdigit() for path in (folder / "checkpoints").glob("*")):
        restored(folder)
        lines = (folder / "metrics.jsonl").read_text().splitlines()
        for line in lines[:-1]:
            json.loads(line)


def result_of_run(folder: Path) -> dict[str, str]:
    found = {
        name: sha
        for name, sha in hashes(folder).items()
        if not (name.startswith(("checkpoints/", ".lock")) or ".previous" in name)
    }
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    metrics = [{name: value for name, value in line.items() if name not in CLOCK} for line in lines]
    return found | {"metrics.jsonl": str(metrics), "the last checkpoint": str(restored(folder))}


class Train(Work):
    """Six steps, saved every second."""

    once_more = SAVE_EVERY

    def run(self, folder, ledger):
        trained(TRAINED, folder, ledger)

    def look(self, folder):
        look_at_run(folder)

    def result(self, folder):
        return result_of_run(folder)

    def whole(self, name):
        return not name.startswith(("checkpoints/", "metrics.jsonl"))


class Flight(Work):
    """What `track` (and `demo`, and `reconstruct`) leaves: files of one run, never of two."""

    def run(self, folder, ledger):
        if not (folder / "metrics.json").exists():
            self._leave(folder, 1)
        ledger("flight")
        self._leave(folder, 2)

    def _leave(self, folder, seed):
        rng = np.random.default_rng(seed)
        slots, points = 2, 6
        cloud = rng.normal(size=(3, slots, points, 3))
        track = Track(
            time_s=np.arange(slots) * 0.2, position=cloud[0, :, 0], rotation=np.tile(np.eye(3), (slots, 1, 1)),
            predicted=cloud[0, :, 1], snr_db=np.full(slots, 20.0), permittivity=3.0, conductivity=0.01,
            truth=cloud[0], resampled=cloud[1], points=cloud[2], point_permittivity=np.ones((slots, points)),
            point_conductivity=np.ones((slots, points)), normal_estimate=np.tile([0.0, 0.0, 1.0], (slots, 1)),
        )  # fmt: skip
        row = {name: 0.1 for name in ("mpe_m", "mpe_se_m", "mde", "mde_triples", "wd_db", "mcd_db")}
        scores = {"slots": [{"slot": 0}], "schemes": [{"scheme": "august", **row}], "seed": seed}
        args = argparse.Namespace(
            command="track", words=["track", "--seed", str(seed)], snr=20.0, seed=seed, json=False
        )
        with redirect_stdout(open(os.devnull, "w")):
            results.leave(
                args, folder, TRAINED, track, scores, made={}, seconds=1.0, title="made up", lead="", setup=[],
                following=[], draw=lambda png: png.write_bytes(b"picture %d" % seed), hypotheses={},
            )  # fmt: skip

    def look(self, folder):
        if not (folder / "metrics.json").exists():
            return  # it says itself that it was stopped
        found = json.loads((folder / "metrics.json").read_text())["seed"]
        assert (folder / "track.png").read_bytes() == b"picture %d" % found
        wanted = np.random.default_rng(found).normal(size=(3, 2, 6, 3))[2]
        np.testing.assert_array_equal(read_npz(folder / "clouds.npz")["points"], wanted)
        read(folder / "config.yaml")


class Reproduce(Work):
    """A figure: networks, their rows of accuracy, its numbers, its pictures."""

    once_more = SAVE_EVERY

    def run(self, folder, ledger):
        figure = figures.Figure(
            "made_up",
            "nothing",
            "none",
            lambda name: [(self.networks, True)],
            lambda campaign: {"rows": np.array([row["mpe_m"] for row in campaign.rows(self.networks)])},
            Picture,
        )

        def rows(networks, config, **_):
            ledger("rows")
            return [{"scheme": "august", "mpe_m": 0.25}]

        campaigns.open_stream = lambda config, progress: (None, None)
        campaigns.validator = lambda *_: None
        campaigns.train = lambda config, batches, out, **_: trained(config, out, ledger)
        campaigns.load_networks = lambda out: Networks("made up", read(out / "config.yaml"), None, None)  # type: ignore[arg-type]
        campaigns.evaluate = rows
        campaigns.record = lambda name, digest, seconds: campaigns.Record(name, 1, digest, "none", {}, "none", 0.0)
        campaign = campaigns.Campaign("smoke", folder / "runs", folder / "results")
        campaign.scale = replace(campaign.scale, steps=6)
        campaign.base = override(campaign.base, ["train.save_every=2", "train.log_every=1"])
        campaign.networks(self.networks)
        campaign.rows(self.networks)
        figures.picture(figure, campaign, figures.make(figure, campaign))

    networks = campaigns.Run("one", ())

    def look(self, folder):
        look_at_run(folder / "runs" / "smoke" / "one")
        for path in folder.glob("results/**/[!.]*"):  # what is aside nobody reads
            if path.suffix == ".npz":
                read_npz(path)
            elif path.suffix == ".json":
                json.loads(path.read_text())

    def result(self, folder):
        found = {name: sha for name, sha in hashes(folder).items() if not name.startswith("runs/")}
        return found | result_of_run(folder / "runs" / "smoke" / "one")

    def whole(self, name):
        return "/checkpoints/" not in name and not name.endswith("metrics.jsonl")


class Picture:
    """Of a figure's numbers."""

    def __init__(self, numbers):
        self._numbers = numbers

    def savefig(self, path, format, **_):
        path.write_bytes(f"{format} of {self._numbers['rows']}".encode())


class Cache(Work):
    """Three bodies or tables: they are kept by the same function."""

    def run(self, folder, ledger):
        os.environ["AUGUST_CACHE"] = str(folder)
        for number in range(3):

            def make(number=number):
                ledger(f"body {number}")
                return {"modes": np.arange(40.0) + number, "places": np.full((3, 4), number)}

            found = bodies.cached([np.array([number])], ("modes", "places"), make)
            np.testing.assert_array_equal(found["modes"], np.arange(40.0) + number)

    def look(self, folder):
        for path in folder.glob("body-*.npz"):
            read_npz(path)


WORKS: dict[str, Work] = {
    "simulate": Simulate(),
    "train": Train(),
    "track": Flight(),
    "reproduce": Reproduce(),
    "cache": Cache(),
}
