"""One process that simulates, trains, evaluates and follows flights for an hour: does memory grow, is a number bad?

    python tests/faults/soak.py --minutes 60 --record docs/soak.json --picture docs/soak.png

A round is what a service that lives long would do through the public names of Python: a data set made in two parts, a
training run that is stopped amid its steps and continued, its weights loaded and evaluated with all schemes (the search
among them), a flight followed by the networks and another by the search. Data and training are the same in every
round, and so must be what they leave, hash for hash; samples, echoes and flights of the rest are new ones each time.

Recorded are, at the end of each round, memory that is in use (asked of the allocator and not given back), resident
memory (what the allocator keeps beside it counted in; twice a second, too), open files, threads and mappings, programs
that were compiled, and values that are not finite where they should be. Memory counts as flat where a straight line
through what is in use in the second half climbs by less than ``MOST_MIB_A_MINUTE``, two standard errors counted in. The
smoke preset serves, whose networks learn nothing: what is made of each part is what the others want.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import hashlib
import json
import os
import platform
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from august_jax import evaluation, pipeline
from august_jax.app.machine import processor
from august_jax.config import Config, override, preset
from august_jax.data import Dataset, TrainingBatches, channels_along, prepare_targets, simulate
from august_jax.files import write_text
from august_jax.inference import known_craft
from august_jax.schemes import follow_flight
from august_jax.training import train

MOST_MIB_A_MINUTE = 1.0
"""What memory in use may climb by in the second half, two standard errors counted in."""
CONFIG = override(preset("smoke"), ["evaluate.searched=1", "evaluate.snr_db=[20]"])
SLOTS = 6
"""Of each flight."""
STOPPED_AFTER = 13
"""Steps of training, three beyond a checkpoint."""
_MIB = float(1 << 20)
_PAGE = os.sysconf("SC_PAGE_SIZE")
_EVERY_S = 0.5


class Stopped(Exception):
    """Training is stopped amid its steps."""


def resident_mib() -> float:
    """Memory of this process that is in the machine's [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE / _MIB


class _MallocInfo(ctypes.Structure):
    """glibc's ``struct mallinfo2``."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]


def live_mib() -> float | None:
    """Memory that was asked for and not given back [MiB], whatever the allocator keeps beside it; None without glibc.

    Compiled code and what Python's own small objects share are not in it.
    """
    told = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if told is None:
        return None
    told.restype = _MallocInfo
    found = told()
    return (found.uordblks + found.hblkhd) / _MIB


class Sampler:
    """Resident memory twice a second, in a thread, while the block runs: ``seconds`` and ``mib``."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.mib: list[float] = []
        self._began = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def now(self) -> float:
        """Seconds since it was made."""
        return time.monotonic() - self._began

    def _sample(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self.seconds.append(self.now())
            self.mib.append(resident_mib())

    def __enter__(self) -> Sampler:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


class Rounds:
    """What a round does; everything that is made once is made by the first.

    Attributes:
        folder: that rounds work in.
        not_finite: values that are not finite where they should be, by where.
        hashes: by file, of what must be the same in every round.
        other: files that differed from those of the first round.
    """

    def __init__(self, folder: Path, config: Config = CONFIG):
        self.folder, self.config = folder, config
        self.not_finite: Counter[str] = Counter()
        self.values = 0
        self.hashes: dict[str, str] = {}
        self.other: list[str] = []
        self._targets = prepare_targets(config)
        self._library = known_craft(config, self._targets)

    def parts(self) -> dict[str, Callable[[int], None]]:
        """What a round consists of, in order, by name."""
        return {
            "simulate": self.simulate,
            "train": self.train,
            "evaluate": self.evaluate,
            "track": self.track,
            "search": self.search,
        }

    def simulate(self, number: int) -> None:
        """A data set, made in two parts."""
        data = self.folder / "data"
        shutil.rmtree(data, ignore_errors=True)
        for part in (1, 2):
            simulate(self.config, data, part=(part, 2))
        dataset = Dataset(data)
        for name, column in dataset.read(np.arange(dataset.count)).columns().items():
            self._count(f"data.{name}", column)
        self._compare(path for path in data.rglob("*.npy"))

    def train(self, number: int) -> None:
        """A run, stopped amid its steps and continued."""
        run, dataset = self.folder / "run", Dataset(self.folder / "data")
        shutil.rmtree(run, ignore_errors=True)
        batches = TrainingBatches(dataset, self.config)

        def stopping(step: int) -> Any:
            if step == STOPPED_AFTER:
                raise Stopped
            return batches(step)

        validate = evaluation.validator(dataset, self.config)
        try:
            train(self.config, stopping, run, validate=validate)
        except Stopped:
            state = train(self.config, batches, run, validate=validate)
        self._count("train.params", state.params)
        for line in (run / "metrics.jsonl").read_text().splitlines():
            self._count("train.metrics", np.array(list(json.loads(line).values()), float))
        with np.load(run / "weights.npz") as arrays:
            for name in arrays:
                self._count("train.weights", arrays[name])
                self._same(f"weights.{name}", np.ascontiguousarray(arrays[name]).tobytes())

    def evaluate(self, number: int) -> None:
        """The run's weights on fresh samples, by all schemes."""
        networks = pipeline.load_networks(self.folder / "run")
        rows = evaluation.evaluate(networks, networks.config, seed=number)
        for row in rows:
            for name, value in row.items():
                if isinstance(value, (int, float)):
                    self._count(f"evaluate.{row['scheme']}.{name}", np.asarray(value, float))

    def track(self, number: int) -> None:
        """A flight followed by the networks."""
        networks = pipeline.load_networks(self.folder / "run")
        shot = pipeline.draw_scenario(networks.config, number, SLOTS)
        track = pipeline.sense(networks, networks.config, shot, seed=number, snr_db=20.0)
        self._count_track("track", track)

    def search(self, number: int) -> None:
        """A flight followed by hypotheses among known craft."""
        shot = pipeline.draw_scenario(self.config, number, SLOTS)
        body = next(each.body for each in self._targets if each.airframe.digest == shot.airframe.digest)
        material = shot.permittivity, shot.conductivity
        channels = channels_along(self.config, shot.airframe, shot.rotations, shot.positions, *material, body)
        self._count("search.channels", channels)
        flown = follow_flight(self._library, self.config, shot, channels, seed=number, snr_db=20.0)
        self._count_track("search", flown.track)
        for step in flown.steps:
            self._count("search.expected_error_m", np.asarray(step.expected_error_m))

    def _count_track(self, where: str, track: pipeline.Track) -> None:
        for name, value in vars(track).items():
            if value is None:
                continue
            if name == "threshold_m":  # a detection says where to listen: there is none
                value = np.asarray(value)[~np.asarray(track.detected, bool)]
            self._count(f"{where}.{name}", value)

    def _count(self, where: str, values: Any) -> None:
        values = np.asarray(values)
        self.values += values.size
        if wrong := int(np.sum(~np.isfinite(values))):
            self.not_finite[where] += wrong

    def _compare(self, paths: Any) -> None:
        for path in sorted(paths):
            self._same(str(path.relative_to(self.folder)), path.read_bytes())

    def _same(self, name: str, content: bytes) -> None:
        found = hashlib.sha256(content).hexdigest()
        if self.hashes.setdefault(name, found) != found:
            self.other.append(name)


def trend(minutes: np.ndarray, mib: np.ndarray) -> tuple[float, float]:
    """Slope of the least-squares line and its standard error, both [MiB/min]; NaN of fewer than four points."""
    if len(minutes) < 4:
        return float("nan"), float("nan")
    x, y = minutes - minutes.mean(), mib - mib.mean()
    slope = float(x @ y / (x @ x))
    return slope, float(np.sqrt(np.sum((y - slope * x) ** 2) / (len(x) - 2) / (x @ x)))


def judged(ends: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the rounds' ends in the second half: the trends of memory in use and of resident memory, and whether the first
    is flat; without glibc the second."""
    half = [end for end in ends if end["minute"] >= ends[-1]["minute"] / 2]
    found: dict[str, Any] = {}
    for name in ("live_mib", "mib"):
        if half[0].get(name) is None:
            continue
        slope, error = trend(*(np.array([end[each] for end in half]) for each in ("minute", name)))
        found[f"{name}_a_minute"], found[f"{name}_a_minute_error"] = slope, error
        found.setdefault("flat", bool(slope + 2.0 * error < MOST_MIB_A_MINUTE))
    return found


def soak(folder: Path, minutes: float, tell: Callable[[str], None] = print, count: int | None = None) -> dict:
    """Rounds in ``folder`` for so many minutes, or so many rounds; returns the record.

    Args:
        folder: of the work; what is in it goes with each round.
        minutes: after which no other round begins.
        tell: takes a line a round.
        count: of rounds, whatever time they take; None leaves it to the time.
    """
    compiled: Counter[str] = Counter()
    doing = "prepare"

    def noted(event: str, seconds: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled[doing] += 1

    jax.monitoring.register_event_duration_secs_listener(noted)
    with Sampler() as sampler:
        rounds = Rounds(folder)
        ends: list[dict[str, Any]] = []
        while sampler.now() < 60.0 * minutes if count is None else len(ends) < count:
            compiled.clear()
            spent = {}
            for doing, work in rounds.parts().items():
                began = time.monotonic()
                work(len(ends) + 1)
                spent[doing] = round(time.monotonic() - began, 2)
            gc.collect()
            ends.append(
                {
                    "minute": sampler.now() / 60.0,
                    "mib": resident_mib(),
                    "live_mib": live_mib(),
                    "files": len(os.listdir("/proc/self/fd")),
                    "threads": threading.active_count(),
                    "mappings": Path("/proc/self/maps").read_text().count("\n"),
                    "compiled": dict(compiled),
                    "seconds": spent,
                }
            )
            last = ends[-1]
            tell(
                f"round {len(ends)}, minute {last['minute']:.1f}: {last['live_mib'] or 0:.1f} MiB in use, "
                f"{last['mib']:.0f} resident, {last['files']} files, {last['threads']} threads, {last['mappings']} "
                f"mappings, compiled {last['compiled']}, took {spent}, not finite {sum(rounds.not_finite.values())}, "
                f"different {len(rounds.other)}"
            )
    jax.monitoring.unregister_event_duration_listener(noted)
    names = ("jax", "jaxlib", "numpy", "flax", "optax", "orbax-checkpoint")
    return {
        "minutes": ends[-1]["minute"],
        "rounds": len(ends),
        **judged(ends),
        "values": rounds.values,
        "not_finite": dict(rounds.not_finite),
        "compared": len(rounds.hashes),
        "different": rounds.other,
        "ends": ends,
        "seconds": [round(value, 1) for value in sampler.seconds],
        "mib": [round(value, 1) for value in sampler.mib],
        "machine": processor(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in names},
    }


def draw(record: dict, path: Path) -> None:
    """Memory over time, and the lines through the second half."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    ends = record["ends"]
    at = np.array([end["minute"] for end in ends])
    half = at >= at[-1] / 2
    figure, axes = plt.subplots(figsize=(6.4, 2.8), dpi=90, layout="constrained")
    axes.plot(np.array(record["seconds"]) / 60.0, record["mib"], lw=0.4, color="0.7", label="resident, twice a second")
    for name, label, colour in (("mib", "resident", "C0"), ("live_mib", "in use", "C2")):
        slope = record.get(f"{name}_a_minute")
        if slope is None:
            continue
        mib = np.array([end[name] for end in ends])
        axes.plot(at, mib, "o", ms=3, color=colour)
        line = mib[half].mean() + slope * (at[half] - at[half].mean())
        error = record[f"{name}_a_minute_error"]
        axes.plot(at[half], line, color=colour, label=f"{label}: {slope:+.2f} +- {error:.2f} MiB a minute")
    axes.set(xlabel="minutes", ylabel="memory [MiB]", ylim=(0, None), xlim=(0, None))
    axes.legend(loc="lower right", fontsize=8, frameon=False)
    axes.set_title(f"{record['rounds']} rounds in one process", fontsize=10)
    figure.savefig(path)
    plt.close(figure)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, metavar="N", help="so many, whatever time they take")
    parser.add_argument("--record", type=Path, metavar="JSON")
    parser.add_argument("--picture", type=Path, metavar="PNG")
    args = parser.parse_args()

    def tell(line: str) -> None:
        print(line, flush=True)

    warnings.filterwarnings("ignore", "cells.volumes")  # the preset's cells are coarse
    with tempfile.TemporaryDirectory() as folder:
        record = soak(Path(folder), args.minutes, tell, args.rounds)
    shown = {name: value for name, value in record.items() if name not in ("ends", "seconds", "mib")}
    tell(json.dumps(shown, indent=1))
    if args.record:
        write_text(args.record, json.dumps(record) + "\n")
    if args.picture:
        draw(record, args.picture)
    return 0 if record["flat"] and not record["not_finite"] and not record["different"] else 1


if __name__ == "__main__":
    sys.exit(main())
