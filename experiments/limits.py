"""What physics allows: bounds on position and tilt over range, SNR, tones, bandwidth and array.

    python experiments/limits.py compute [--small]     writes experiments/results/limits.npz
    python experiments/limits.py draw                  reads it, writes experiments/results/limits.png

The Fisher information of the full-wave channel (august_jax.physics.information), for a known airframe of unknown
place, attitude and material and an unknown complex gain, gives the error that no estimator can beat on average under
the prior. Drawn over range it is the soft boundary of sensing: where the bound reaches the prior, the echo says
nothing about the place any more.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import PlanarArray, factor_body, fisher_information, position_bound, tilt_bound
from august_jax.physics.information import Spread
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler

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


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
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
    }


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Six panels: position over range by array and by comb, tilt, and two maps of range and SNR."""
    cases, ranges, snrs = list(results["cases"]), results["ranges_m"], results["snrs_db"]
    spread = Spread()
    floor = spread.position_m * np.sqrt(3.0)
    at20 = int(np.argmin(np.abs(snrs - 20.0)))
    fig = new_figure(15.0, 8.5)
    axes = fig.subplots(2, 3)

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


if __name__ == "__main__":
    run(__doc__, "limits", compute, draw)
