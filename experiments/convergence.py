"""Which cell size buys which error: an airframe's channel on ever finer lattices, its skin's thickness fixed.

    python experiments/convergence.py compute [--small]     writes experiments/results/convergence.npz
    python experiments/convergence.py draw                  reads it, writes experiments/results/convergence.png

The same craft, attitudes, place and materials; only the cells shrink. Cells hear the antennas at their material's
centroids and couple on the way there (what `Airframe.cells` gives), or do both at the lattice's centres. Each channel
is compared with that of the finest lattice of the first kind: as it is, and after one complex factor (a gain, which
no estimator knows) has been taken out.
"""

from __future__ import annotations

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import PlanarArray, contrast, sensing_channel
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler

PLACE = np.array([3.0, 4.5, 2.5])
PERMITTIVITIES = (2.0, 3.0, 5.0)
SKIN_M = 0.001
SITES = ("centroid", "centre")


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Relative differences to the finest lattice (fields at, size, permittivity), root mean squares over attitudes."""
    sizes_mm, poses = ((14.0, 10.0, 7.0), 2) if small else ((14.0, 10.0, 7.0, 5.0, 4.0), 4)
    array = PlanarArray(16, 4, 3e9)
    drone = procedural_airframe("quad_x", half_wheelbase_m=0.15)
    generator = np.random.default_rng(0)
    tilts_deg, headings = zip(
        *((generator.uniform(-20, 20, 2), generator.uniform(-np.pi, np.pi)) for _ in range(poses))
    )
    turns = jnp.asarray(rotation_from_euler(*np.deg2rad(tilts_deg).T, np.array(headings)), jnp.float32)
    contrasts = [contrast(permittivity, 5e-3, 3e9).astype(jnp.complex64) for permittivity in PERMITTIVITIES]

    @jax.jit
    def solve(body, turn, chi):
        return sensing_channel(array, body.moved(turn, jnp.asarray(PLACE, jnp.float32)), chi, solver="krylov")

    channels, counts, volumes = [], [], []
    for size in sizes_mm:
        began = time.perf_counter()
        cells = drone.cells(1e-3 * size, SKIN_M)
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
        both = (single, at_centres(single, 1e-3 * size))
        solved = [[[solve(body, turn, chi) for turn in turns] for chi in contrasts] for body in both]
        channels.append(np.asarray(solved))
        counts.append(cells.count)
        volumes.append(float(np.sum(np.asarray(cells.fill) * np.asarray(cells.volumes))))
        progress(
            f"{size:g} mm: {cells.count} cells, {1e6 * volumes[-1]:.1f} cm^3 of material, "
            f"{time.perf_counter() - began:.0f} s"
        )
    channels = np.array(channels).swapaxes(0, 1)  # (fields at, size, permittivity, pose, N_b, N_b)
    finest = channels[0, -1]
    norm = np.linalg.norm(finest, axis=(-2, -1))
    plain = np.linalg.norm(channels - finest, axis=(-2, -1)) / norm
    gain = np.sum(channels.conj() * finest, axis=(-2, -1)) / np.linalg.norm(channels, axis=(-2, -1)) ** 2
    shape = np.linalg.norm(gain[..., None, None] * channels - finest, axis=(-2, -1)) / norm
    rms = [np.sqrt(np.mean(value**2, axis=-1)) for value in (plain, shape)]
    for kind, difference, free in zip(SITES, *rms):
        for size, row, apart in zip(sizes_mm, difference, free):
            progress(
                f"fields at the {kind}, {size:g} mm: "
                + ", ".join(
                    f"permittivity {value:g}: {off:.1%} ({left:.1%} but for a gain)"
                    for value, off, left in zip(PERMITTIVITIES, row, apart)
                )
            )
    return {
        "sizes_mm": np.array(sizes_mm),
        "cells": np.array(counts),
        "material_m3": np.array(volumes),
        "permittivities": np.array(PERMITTIVITIES),
        "difference": rms[0],
        "but_for_a_gain": rms[1],
    }


def at_centres(cells, edge_m: float):
    """The same cells, heard and coupled at the centres of the lattice."""
    return cells._replace(positions=jnp.round(cells.positions / edge_m) * edge_m, centroids=None)


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Differences over cell size, one line a permittivity."""
    fig = new_figure(11.0, 4.6)
    axes = fig.subplots(1, 2, sharey=True)
    sizes = results["sizes_mm"]
    for axis, name, title in zip(axes, ("difference", "but_for_a_gain"), ("as it is", "but for one complex factor")):
        for at, (kind, line) in enumerate(zip(SITES, ("-", "--"))):
            shown = slice(None, -1) if at == 0 else slice(None)
            for index, value in enumerate(results["permittivities"]):
                axis.plot(
                    sizes[shown],
                    100 * results[name][at, shown, index],
                    line,
                    marker="o",
                    color=f"C{index}",
                    label=f"permittivity {value:g}, {kind}",
                )
        axis.set(xlabel="cell [mm]", title=title, ylim=(0, None))
        axis.grid(True, alpha=0.3)
    axes[0].set_ylabel(f"difference of H to that of {results['sizes_mm'][-1]:g} mm cells [%]")
    axes[0].legend(fontsize=9)
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "convergence", compute, draw)
