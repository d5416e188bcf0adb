"""Radar cross-section of the procedural craft over the whole sphere, of plastic, with metal parts, and of carbon.

    python experiments/craft_rcs.py compute [--small]     writes experiments/results/craft_rcs.npz
    python experiments/craft_rcs.py draw                  reads it, writes experiments/results/craft_rcs.png

Every craft (half-wheelbase 0.25 m, skin of 2 mm) is seen from directions spread evenly over the sphere, monostatic, in
three materials: plastic alone (permittivity 3, 5 mS/m), as it is in `laptop`; the same with motors and a battery whose
skins conduct (17 ohm a square, the most that cells tell from a perfect conductor without ringing); and conducting all
over, as carbon fibre is. Coupled solves with one contrast a cell. Beside them what is published of small drones, which
were measured whole: batteries, motors, boards and wires included.
"""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import Cells, contrast, scattering_matrix
from august_jax.progress import Progress
from august_jax.scene import AIRFRAMES, procedural_airframe
from august_jax.scene.families import FAMILIES, REFERENCE_HALF_WHEELBASE_M
from august_jax.scene.lattice import shell_cells

HALF_WHEELBASE_M, SKIN_M = 0.25, 0.002
PLASTIC = (3.0, 5e-3)
CONDUCTING_S_M = 30.0
MATERIALS = ("plastic", "plastic, metal parts", "conducting")
COMMON_DBSM = (-20.0, -12.0)
"""Means of small drones as they are commonly quoted."""
MEASURED_DBSM = (-19.1, -8.1)
"""Least and most of the means of five drones, from a Bebop to a Matrice 600, at 24 GHz (IEICE Communications Express
9, 262 (2020), doi:10.1587/comex.2020XBL0018)."""


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Cross-sections [dBsm] (craft, material, frequency, direction, 3): HH, VV and HV."""
    names, hertz, cell_m, count = (
        (("quad_x", "octo"), (1.5e9,), 0.024, 60) if small else (AIRFRAMES, (1.5e9, 3e9, 4.5e9), 0.014, 600)
    )
    directions = jnp.asarray(spread(count), jnp.float32)
    found = np.zeros((len(names), len(MATERIALS), len(hertz), count, 3), np.float32)
    cells_of, parts_of = [], []
    for row, name in enumerate(names):
        cells, metal = craft(name, cell_m)
        cells_of.append(cells.count)
        parts_of.append(int(metal.sum()))
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
        for tone, frequency in enumerate(hertz):
            plastic = complex(contrast(*PLASTIC, frequency))
            conducting = complex(contrast(PLASTIC[0], CONDUCTING_S_M, frequency))
            for column, chi in enumerate((plastic, np.where(metal, conducting, plastic), conducting)):
                began = time.perf_counter()
                with warnings.catch_warnings():
                    warnings.filterwarnings("ignore", "contrast: cells of")  # what they tell is said on top
                    matrix = scattering_matrix(
                        single, directions, jnp.asarray(chi, jnp.complex64), frequency_hz=frequency
                    )
                power = np.abs(np.asarray(matrix)) ** 2
                entries = np.stack([power[:, 0, 0], power[:, 1, 1], power[:, 0, 1]], axis=-1)
                found[row, column, tone] = 10.0 * np.log10(np.maximum(entries, 1e-12))
                mean = 10.0 * np.log10(np.mean(entries, axis=0))
                progress(
                    f"{name}, {MATERIALS[column]}, {frequency / 1e9:g} GHz, {cells.count} cells: mean HH "
                    f"{mean[0]:.1f}, VV {mean[1]:.1f}, HV {mean[2]:.1f} dBsm, {time.perf_counter() - began:.0f} s"
                )
    return {
        "names": np.array(names),
        "frequency_hz": np.array(hertz),
        "directions": np.asarray(directions),
        "rcs_dbsm": found,
        "cells": np.array(cells_of),
        "metal_cells": np.array(parts_of),
        "cell_m": np.array(cell_m),
    }


def spread(count: int) -> np.ndarray:
    """Unit vectors (count, 3) that share the sphere evenly, by the golden angle."""
    place = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * place / count, np.pi * (1.0 + np.sqrt(5.0)) * place
    flat = np.sqrt(1.0 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=-1)


def craft(name: str, cell_m: float) -> tuple[Cells, np.ndarray]:
    """Cells of a craft with a battery in its hull, and which of them (N,) are of motors or of the battery."""
    import trimesh

    airframe, family = procedural_airframe(name, HALF_WHEELBASE_M), FAMILIES[name]
    scale = HALF_WHEELBASE_M / REFERENCE_HALF_WHEELBASE_M
    axes = airframe.rotor_axes_m
    # rotors stand 31 mm above the middle of the hull, in pairs above and below
    middle = axes.mean(axis=0) - [0.0, 0.0, 0.0 if family.coaxial else 0.031 * scale]
    size = scale * np.array([0.62, 0.5, 0.5]) * family.hull
    battery = trimesh.creation.box(size)
    battery.apply_translation(middle)
    cells = shell_cells(np.concatenate([airframe.mesh.triangles, battery.triangles]), cell_m, SKIN_M)
    places = np.asarray(cells.sites())
    in_battery = np.all(np.abs(places - middle) < 0.5 * size + 0.5 * SKIN_M, axis=1)
    side = np.sign(axes[:, 2] - middle[2])  # motors hang below their rotors, or above
    away = places[:, None] - (axes - np.outer(side, [0.0, 0.0, 0.018 * scale]))
    in_motor = (np.hypot(away[..., 0], away[..., 1]) < 0.018 * scale) & (np.abs(away[..., 2]) < 0.025 * scale)
    return cells, in_battery | in_motor.any(axis=1)


def means(results: dict[str, np.ndarray]) -> np.ndarray:
    """Mean cross-section over the sphere [dBsm] (craft, material, frequency, 3)."""
    return 10.0 * np.log10(np.mean(10.0 ** (results["rcs_dbsm"].astype(float) / 10.0), axis=3))


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Of each craft and material the mean, the median and where nine tenths of the directions lie, VV and HH."""
    names, hertz, values = results["names"], results["frequency_hz"], results["rcs_dbsm"]
    average = means(results)
    fig = new_figure(5.6 * len(hertz), 4.8)
    panels = np.atleast_1d(fig.subplots(1, len(hertz), sharey=True))
    for tone, (axis, frequency) in enumerate(zip(panels, hertz)):
        axis.axhspan(*COMMON_DBSM, color="#7a8894", alpha=0.18, lw=0, label="small drones, published means")
        axis.axhspan(*MEASURED_DBSM, facecolor="none", edgecolor="#7a8894", ls=":", label="five of them at 24 GHz")
        for row, _ in enumerate(names):
            for column, material in enumerate(MATERIALS):
                at = row + 0.24 * (column - 1)
                seen = values[row, column, tone, :, :2].ravel()
                low, middle, high = np.quantile(seen, (0.05, 0.5, 0.95))
                axis.plot([at, at], [low, high], color=f"C{column}", lw=2.0, alpha=0.45)
                axis.plot(at, middle, "_", color=f"C{column}", ms=10)
                mean = 10.0 * np.log10(np.mean(10.0 ** (average[row, column, tone, :2] / 10.0)))
                axis.plot(at, mean, "o", color=f"C{column}", ms=6, label=material if row == 0 else None)
        axis.set(title=f"{frequency / 1e9:g} GHz, HH and VV", xticks=range(len(names)))
        axis.set_xticklabels(names, rotation=20)
        axis.grid(True, axis="y", alpha=0.3)
    panels[0].set_ylabel("radar cross-section [dBsm]: mean (dot), median, 5 to 95 %")
    fig.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "craft_rcs", compute, draw)
