"""Where one explanation of an echo is left: over SNR, antennas, tones and range.

    python experiments/threshold.py compute [--small] [--count N] [--case NAME ...] [--snr DB ...]
    python experiments/threshold.py draw             reads experiments/results/threshold.npz, writes threshold.png

The same slots are heard by 16x1, 16x2 and 16x4 antennas, by 1, 2 and 4 tones over 100 MHz, and three times as far away,
at 0 to 30 dB of all tones together, and searched among three known craft of 0.2 m. A posterior's explanations are
counted as august_jax.evaluation.explanations says: a craft and an attitude within 10 degrees, turns from arm to arm not
counted; there is one where it holds at least 95 % of the weight. Beside them: the probability of the craft that flies,
and the errors that the posterior expects of its means, the true ones, and the local bound, which knows of one
explanation alone.

Every search is one line of JSON in a file of its preset in --lines: a run that was stopped goes on where it was.
Another estimator needs another folder. Slots are done one after the other, each at all SNRs before all arrays, so that
what is there at any time is even. Bodies and tables for seven tones come first, once.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from script import run
from searched import Lines, SlotBound, columns, fresh, heard_elsewhere, look

from august_jax.app.plotting import new_figure, save
from august_jax.config import Config, preset, to_dict
from august_jax.data import Sample, prepare_targets
from august_jax.evaluation import calibration, threshold_db
from august_jax.evaluation.explanations import ONE, RADIUS_DEG, arms, effective_number, explanations, turned_deg
from august_jax.evaluation.threshold import WITHIN, said
from august_jax.inference import Library, Prior, known_craft
from august_jax.progress import Progress, TimeLeft
from august_jax.schemes.matched_field import expected_errors
from august_jax.signal.roi import Subspace

SNRS_DB = (0.0, 10.0, 20.0, 30.0)
COUNT = 4
CRAFT = ("quad_x", "hexa", "octo")
HALF_WHEELBASE_M = 0.2
"""Smaller than the preset's: bodies and tables of several tones then take a third of the time."""
BAND_HZ = 100e6
WIDE_DEG = 20.0
"""Of an explanation, to see how much hangs on the 10 degrees."""


class Case(NamedTuple):
    """Who hears the craft.

    Attributes:
        antennas: along x and z.
        tones: how many, evenly over 100 MHz about the carrier.
        farther: times the distance of the preset's flights.
    """

    antennas: tuple[int, int] = (16, 4)
    tones: int = 1
    farther: float = 1.0


CASES = {
    "16x4": Case(),
    "16x2": Case((16, 2)),
    "16x1": Case((16, 1)),
    "2 tones": Case(tones=2),
    "4 tones": Case(tones=4),
    "3 times as far": Case(farther=3.0),
}
SMALL = {"4x2": Case((4, 2)), "2 tones": Case((4, 2), tones=2), "3 times as far": Case((4, 2), farther=3.0)}
PANELS = (
    ("antennas", ("16x4", "16x2", "16x1")),
    ("tones over 100 MHz", ("16x4", "2 tones", "4 tones")),
    ("range", ("16x4", "3 times as far")),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """What this experiment takes besides."""
    parser.add_argument("--count", type=int, help=f"slots of each case and SNR ({COUNT}; 2 with --small)")
    parser.add_argument("--case", dest="cases", nargs="+", metavar="NAME", help=f"of {', '.join(CASES)} (all)")
    parser.add_argument(
        "--snr", dest="snrs_db", type=float, nargs="+", metavar="DB", help="in place of 0, 10, 20 and 30"
    )
    parser.add_argument("--lines", type=Path, default=Path("august_runs/threshold"), help="what is done (%(default)s)")


def compute(
    small: bool,
    progress: Progress = print,
    count: int | None = None,
    cases: Sequence[str] | None = None,
    snrs_db: Sequence[float] | None = None,
    lines: Path | None = None,
) -> dict[str, np.ndarray]:
    """Columns, one row a case, slot and SNR of all that has lines in the folder ``lines`` or is asked for."""
    known = SMALL if small else CASES
    unknown = [name for name in cases or () if name not in known]
    if unknown:
        raise SystemExit(f"--case: {unknown[0]!r} is none; give {', '.join(map(repr, known))}")
    config = _configuration(small)
    count, snrs = count or (2 if small else COUNT), snrs_db or ((10.0, 30.0) if small else SNRS_DB)
    kept = Lines(None if lines is None else lines / f"{config.preset}.jsonl")
    done = {(row["case"], row["slot"], row["snr_db"]) for row in kept.rows}
    left = [
        (slot, name, snr)
        for slot in range(count)
        for name in cases or known
        for snr in snrs
        if (name, slot, snr) not in done
    ]
    scenes = _Scenes(config, known, count, progress)
    for name in dict.fromkeys(name for _, name, _ in left):
        scenes.of(name)  # all that is tabulated comes first: what time is left is then known
    clock, told = TimeLeft(len(left)), time.monotonic()
    for at, (slot, name, snr_db) in enumerate(left, 1):
        kept.add({"case": name, "slot": slot, "snr_db": float(snr_db), **_looked(scenes.of(name), slot, snr_db)})
        time_left = clock.after_one()
        if time.monotonic() - told > 20.0 or at == len(left):
            told = time.monotonic()
            progress(
                f"slot {slot + 1} of {count}, {name}, {snr_db:g} dB: {at} of {len(left)} searches, "
                f"{clock.each_s:.1f} s each, {time_left}"
            )
    results = {**columns(kept.rows), "crafts": np.array(len(config.target.airframes))}
    settings = {
        "small": small,
        "slots": len({row["slot"] for row in kept.rows}),
        "snrs_db": sorted({row["snr_db"] for row in kept.rows}),
        "cases": {name: case._asdict() for name, case in known.items()},
        "radius_deg": RADIUS_DEG,
        "one": ONE,
        "within": WITHIN,
        "configuration": to_dict(config),
    }
    results["settings"] = np.array(json.dumps(settings))
    progress(table(results))
    return results


def _configuration(small: bool) -> Config:
    config = preset("smoke" if small else "laptop")
    if small:
        return config
    return replace(
        config,
        target=replace(config.target, airframes=CRAFT, half_wheelbase_m=HALF_WHEELBASE_M),
        region=replace(config.region, scale_m=HALF_WHEELBASE_M + config.region.threshold_m),
    )


class _Scene(NamedTuple):
    library: Library
    prior: Prior
    samples: Sample
    bound: SlotBound
    folds: list[int]


class _Scenes:
    """What cases need, made once; cases of the same tones share one library but for the array."""

    def __init__(self, config: Config, cases: dict[str, Case], count: int, progress: Progress):
        self._config, self._cases, self._count, self._progress = config, cases, count, progress
        self._libraries: dict[int, Library] = {}
        self._made: dict[str, _Scene] = {}
        self._samples: Sample | None = None

    def of(self, name: str) -> _Scene:
        """All of one case."""
        if name not in self._made:
            case = self._cases[name]
            config, shared = self._with(case), self._shared(case.tones)
            library = replace(shared, config=config, subspace=Subspace.from_config(config.array))
            if self._samples is None:
                self._samples = fresh(self._config, self._shared(1).targets, self._count)
            samples = heard_elsewhere(self._samples, config, library.targets, case.farther)
            self._made[name] = _Scene(
                library,
                Prior.from_config(config),
                samples,
                SlotBound(config, library.targets, samples),
                [arms(airframe) for airframe in library.airframes],
            )
        return self._made[name]

    def _with(self, case: Case) -> Config:
        """The configuration of a case, with a box that holds all flights of all cases: tables hold it, too."""
        config, farther = self._config, max(each.farther for each in self._cases.values())
        middle, half = config.array.frequency_hz, 0.5 * BAND_HZ
        comb = middle + half * np.linspace(-1.0, 1.0, case.tones)
        tones = tuple(map(float, comb)) if case.tones > 1 else ()
        nx, nz = case.antennas
        box = tuple((low, farther * high) for low, high in config.flight.box_m)
        return replace(
            config, array=replace(config.array, nx=nx, nz=nz, tones_hz=tones), flight=replace(config.flight, box_m=box)
        )

    def _widest(self) -> tuple[int, int]:
        return max((case.antennas for case in self._cases.values()), key=lambda sides: sides[0] * sides[1])

    def _shared(self, tones: int) -> Library:
        """Known craft for the widest array: their tables hold the smaller ones."""
        if tones not in self._libraries:
            config = self._with(Case(self._widest(), tones))
            self._progress(f"bodies and tables of {len(config.target.airframes)} craft, {tones} tone(s)")
            targets = prepare_targets(config, self._progress)
            self._libraries[tones] = known_craft(config, targets, progress=self._progress)
        return self._libraries[tones]


def _looked(scene: _Scene, slot: int, snr_db: float) -> dict[str, Any]:
    """A slot is observed and searched: plain numbers."""
    samples, library = scene.samples, scene.library
    predicted, found = look(library, scene.prior, samples, slot, snr_db)
    place, rotation = np.asarray(samples.position[slot], float), np.asarray(samples.rotation[slot], float)
    true = int(samples.airframe[slot])
    weights, about = explanations(found, scene.folds)
    by_heading, _ = explanations(found, [1] * found.crafts)
    wide, _ = explanations(found, scene.folds, radius_deg=WIDE_DEG)
    first, probabilities = int(about[0]), np.asarray(found.craft_probability, float)
    turn = turned_deg(found.rotation[first], rotation, scene.folds[true])
    expected_m, expected_normal = expected_errors(found)
    return {
        "craft": library.names[true],
        "named": library.names[int(np.argmax(probabilities))],
        "craft_probability": float(probabilities[true]),
        "heaviest": float(weights[0]),
        "explanations": effective_number(weights),
        "heaviest_by_heading": float(by_heading[0]),
        "explanations_by_heading": effective_number(by_heading),
        "heaviest_wide": float(wide[0]),
        "heaviest_is_true": bool(int(found.craft[first]) == true and turn <= RADIUS_DEG),
        "expected_error_m": expected_m,
        "error_m": float(np.linalg.norm(found.mean_position - place)),
        "prediction_error_m": float(np.linalg.norm(predicted - place)),
        "expected_normal_error": expected_normal,
        "normal_error": float(1.0 - np.asarray(found.mean_normal, float) @ rotation[:, 2]),
        "up_error": float(1.0 - rotation[2, 2]),
        **scene.bound.at(slot, snr_db, predicted),
        "effective_samples": float(found.effective),
        "residual": float(found.residual),
        "degrees": int(found.degrees),
        "explained": bool(found.explained),
        "range_m": float(np.linalg.norm(place)),
        "seconds": float(sum(found.seconds.values())),
    }


def _groups(results: dict[str, np.ndarray]) -> list[tuple[str, float, np.ndarray]]:
    """Case, SNR and the rows of both."""
    cases, snrs = results["case"], results["snr_db"]
    return [
        (str(case), float(snr), (cases == case) & (snrs == snr))
        for case in dict.fromkeys(cases.tolist())
        for snr in sorted(set(snrs[cases == case].tolist()))
    ]


def table(results: dict[str, np.ndarray]) -> str:
    """A line a case and SNR, and the thresholds."""
    lines = [
        "case            SNR slots  one explanation  (headings apart; 20 deg)  number  is true  craft p  "
        "MPE expected bound [m]     MDE expected bound   s"
    ]
    for case, snr, at in _groups(results):
        one, error = calibration.share(results["heaviest"][at] >= ONE)
        apart, wide = (np.mean(results[name][at] >= ONE) for name in ("heaviest_by_heading", "heaviest_wide"))
        means = {
            name: float(np.mean(results[name][at]))
            for name in (
                "heaviest_is_true", "craft_probability", "error_m", "expected_error_m", "bound_m",
                "normal_error", "expected_normal_error", "bound_mde", "seconds",
            )
        }  # fmt: skip
        lines.append(
            f"{case:15} {snr:3g} {at.sum():5d}  {one:.2f} +- {error:.2f}     ({apart:.2f}; {wide:.2f})            "
            f"{np.median(results['explanations'][at]):8.1f} {means['heaviest_is_true']:8.2f} "
            f"{means['craft_probability']:8.2f}  {means['error_m']:.3f} {means['expected_error_m']:.3f} "
            f"{means['bound_m']:.3f}      {means['normal_error']:.4f} {means['expected_normal_error']:.4f} "
            f"{means['bound_mde']:.4f} {means['seconds']:.1f}"
        )
    for case in dict.fromkeys(case for case, *_ in _groups(results)):
        position, normal = thresholds(results, case)
        lines.append(f"{case}: the posterior expects at most {WITHIN:g} times the bound, of place and of tilt, from: "
                     f"{position}; {normal}")  # fmt: skip
    return "\n".join(lines)


def thresholds(results: dict[str, np.ndarray], case: str) -> tuple[str, str]:
    """Of position and of tilt, in words (august_jax.evaluation.threshold)."""
    mine = [(snr, at) for name, snr, at in _groups(results) if name == case]
    snrs = np.array([snr for snr, _ in mine])
    told = []
    for expected, bound, within in (
        ("expected_error_m", "bound_m", WITHIN),
        ("expected_normal_error", "bound_mde", WITHIN**2),
    ):
        means = [np.array([np.mean(results[name][at]) for _, at in mine]) for name in (expected, bound)]
        told.append(said(threshold_db(snrs, *means, within), snrs))
    return told[0], told[1]


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Columns: antennas, tones, range. Rows: share with one explanation, their number, the craft's probability, errors
    of place and of tilt: expected by the posterior, true, and the bound."""
    print(table(results))
    settings = json.loads(str(results["settings"]))
    groups = _groups(results)
    there = list(dict.fromkeys(case for case, *_ in groups))
    base = there[0]
    panels = [(title, [base, *(name for name in names if name in there and name != base)]) for title, names in PANELS]
    styles = (("#0072b2", "o"), ("#d55e00", "s"), ("#009e73", "^"))  # told apart by the colour-blind, and in grey
    chance = 1.0 / float(results["crafts"])
    fig = new_figure(13.0, 15.5)
    axes = fig.subplots(5, len(panels), sharex=True, sharey="row", squeeze=False)
    for column, (title, names) in enumerate(panels):
        for row, (name, (colour, marker)) in enumerate(zip(names, styles)):
            mine = [(snr, at) for case, snr, at in groups if case == name]
            snrs = np.array([snr for snr, _ in mine]) + 0.5 * (row - 0.5 * (len(names) - 1))  # bars beside one another
            shares, errors = np.array([calibration.share(results["heaviest"][at] >= ONE) for _, at in mine]).T
            look_ = {"color": colour, "marker": marker, "ms": 5, "capsize": 2.5, "lw": 1.5}
            low, high = np.minimum(errors, shares), np.minimum(errors, 1.0 - shares)
            axes[0, column].errorbar(snrs, shares, (low, high), label=name, **look_)
            for at_row, value, average in (
                (1, "explanations", np.median),
                (2, "craft_probability", np.mean),
                (3, "expected_error_m", np.mean),
                (4, "expected_normal_error", np.mean),
            ):
                values = [results[value][at] for _, at in mine]
                middle = np.array([average(each) for each in values])
                if average is np.median:
                    spread = np.abs(np.array([np.quantile(each, (0.25, 0.75)) for each in values]).T - middle)
                else:
                    spread = np.array([np.std(each, ddof=1) / np.sqrt(len(each)) if len(each) > 1 else 0.0
                                       for each in values])  # fmt: skip
                    spread = np.stack([np.minimum(spread, 0.9 * middle), spread])
                axes[at_row, column].errorbar(snrs, middle, spread, **look_)
            for at_row, true, bound in ((3, "error_m", "bound_m"), (4, "normal_error", "bound_mde")):
                means = [[np.mean(results[each][at]) for _, at in mine] for each in (true, bound)]
                axes[at_row, column].plot(snrs, np.maximum(means[0], 1e-7), ls="none", marker=marker, mfc="none",
                                          color=colour)  # fmt: skip
                axes[at_row, column].plot(snrs, means[1], color=colour, ls="--", lw=1.2)
        axes[0, column].set_title(title)
        axes[0, column].legend(fontsize=9, loc="upper left")
        axes[2, column].axhline(chance, color="0.4", ls=":")
        axes[3, column].axhline(np.mean(results["prediction_error_m"]), color="0.4", ls=":")
        axes[4, column].axhline(np.mean(results["up_error"]), color="0.4", ls=":")
        axes[4, column].set_xlabel("SNR of all tones [dB]")
    for row, (label, limits) in enumerate(
        (
            ("slots with one explanation", (-0.03, 1.03)),
            ("explanations (median, quartiles)", None),
            ("probability of the true craft", (0.0, 1.03)),
            ("position error [m]", None),
            ("1 − cos of the normal's error", None),
        )
    ):
        axes[row, 0].set_ylabel(label)
        for axis in axes[row]:
            axis.grid(True, alpha=0.3)
            axis.set(ylim=limits) if limits else axis.set_yscale("log")
    axes[1, 0].set_ylim(bottom=0.9)
    fig.suptitle(
        f"{len(settings['configuration']['target']['airframes'])} known craft, at most {settings['slots']} slots each"
    )
    from matplotlib.lines import Line2D

    meaning = [
        Line2D([], [], color="0.3", marker="o", label="expected by the posterior (± standard error)"),
        Line2D([], [], color="0.3", marker="o", mfc="none", ls="none", label="true"),
        Line2D([], [], color="0.3", ls="--", label="local bound"),
        Line2D([], [], color="0.3", ls=":", label="without an echo; chance"),
    ]
    axes[3, 0].legend(handles=meaning, fontsize=8, loc="lower left")
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "threshold", compute, draw, add_options)
