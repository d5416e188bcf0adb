"""Which parts of a drone the channel hears: derivatives by cell, and channels with a part taken away.

    python experiments/sensitivity.py compute [--small]     writes experiments/results/sensitivity.npz
    python experiments/sensitivity.py draw                  reads it, writes experiments/results/sensitivity.png

Per cell: dH/dchi_i = k^2 q_i^T q_i with q_i the total fields in cell i (august_jax.physics.krylov), of which the norm
is drawn, relative to |H|. Per part: the relative change of H when its material is removed, by a new coupled solve.
Beside it the part's share of the material: what is heard is not what is large.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import PlanarArray, contrast, dipole_fields, interaction_matrix, sensing_channel, solve_krylov
from august_jax.physics.mom import weighted_fields
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler

PLACE = np.array([3.0, 4.5, 2.5])
PARTS = ("hull", "arms", "motors", "rotors", "gear")


def parts_of(positions: np.ndarray, rotors: np.ndarray, cell_m: float) -> np.ndarray:
    """Index into PARTS (N,) of cells at body-frame positions (N, 3) [m], by where they lie."""
    radius = np.linalg.norm(positions[:, :2], axis=1)
    beside = np.linalg.norm(positions[:, None, :2] - rotors[:, :2], axis=2).min(axis=1)
    above = positions[:, 2] - rotors[0, 2]
    part = np.ones(len(positions), int)
    part[radius < 0.4 * np.linalg.norm(rotors[0, :2])] = 0
    part[(beside < 0.02 + 0.5 * cell_m) & (above > -0.045)] = 2
    part[(above > -0.5 * cell_m) & (beside < 0.14) & ~((beside < 0.01) & (above < 0))] = 3
    part[positions[:, 2] < -0.035] = 4
    return part


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Sensitivities of the cells (N,) and of the parts (P,), root mean squares over attitudes."""
    cell_m, poses = (0.022, 3) if small else (0.012, 12)
    array = PlanarArray(16, 4, 3e9)
    drone = procedural_airframe("quad_x", half_wheelbase_m=0.25)
    cells = drone.cells(cell_m, 0.002)
    part = parts_of(cells.positions, drone.rotor_axes_m, cell_m)
    progress(
        f"quad_x: {cells.count} cells of {1e3 * cell_m:g} mm, {poses} attitudes; cells of "
        + ", ".join(f"{name}: {np.sum(part == index)}" for index, name in enumerate(PARTS))
    )
    chi = contrast(3.0, 5e-3, 3e9).astype(jnp.complex64)
    single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
    generator = np.random.default_rng(0)
    k = array.wavenumber

    @jax.jit
    def by_cell(turn):
        moved = single.moved(turn, jnp.asarray(PLACE, jnp.float32))
        fields = weighted_fields(
            moved,
            dipole_fields(moved.sites(), jnp.asarray(array.positions, jnp.float32), jnp.asarray([0.0, 0.0, 1.0]), k),
        )
        solution = solve_krylov(interaction_matrix(moved, k), chi, fields)
        total = (solution.fields @ solution.combinations.conj().T).reshape(moved.count, 3, -1)
        gram = jnp.einsum("nam,nbm->nab", total, total.conj())
        return k**2 * jnp.sqrt(jnp.real(jnp.einsum("nab,nab->n", gram, gram.conj())))

    @jax.jit
    def channel(turn, present):
        return sensing_channel(
            array, single.moved(turn, jnp.asarray(PLACE, jnp.float32)), chi * present, solver="krylov"
        )

    cell_values, part_values = [], []
    for pose in range(poses):
        angles = np.append(np.deg2rad(generator.uniform(-20, 20, 2)), generator.uniform(-np.pi, np.pi))
        turn = jnp.asarray(rotation_from_euler(*angles), jnp.float32)
        whole = channel(turn, jnp.ones(cells.count))
        size = jnp.linalg.norm(whole)
        cell_values.append(np.asarray(by_cell(turn) / size))
        without = [channel(turn, jnp.asarray(part != index, jnp.float32)) for index in range(len(PARTS))]
        part_values.append([float(jnp.linalg.norm(whole - each) / size) for each in without])
        progress(
            f"attitude {pose + 1}/{poses}: "
            + ", ".join(f"{name} {value:.0%}" for name, value in zip(PARTS, part_values[-1]))
        )
    material = np.asarray(cells.fill) * np.asarray(cells.volumes)
    return {
        "positions": np.asarray(cells.positions),
        "part": part,
        "cells": np.sqrt(np.mean(np.square(cell_values), axis=0)),
        "parts": np.sqrt(np.mean(np.square(part_values), axis=0)),
        "share": np.array([material[part == index].sum() for index in range(len(PARTS))]) / material.sum(),
    }


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Top and side view coloured by sensitivity, and the parts as bars."""
    fig = new_figure(15.0, 4.8)
    top, side, bars = fig.subplots(1, 3)
    level = 20.0 * np.log10(results["cells"] / results["cells"].max())
    order = np.argsort(level)
    x, y, z = 100 * results["positions"][order].T
    for axis, across, label in ((top, y, "y [cm]"), (side, z, "z [cm]")):
        dots = axis.scatter(x, across, c=level[order], s=14, cmap="inferno", vmin=-30, vmax=0)
        axis.set(xlabel="x [cm]", ylabel=label, aspect="equal")
    top.set_title("|dH/dchi| of each cell, from above")
    side.set_title("and from the side")
    fig.colorbar(dots, ax=[top, side], label="dB of the largest", shrink=0.8)
    places = np.arange(len(PARTS))
    bars.bar(places - 0.2, 100 * results["parts"], 0.4, color="#0a6ebd", label="change of H without it")
    bars.bar(places + 0.2, 100 * results["share"], 0.4, color="#c8a96b", label="share of the material")
    bars.set(xticks=places, xticklabels=PARTS, ylabel="per cent", title="parts")
    bars.legend(fontsize=9)
    bars.grid(True, axis="y", alpha=0.3)
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "sensitivity", compute, draw)
