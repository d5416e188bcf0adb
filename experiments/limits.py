"""What physics allows: bounds on position and tilt over range, SNR, tones, bandwidth and array; and a posterior beside.

    python experiments/limits.py compute [--small]     writes experiments/results/limits.npz
    python experiments/limits.py draw                  reads it, writes experiments/results/limits.png

The Fisher information of the full-wave channel (august_jax.physics.information), for a known airframe of unknown
place, attitude and material and an unknown complex gain, gives the error that is left to an estimator about the truth,
with a Gaussian prior in place of the uniform one. Where the echo tells more than the prior nobody does better; where it
does not, the figure is approximate, and errors can lie below it. Drawn over range it is the soft boundary of sensing:
where the bound reaches the prior, the echo says nothing about the place any more.

A bound knows one explanation of the echo. So the same is asked of the posterior of a known airframe
(august_jax.inference) over slots of the preset `laptop`: what it expects its means to err by, which counts all
explanations, beside the bound on the same slots. Where the two part, the bound promises what nobody can keep. Searches
are lines of JSON in --lines: a run that was stopped goes on where it was, and another estimator needs another folder.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from script import run
from searched import Lines, SlotBound, fresh, look

from august_jax.app.plotting import new_figure, save
from august_jax.config import preset
from august_jax.data import prepare_targets
from august_jax.evaluation import threshold_db
from august_jax.evaluation.threshold import WITHIN, said
from august_jax.inference import Prior, known_craft
from august_jax.physics import PlanarArray, factor_body, fisher_information, position_bound, tilt_bound
from august_jax.physics.information import Spread
from august_jax.progress import Progress, TimeLeft
from august_jax.scene import procedural_airframe, rotation_from_euler
from august_jax.schemes.matched_field import expected_errors

DIRECTION = np.array([0.5, 0.7, 0.51]) / np.linalg.norm([0.5, 0.7, 0.51])
CARRIER = 3e9
ARRAYS = {"16x1": (16, 1), "16x2": (16, 2), "16x4": (16, 4), "16x16": (16, 16)}
COMBS = {
    "1 tone": (1, 0.0),
    "4 tones, 20 MHz": (4, 20e6),
    "4 tones, 100 MHz": (4, 100e6),
    "8 tones, 100 MHz": (8, 100e6),
}
SNRS_DB = np.arange(0.0, 42.0, 2.0)
SEARCHED_DB, SLOTS = (0.0, 10.0, 20.0, 30.0), 4


def add_options(parser: argparse.ArgumentParser) -> None:
    """What this experiment takes besides."""
    parser.add_argument(
        "--lines", type=Path, default=Path("august_runs/limits"), help="searches that are done (%(default)s)"
    )


def compute(small: bool, progress: Progress = print, lines: Path | None = None) -> dict[str, np.ndarray]:
    """Bounds [m], [deg] of shape (case, range, SNR), averaged over attitudes; one case an array or a comb."""
    cell_m, attitudes, ranges = (0.03, 4, 6) if small else (0.015, 16, 12)
    ranges_m = np.geomspace(4.0, 60.0, ranges)
    drone = procedural_airframe("quad_x", half_wheelbase_m=0.25)
    cells = drone.cells(cell_m, 0.002)
    progress(f"{drone.name}: {cells.count} cells of {1e3 * cell_m:g} mm, {attitudes} attitudes, {ranges} ranges")
    generator = np.random.default_rng(0)
    tilts = np.deg2rad(generator.uniform(-30.0, 30.0, (2, attitudes)))
    rotations = np.asarray(rotation_from_euler(*tilts, generator.uniform(-np.pi, np.pi, attitudes)))
    cases = [(f"{name}, 1 tone", shape, COMBS["1 tone"]) for name, shape in ARRAYS.items()]
    cases += [(f"16x4, {name}", (16, 4), comb) for name, comb in COMBS.items() if name != "1 tone"]
    bodies, position, tilt = {}, [], []
    for label, shape, (count, width) in cases:
        began = time.perf_counter()
        tones = tuple(CARRIER + np.linspace(-0.5, 0.5, count) * width) if count > 1 else (CARRIER,)
        if tones not in bodies:
            bodies[tones] = factor_body(cells, tones, nearest_m=3.0)
        array = PlanarArray(*shape, CARRIER)
        places = np.repeat(ranges_m[:, None] * DIRECTION, attitudes, axis=0)
        turns = np.tile(rotations, (ranges, 1, 1))
        unit = fisher_information(bodies[tones], array, turns, places, 3.0, 5e-3, 1.0)
        by_snr = [10.0 ** (snr / 10.0) * unit for snr in SNRS_DB]
        position.append(np.stack([position_bound(f).reshape(ranges, attitudes) for f in by_snr], -1))
        tilts = [tilt_bound(f, turns[:, :, 2]).reshape(ranges, attitudes) for f in by_snr]
        tilt.append(np.rad2deg(np.stack(tilts, -1)))
        progress(
            f"{label}: {1e2 * np.sqrt(np.mean(position[-1][0, :, 10] ** 2)):.2g} cm at {ranges_m[0]:g} m and 20 dB "
            f"({time.perf_counter() - began:.0f} s)"
        )

    def rms(values):  # over attitudes
        return np.sqrt(np.mean(np.square(values), axis=2))

    return {
        "cases": np.array([label for label, *_ in cases]),
        "ranges_m": ranges_m,
        "snrs_db": SNRS_DB,
        "position_m": rms(np.stack(position)),
        "tilt_deg": rms(np.stack(tilt)),
        "cells": np.array(cells.count),
        **searched(small, progress, lines),
    }


def searched(small: bool, progress: Progress = print, lines: Path | None = None) -> dict[str, np.ndarray]:
    """What a posterior expects to err by (root-mean-square), what it errs by and the bound, of each slot at each SNR
    (slot, SNR, 3): of the position [m] and of the tilt [deg]."""
    config = preset("smoke" if small else "laptop")
    snrs, count = ((0.0, 30.0), 2) if small else (SEARCHED_DB, SLOTS)
    config = replace(config, target=replace(config.target, airframes=("quad_x",), cell_m=0.03 if small else 0.015))
    kept = Lines(None if lines is None else lines / f"{config.preset}.jsonl")
    done = {(row["slot"], row["snr_db"]) for row in kept.rows}
    left = [(slot, snr) for slot in range(count) for snr in snrs if (slot, snr) not in done]
    if left:
        targets = prepare_targets(config, progress)
        library, prior = known_craft(config, targets, progress=progress), Prior.from_config(config)
        samples = fresh(config, targets, count)
        bound = SlotBound(config, targets, samples)
    clock = TimeLeft(len(left))
    for slot, snr in left:
        predicted, found = look(library, prior, samples, slot, snr)
        own = bound.at(slot, snr, predicted)
        position = (
            np.sqrt(np.trace(found.position_covariance)),
            np.linalg.norm(found.mean_position - samples.position[slot]),
            own["bound_rms_m"],
        )
        aside = 1.0 - float(np.asarray(found.mean_normal) @ samples.rotation[slot, :, 2])
        squares = 2.0 * np.array([expected_errors(found)[1], max(aside, 0.0), own["bound_mde"]])
        tilt = np.rad2deg(np.sqrt(squares))  # 1 - cos is half the square of a small angle
        kept.add({"slot": slot, "snr_db": snr, "m": list(map(float, position)), "deg": list(map(float, tilt))})
        progress(
            f"posterior of slot {slot + 1} of {count} at {snr:g} dB: {1e2 * position[0]:.2g} cm, bound "
            f"{1e2 * position[2]:.2g} cm; {clock.after_one()}"
        )
    rows = {(row["slot"], row["snr_db"]): row for row in kept.rows}

    def values(unit):
        return np.array([[rows[slot, snr][unit] for snr in snrs] for slot in range(count)])

    return {"searched_db": np.array(snrs), "searched_m": values("m"), "searched_deg": values("deg")}


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Eight panels: position over range by array and by comb, tilt, two maps of range and SNR, and a posterior beside
    the bound."""
    cases, ranges, snrs = list(results["cases"]), results["ranges_m"], results["snrs_db"]
    spread = Spread()
    floor = spread.position_m * np.sqrt(3.0)
    at20 = int(np.argmin(np.abs(snrs - 20.0)))
    fig = new_figure(20.0, 8.5)
    panels = fig.subplots(2, 4)
    axes = panels[:, :3]
    for axis, values, unit, what, level in (
        (panels[0, 3], results["searched_m"], "m", "position", floor),
        (panels[1, 3], results["searched_deg"], "deg", "tilt", None),
    ):
        beside_the_bound(axis, results["searched_db"], values, unit, what)
        if level is not None:
            axis.axhline(level, color="0.5", ls="--")

    def lines(axis, chosen, values, unit, level, what):
        for label in chosen:
            axis.loglog(ranges, values[cases.index(label), :, at20], marker="o", ms=3, label=label)
        axis.axhline(level, color="0.5", ls="--", label="prior")
        axis.set(xlabel="range [m]", ylabel=f"{what} [{unit}]", title=f"{what} at 20 dB")
        axis.grid(True, which="both", alpha=0.3)
        axis.legend(fontsize=8)

    by_array = [label for label in cases if label.endswith(", 1 tone")]
    by_comb = [label for label in cases if label.startswith("16x4")]
    tilt_prior = np.rad2deg(spread.turn_rad) * np.sqrt(2.0)
    lines(axes[0, 0], by_array, results["position_m"], "m", floor, "position bound")
    lines(axes[0, 1], by_comb, results["position_m"], "m", floor, "position bound")
    lines(axes[1, 0], by_array, results["tilt_deg"], "deg", tilt_prior, "tilt bound")
    lines(axes[1, 1], by_comb, results["tilt_deg"], "deg", tilt_prior, "tilt bound")
    for axis in axes.flat:
        axis.set_xscale("log")
        axis.set_xticks([4, 8, 15, 30, 60], ["4", "8", "15", "30", "60"])
        axis.minorticks_off()
    for axis, label in zip(axes[:, 2], ("16x4, 1 tone", "16x4, 4 tones, 100 MHz")):
        values = results["position_m"][cases.index(label)].T
        mesh = axis.pcolormesh(ranges, snrs, np.log10(values), shading="gouraud", vmin=-3, vmax=0, cmap="viridis_r")
        lines_ = axis.contour(ranges, snrs, values, levels=[0.01, 0.03, 0.1, 0.3], colors="w", linewidths=1)
        axis.clabel(lines_, fmt=lambda value: f"{1e2 * value:g} cm", fontsize=8)
        axis.set(xlabel="range [m]", ylabel="SNR [dB]", title=f"position bound, {label}")
        fig.colorbar(mesh, ax=axis, label="log10 of metres")
    save(fig, path)


def beside_the_bound(axis, snrs: np.ndarray, values: np.ndarray, unit: str, what: str) -> None:
    """Root-mean-square over slots: expected by the posterior, true, and the bound; bars are standard errors."""
    squares = values**2
    middle = np.sqrt(squares.mean(axis=0))
    error = squares.std(axis=0, ddof=1) / np.sqrt(len(squares)) / (2.0 * middle)
    error = np.minimum(error, 0.9 * middle)
    for column, label, style in (
        (0, "expected by the posterior", {"color": "#0072b2", "marker": "o"}),
        (1, "true error", {"color": "#d55e00", "marker": "s", "ls": "none", "mfc": "none"}),
    ):
        axis.errorbar(snrs, middle[:, column], error[:, column], capsize=3, label=label, **style)
    axis.plot(snrs, middle[:, 2], color="0.2", ls="--", label="bound, same slots")
    from_db = said(threshold_db(snrs, middle[:, 0], middle[:, 2]), snrs)
    axis.set(
        xlabel="SNR [dB]",
        ylabel=f"{what} [{unit}]",
        yscale="log",
        title=f"{what} of a known craft, 16x4, 1 tone\nwithin {WITHIN:g} times the bound from: {from_db}",
    )
    axis.grid(True, which="both", alpha=0.3)
    axis.legend(fontsize=8)
    axis.title.set_size(10)


if __name__ == "__main__":
    run(__doc__, "limits", compute, draw, add_options)
