"""What it would bring to integrate the coupling of near cells over their extent, in place of from point to point.

    python experiments/near_coupling.py compute [--small]     writes experiments/results/near_coupling.npz
    python experiments/near_coupling.py draw                  reads it, writes experiments/results/near_coupling.png

The craft, attitudes, place, materials and finest lattice are those of experiments/convergence.py. In the coarser ones
Green's function between cells within two edges of each other is averaged over the cubes of both by Gauss's rule of
three points an axis; all else stays as august_jax.physics.mom has it. Both are compared with the finest lattice,
coupled from point to point: with small cells the two ways tend to the same. Some ten minutes on two cores.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from convergence import PERMITTIVITIES, PLACE, SKIN_M
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import PlanarArray, contrast, sensing_channel, wavenumber
from august_jax.physics.cells import Cells
from august_jax.physics.green import dipole_fields, dyadic_green
from august_jax.physics.mom import interaction_matrix, solve_dense, weighted_fields
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler

WAYS = ("from point to point", "over cubes")
NEAR = 2.0  # edges
POINTS = 3  # of Gauss's rule, an axis
FREQUENCY = 3e9


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Relative differences to the finest lattice (way, size, permittivity), root mean squares over attitudes."""
    sizes_mm, finest_mm, poses = ((20.0, 14.0), 10.0, 1) if small else ((14.0, 10.0, 7.0), 4.0, 4)
    array = PlanarArray(16, 4, FREQUENCY)
    drone = procedural_airframe("quad_x", half_wheelbase_m=0.15)
    generator = np.random.default_rng(0)
    tilts_deg, headings = zip(
        *((generator.uniform(-20, 20, 2), generator.uniform(-np.pi, np.pi)) for _ in range(poses))
    )
    turns = np.asarray(rotation_from_euler(*np.deg2rad(tilts_deg).T, np.array(headings)), np.float32)
    contrasts = [complex(contrast(permittivity, 5e-3, FREQUENCY)) for permittivity in PERMITTIVITIES]

    def moved(cells: Cells, turn: np.ndarray) -> Cells:
        return single(cells.moved(jnp.asarray(turn), jnp.asarray(PLACE, jnp.float32)))

    fine = drone.cells(1e-3 * finest_mm, SKIN_M)
    began = time.perf_counter()
    wanted = np.array(
        [[sensing_channel(array, moved(fine, turn), chi, solver="krylov") for turn in turns] for chi in contrasts]
    )
    progress(f"{finest_mm:g} mm: {fine.count} cells, {time.perf_counter() - began:.0f} s")
    found, counts = np.empty((len(WAYS), len(sizes_mm), *wanted.shape), np.complex64), []
    for row, size in enumerate(sizes_mm):
        began, edge = time.perf_counter(), 1e-3 * size
        cells = drone.cells(edge, SKIN_M)
        counts.append(cells.count)
        # a matrix knows the geometry alone: it turns with the craft, and fields are turned back in its place
        own = single(cells)
        matrices = interaction_matrix(own, wavenumber(FREQUENCY)), integrated(own, edge)
        for way, matrix in enumerate(matrices):
            for pose, turn in enumerate(turns):
                fields = weighted_fields(own, seen_from(array, own, turn))
                for value, chi in enumerate(contrasts):
                    found[way, row, value, pose] = channel(matrix, chi, fields)
        progress(f"{size:g} mm: {cells.count} cells, {time.perf_counter() - began:.0f} s")
    apart = np.linalg.norm(found - wanted, axis=(-2, -1)) / np.linalg.norm(wanted, axis=(-2, -1))
    difference = np.sqrt(np.mean(apart**2, axis=-1))
    for way, of_way in zip(WAYS, difference):
        for size, errors in zip(sizes_mm, of_way):
            told = ", ".join(f"permittivity {value:g}: {error:.1%}" for value, error in zip(PERMITTIVITIES, errors))
            progress(f"{way}, {size:g} mm: {told}")
    return {
        "ways": np.array(WAYS),
        "sizes_mm": np.array(sizes_mm),
        "finest_mm": np.array(finest_mm),
        "cells": np.array(counts),
        "permittivities": np.array(PERMITTIVITIES),
        "difference": difference,
    }


def single(cells: Cells) -> Cells:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)


def seen_from(array: PlanarArray, cells: Cells, turn: np.ndarray) -> jax.Array:
    """The antennas' fields (3N, N_b) at a craft that stands still, the antennas turned about it."""
    places = (array.positions - PLACE) @ turn
    return dipole_fields(
        cells.sites(), jnp.asarray(places, jnp.float32), jnp.asarray(array.moments @ turn), wavenumber(FREQUENCY)
    )


@jax.jit
def channel(matrix, chi, fields):
    found = wavenumber(FREQUENCY) ** 2 * fields.T @ solve_dense(matrix, chi, fields).polarization
    return 0.5 * (found + found.T)


def integrated(cells: Cells, edge_m: float) -> jax.Array:
    """K' (3N, 3N) of :func:`august_jax.physics.mom.interaction_matrix`, near pairs averaged over their cubes."""
    k = wavenumber(FREQUENCY)
    matrix = np.array(interaction_matrix(cells, k))
    centres = np.round(np.asarray(cells.positions) / edge_m) * edge_m
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    first, second = np.nonzero((apart > 0.5 * edge_m) & (apart < (NEAR + 1e-3) * edge_m))
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    nodes, weights = 0.5 * edge_m * nodes, 0.5 * weights
    shifts = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    shares = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
    steps = (shifts[:, None] - shifts).reshape(-1, 3).astype(np.float32)
    share = np.outer(shares, shares).ravel().astype(np.float32)

    @partial(jax.jit, static_argnums=0)
    def averaged(k, displacements):
        def one(displacement):
            return jnp.einsum("p,pab->ab", share, dyadic_green(displacement + steps, k))

        return jax.lax.map(one, displacements, batch_size=256)

    # on a lattice there are few displacements
    between = np.round((centres[first] - centres[second]) / edge_m).astype(int)
    each, which = np.unique(between, axis=0, return_inverse=True)
    means = np.asarray(averaged(k, jnp.asarray(edge_m * each, jnp.float32)))
    weight = k * np.sqrt(np.asarray(cells.fractions()) * np.asarray(cells.volumes))
    blocks = matrix.reshape(len(centres), 3, len(centres), 3)
    blocks[first, :, second, :] = (weight[first] * weight[second])[:, None, None] * means[which.ravel()]
    return jnp.asarray(matrix)


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Differences over cell size, one line a permittivity and way."""
    figure = new_figure(7.5, 4.6)
    axis = figure.subplots()
    for way, line in zip(range(len(WAYS)), ("-", "--")):
        for index, value in enumerate(results["permittivities"]):
            axis.plot(
                results["sizes_mm"],
                100 * results["difference"][way, :, index],
                line,
                marker="o",
                color=f"C{index}",
                label=f"permittivity {value:g}, {WAYS[way]}",
            )
    axis.axhline(5.0, color="0.5", lw=0.9, ls=":")
    axis.set(
        xlabel="cell [mm]",
        ylabel=f"difference of H to that of {results['finest_mm']:g} mm cells [%]",
        ylim=(0, None),
        title="coupling of near cells",
    )
    axis.grid(True, alpha=0.3)
    axis.legend(fontsize=9)
    save(figure, path)


if __name__ == "__main__":
    run(__doc__, "near_coupling", compute, draw)
