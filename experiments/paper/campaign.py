"""What the figures of the paper share: trained networks and their evaluations, made once, kept on disk, gone on with.

A :class:`Run` is one set of networks: the preset with what the run changes. A :class:`Campaign` keeps, under one
folder a preset, a training for each run, its rows of accuracy and the numbers of each figure. Whatever is on disk has
been made with the configuration whose digest it holds, or is refused.
"""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from august_jax import config as configuration
from august_jax.app.machine import processor
from august_jax.config import Config, override, preset
from august_jax.data import open_stream
from august_jax.evaluation import evaluate, validator
from august_jax.files import DamagedFile, read_json, read_npz, replacing, write_json
from august_jax.models import Networks
from august_jax.pipeline import load_networks
from august_jax.progress import Progress, silent
from august_jax.training.loop import train

SEED = 1
"""Of evaluations, flights and clouds; training has its own."""
RESULTS = Path(__file__).parent.parent / "results"
STREAMED = ("train.source=stream", "data.solver=table", "train.reobserve=true", "data.observed=false")
"""Every run learns from samples that are made as it learns, so that none needs a data set."""

BAND_HZ = 100e6
"""That several tones span, evenly about the carrier."""

Numbers = dict[str, np.ndarray]
Rows = list[dict[str, Any]]


class OutOfTime(Exception):
    """The budget is used up; what was done is on disk."""


class OtherConfiguration(ValueError):
    """What is on disk was made with another configuration."""


@dataclass(frozen=True)
class Scale:
    """How large a preset's figures are made.

    Attributes:
        steps: gradient steps of a run.
        points: of each cloud that a step uses, drawn anew in every step: the same gradient in expectation.
        count: slots of an evaluation.
        searched: slots that the search answers, where it is asked.
        snr_db: at which evaluations are made [dB].
        arrays: antennas along x and z, the largest first.
        encoders: of the channel.
        thresholds_m: by how much the prediction may miss, region by region [m].
        sizes_m: half-wheelbases, the preset's own first [m].
        permittivity, conductivity_s_m: upper ends of the wide range of materials, [1] and [S/m].
        flights: of each kind, that the distribution of tracking errors is of.
        tracked: of these, so many of each kind are also followed by the search, which takes half a minute each.
        samples_s: samples a second that a training was measured to take.
        tones: over :data:`BAND_HZ`, one tone first.
    """

    steps: int
    points: int
    count: int
    searched: int
    snr_db: tuple[float, ...]
    arrays: tuple[tuple[int, int], ...]
    encoders: tuple[str, ...]
    thresholds_m: tuple[float, ...]
    sizes_m: tuple[float, ...]
    permittivity: float
    conductivity_s_m: float
    flights: int
    tracked: int
    samples_s: float
    tones: tuple[int, ...] = (1, 2, 4, 8)

    def rehearsal(self) -> Scale:
        """A twentieth of all that takes long: of a training the steps and, in each, the points of a cloud."""
        names = ("steps", "points", "count", "searched", "flights", "tracked")
        return replace(self, **{name: max(getattr(self, name) // 20, 1) for name in names})


SCALES = {
    "smoke": Scale(
        20, 16, 8, 0, (0.0, 30.0), ((4, 2), (4, 1)), ("roi",), (0.5, 0.8), (0.25,), 8.0, 0.1, 2, 0, 300.0, tones=(1, 2)
    ),
    "laptop": Scale(
        3000,
        6,
        300,
        20,
        (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0),
        ((16, 4), (16, 2), (16, 1)),
        ("roi", "paper"),
        (0.5, 1.15, 2.15),
        (0.25, 0.2, 0.15),
        15.0,
        2.0,
        100,
        8,
        samples_s=2500.0,
    ),
    "paper": Scale(
        31_250,
        100,
        512,
        20,
        (-3.0, 0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0),
        ((16, 4), (16, 2), (16, 1)),
        ("paper", "roi"),
        (0.5, 1.15, 2.15),
        (0.35, 0.25, 0.5),
        15.0,
        2.0,
        100,
        20,
        samples_s=260.0,
    ),
}
"""Preset -> how large its figures are."""


@dataclass(frozen=True)
class Run:
    """Networks of their own.

    Attributes:
        name: of its folder and rows.
        assignments: what differs from the preset.
    """

    name: str
    assignments: tuple[str, ...]


def run_of(
    preset_name: str,
    scheme: str = "august",
    encoder: str | None = None,
    array: tuple[int, int] | None = None,
    threshold_m: float | None = None,
    size_m: float | None = None,
    wide: bool = False,
    tones: int = 1,
) -> Run:
    """The run of a scheme, an encoder, an array, a region, a craft's size, a range of materials and a number of tones;
    None takes what stands first in the preset's :class:`Scale`."""
    scale = SCALES[preset_name]
    encoder = encoder or scale.encoders[0]
    nx, nz = array or scale.arrays[0]
    threshold_m = scale.thresholds_m[0] if threshold_m is None else threshold_m
    size_m = scale.sizes_m[0] if size_m is None else size_m
    name = f"{scheme}-{encoder}-{nx}x{nz}"
    assignments = [
        f"model.scheme={scheme}",
        f"model.encoder={encoder}",
        f"array.nx={nx}",
        f"array.nz={nz}",
        f"target.half_wheelbase_m={size_m:g}",
        f"region.threshold_m={threshold_m:g}",
        f"region.scale_m={size_m + threshold_m:g}",
    ]
    if threshold_m != scale.thresholds_m[0]:
        name += f"-s{size_m + threshold_m:g}"
    if size_m != scale.sizes_m[0]:
        name += f"-size{size_m:g}"
    if wide:
        name += "-wide"
        assignments += [
            f"target.permittivity=[1.5,{scale.permittivity:g}]",
            f"target.conductivity_s_m=[0.001,{scale.conductivity_s_m:g}]",
            f"region.permittivity_max={scale.permittivity:g}",
            f"region.conductivity_max_s_m={scale.conductivity_s_m:g}",
        ]
    if tones > 1:
        name += f"-{tones}tones"
        comb = preset(preset_name).array.frequency_hz + 0.5 * BAND_HZ * np.linspace(-1.0, 1.0, tones)
        assignments.append(f"array.tones_hz=[{','.join(f'{tone:.0f}' for tone in comb)}]")
    return Run(name, tuple(assignments))


@dataclass(frozen=True)
class Record:
    """What every result says of itself.

    Attributes:
        preset, seed: what was asked.
        digest: of the configurations that it was made with.
        commit: of the source; "unknown" outside of a checkout.
        versions: of what computes.
        hardware: processor or accelerator.
        seconds: that making it took, trainings aside.
    """

    preset: str
    seed: int
    digest: str
    commit: str
    versions: dict[str, str]
    hardware: str
    seconds: float


def digest_of(*configs: Config) -> str:
    """Of all that numbers depend on."""
    text = "\n".join(configuration.to_yaml(config) for config in configs)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def record(preset_name: str, digest: str, seconds: float) -> Record:
    """Of what has just been made."""
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=RESULTS.parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    versions = {name: version(name) for name in ("august_jax", "jax", "jaxlib", "flax", "numpy")}
    device = jax.devices()[0]
    named = device.device_kind if device.platform != "cpu" else processor()
    return Record(preset_name, SEED, digest, commit, versions | {"python": platform.python_version()}, named, seconds)


def _whole(weights: Path) -> bool:
    """Whether they can be read; a training goes on from its checkpoint, and writes them anew."""
    try:
        return bool(read_npz(weights))
    except (DamagedFile, FileNotFoundError):
        return False


class Campaign:
    """Everything of one preset on disk.

    Args:
        preset_name: a preset.
        runs: folder of the trainings.
        results: folder of rows and figures, one below it a preset.
        progress: told what is done, with time left.
        deadline: of :func:`time.monotonic`, after which nothing new is begun.
        rehearse: a twentieth of the scale, in folders of its own.

    Raises:
        ConfigError: no such preset.
    """

    def __init__(
        self,
        preset_name: str,
        runs: Path,
        results: Path = RESULTS,
        progress: Progress = silent,
        deadline: float | None = None,
        rehearse: bool = False,
    ):
        self.base = preset(preset_name)
        self.preset, self.scale, self.progress = preset_name, SCALES[preset_name], progress
        folder, self._saves = preset_name, 10
        if rehearse:  # validation draws whole clouds of what it saves: twice is as good a rehearsal as ten times
            self.scale, folder, self._saves = self.scale.rehearsal(), f"{preset_name}-rehearsal", 2
        self._runs, self._results, self._deadline = runs / folder, results / folder, deadline

    def config(self, run: Run) -> Config:
        """The configuration of a run, evaluations included."""
        scale = self.scale
        sized = (
            f"train.steps={scale.steps}",
            f"train.points={scale.points}",
            f"train.save_every={min(self.base.train.save_every, max(scale.steps // self._saves, 1))}",
            f"evaluate.count={scale.count}",
            "evaluate.searched=0",
            f"evaluate.snr_db=[{','.join(f'{snr:g}' for snr in scale.snr_db)}]",
        )
        return override(self.base, (*STREAMED, *sized, *run.assignments))

    def folder(self, run: Run) -> Path:
        """Of its training."""
        return self._runs / run.name

    def trained(self, run: Run) -> int:
        """Steps that are on disk."""
        try:
            lines = (self.folder(run) / "metrics.jsonl").read_text().splitlines()
            kept = sorted((self.folder(run) / "checkpoints").glob("[0-9]*"), key=lambda path: int(path.name))
        except (FileNotFoundError, ValueError):
            return 0
        return int(kept[-1].name) if lines and kept else 0

    def networks(self, run: Run) -> Networks:
        """Trained to the end, from where they were.

        Raises:
            OtherConfiguration: the folder holds a run of another configuration.
            OutOfTime: the deadline has passed; the last checkpoint is kept.
        """
        config, out = self.config(run), self.folder(run)
        if self.trained(run) < config.train.steps or not _whole(out / "weights.npz"):
            self._in_time()
            self.progress(f"training {run.name}, {config.train.steps} steps")
            batches, held_out = open_stream(config, self.progress)

            def told(line: str) -> None:
                self.progress(f"{run.name}: {line}")
                self._in_time()

            try:
                train(config, batches, out, validate=validator(held_out, config), progress=told)
            except ValueError as error:
                raise OtherConfiguration(f"{error}") from error
            jax.clear_caches()  # a process has room for so many programs
        networks = load_networks(out)
        kept = replace(networks.config, evaluate=config.evaluate)
        if digest_of(kept) != digest_of(config):
            raise OtherConfiguration(
                f"{out} was trained with another configuration than {run.name} has now; remove it, or choose another "
                "folder with --runs"
            )
        return replace(networks, config=config)

    def evaluated(self, run: Run, searched: bool = False) -> bool:
        """Whether the rows are on disk."""
        return self._rows_path(run, True).exists() or (not searched and self._rows_path(run, False).exists())

    def rows(self, run: Run, searched: bool = False) -> Rows:
        """Accuracy of a run's networks and of all other schemes on the same fresh slots.

        Args:
            run: the networks.
            searched: whether the search among the known craft answers, too; where it has, its rows are there anyhow.

        Raises:
            OtherConfiguration: the rows are of another configuration.
            OutOfTime: the deadline has passed.
        """
        config = self.config(run)
        searched = searched or self.evaluated(run, True)  # the same slots and more
        if searched:
            config = override(config, (f"evaluate.searched={self.scale.searched}",))
        path, digest = self._rows_path(run, searched), digest_of(config)
        if path.exists():
            try:
                kept = read_json(path)
                found, rows = kept["record"]["digest"], kept["rows"]
            except (DamagedFile, KeyError, TypeError) as error:
                raise OtherConfiguration(f"{path} cannot be read; remove it and evaluate again") from error
            self._check(found, digest, path)
            return rows
        networks = self.networks(run)
        self._in_time()
        began = time.monotonic()
        rows = evaluate(networks, config, seed=SEED, progress=lambda line: self.progress(f"{run.name}: {line}"))
        path.parent.mkdir(parents=True, exist_ok=True)
        of = record(self.preset, digest, time.monotonic() - began)
        write_json(path, {"record": asdict(of), "rows": rows})
        jax.clear_caches()
        return rows

    def computed(self, name: str) -> bool:
        """Whether a figure's numbers are on disk."""
        return self._numbers_path(name).exists()

    def numbers(self, name: str, digest: str) -> Numbers:
        """A figure's numbers from the disk.

        Raises:
            FileNotFoundError: there are none.
            OtherConfiguration: they are of another configuration, or damaged.
        """
        path = self._numbers_path(name)
        try:
            numbers = read_npz(path)
            kept = json.loads(str(numbers.pop("record")))
        except (DamagedFile, KeyError, json.JSONDecodeError) as error:
            raise OtherConfiguration(f"{path} cannot be read ({error}); remove it and compute it again") from error
        self._check(kept["digest"], digest, path)
        return numbers

    def keep(self, name: str, numbers: Numbers, digest: str, seconds: float) -> Path:
        """Write a figure's numbers with their record."""
        path = self._numbers_path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as aside:
            np.savez_compressed(aside, record=json.dumps(asdict(record(self.preset, digest, seconds))), **numbers)
        return path

    def picture(self, name: str) -> Path:
        """Where a figure is drawn, without the ending."""
        return self._results / name

    def timed(self, make: Callable[[], Numbers]) -> tuple[Numbers, float]:
        """What is made, and the seconds that it took; refused after the deadline."""
        self._in_time()
        began = time.monotonic()
        return make(), time.monotonic() - began

    def _rows_path(self, run: Run, searched: bool) -> Path:
        return self._results / "rows" / f"{run.name}{'-searched' if searched else ''}.json"

    def _numbers_path(self, name: str) -> Path:
        return self._results / f"{name}.npz"

    def _in_time(self) -> None:
        if self._deadline is not None and time.monotonic() > self._deadline:
            raise OutOfTime

    @staticmethod
    def _check(kept: str, wanted: str, path: Path) -> None:
        if kept != wanted:
            raise OtherConfiguration(
                f"{path} was made with another configuration ({kept}, now {wanted}); remove it, and it is made again"
            )
