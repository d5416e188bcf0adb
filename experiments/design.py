"""Designing an array by descending the bound: where should sixteen antennas stand to locate a drone?

    python experiments/design.py compute [--small]     writes experiments/results/design.npz
    python experiments/design.py draw                  reads it, writes experiments/results/design.png

The bound on the position error (unknown attitude, material and complex gain) is differentiated in the antennas' places,
which move within a square aperture, no two nearer than half a wavelength, until it stops falling. It is measured on
poses that the descent has not seen, beside arrays that one would build without it. A bound knows the neighbourhood
of the truth alone: the last panel shows what the descent does not see, how alike the channels of places farther away
are (ambiguity).
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import (
    AntennaArray,
    PlanarArray,
    body_channel,
    contrast,
    factor_body,
    unknown_gain_position_bound,
)
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler

FREQUENCY = 3e9
HALF_M = 0.4  # the aperture: |x| and |z| at most this
HALF_WAVE_M = 0.05
SNR = 10.0
CENTRE = np.array([2.0, 5.0, 1.5])
PERMITTIVITY, CONDUCTIVITY = 3.0, 5e-3
SIDE = 4


def arrays(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Places (16, 2) in the aperture, x and z [m], of the arrays to compare."""
    half_wave = PlanarArray(SIDE, SIDE, FREQUENCY).positions[:, [0, 2]]
    angle = 2.0 * np.pi * np.arange(SIDE**2) / SIDE**2
    return {
        "half-wave grid": half_wave,
        "grid over the aperture": half_wave * HALF_M / np.abs(half_wave).max(),
        "random": generator.uniform(-HALF_M, HALF_M, (SIDE**2, 2)),
        "circle": HALF_M * np.stack([np.cos(angle), np.sin(angle)], -1),
    }


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Places and bounds of the arrays, the course of the descent, and ambiguity over range and cross-range."""
    cell_m, seen, unseen, steps, cuts = (0.035, 6, 12, 60, 61) if small else (0.02, 16, 48, 200, 121)
    body = factor_body(procedural_airframe("quad_x").cells(cell_m, 0.002), FREQUENCY)
    progress(f"quad_x: {body.cells} cells of {1e3 * cell_m:g} mm; {seen} poses to descend on, {unseen} to measure on")
    generator = np.random.default_rng(0)

    def poses(count):
        tilt = np.deg2rad(generator.uniform(-20.0, 20.0, (2, count)))
        turns = np.asarray(rotation_from_euler(*tilt, generator.uniform(-np.pi, np.pi, count)))
        return jnp.asarray(turns, jnp.float32), jnp.asarray(CENTRE + generator.uniform(-1, 1, (count, 3)), jnp.float32)

    training, held_out = poses(seen), poses(unseen)
    moments = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (SIDE**2, 1))

    def antennas(plane):
        positions = jnp.stack([plane[:, 0], jnp.zeros(len(plane)), plane[:, 1]], -1)
        return AntennaArray(positions, moments, FREQUENCY)

    def bounds(plane, turns, places):  # [m], of each pose
        array = antennas(plane)
        return jax.lax.map(
            lambda pose: unknown_gain_position_bound(body, array, *pose, PERMITTIVITY, CONDUCTIVITY, SNR),
            (turns, places),
        )

    def root_mean_square(plane, turns, places):
        return jnp.sqrt(jnp.mean(bounds(plane, turns, places) ** 2))

    measure = jax.jit(root_mean_square)

    def crowding(plane):  # antennas nearer than half a wavelength would couple, which point dipoles do not know
        gap = jnp.sqrt(jnp.sum((plane[:, None] - plane) ** 2, -1) + jnp.eye(len(plane)))
        return jnp.sum(jnp.maximum(1.0 - gap / HALF_WAVE_M, 0.0) ** 2)

    def objective(plane):
        bound = root_mean_square(plane, *training)
        return jnp.log(bound) + crowding(plane), bound

    slope = jax.jit(jax.value_and_grad(objective, has_aux=True))
    optimizer = optax.adam(optax.cosine_decay_schedule(0.03, steps))
    plane = jnp.asarray(arrays(generator)["random"], jnp.float32)
    chosen = arrays(np.random.default_rng(1))
    state, course = optimizer.init(plane), []
    for step in range(steps):
        (_, value), gradient = slope(plane)
        course.append(float(value))
        change, state = optimizer.update(gradient, state)
        plane = jnp.clip(plane + change, -HALF_M, HALF_M)
        if step % max(steps // 5, 1) == 0:
            progress(f"step {step}/{steps}: {1e2 * course[-1]:.2f} cm")
    chosen["descended"] = np.asarray(plane)
    table = {name: float(measure(jnp.asarray(places, jnp.float32), *held_out)) for name, places in chosen.items()}
    progress("bound on poses not seen: " + ", ".join(f"{name} {1e2 * value:.2f} cm" for name, value in table.items()))

    chi = contrast(PERMITTIVITY, CONDUCTIVITY, FREQUENCY).astype(jnp.complex64)
    toward = CENTRE / np.linalg.norm(CENTRE)
    across = np.cross(toward, [0.0, 0.0, 1.0])
    shifts = np.linspace(-0.5, 0.5, cuts)

    @jax.jit
    def likeness(plane, axis):
        channel = jax.vmap(lambda place: body_channel(body, antennas(plane), jnp.eye(3), place, chi))
        shifted = channel(jnp.asarray(CENTRE + shifts[:, None] * axis, jnp.float32))
        here = channel(jnp.asarray(CENTRE, jnp.float32)[None])[0]
        match = jnp.abs(jnp.einsum("smn,mn->s", shifted, here.conj()))
        return match / jnp.linalg.norm(here) / jnp.linalg.norm(shifted, axis=(1, 2))

    cut = [
        [np.asarray(likeness(jnp.asarray(places, jnp.float32), axis)) for axis in (toward, across)]
        for places in chosen.values()
    ]
    return {
        "names": np.array(list(chosen)),
        "places_m": np.stack(list(chosen.values())),
        "course_m": np.array(course),
        "bounds_m": np.array(list(table.values())),
        "shifts_m": shifts,
        "likeness": np.array(cut),
    }


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """The arrays, the descent beside the arrays' bounds, and ambiguity along and across the line of sight."""
    names, colours = list(results["names"]), ["0.55", "#c8a96b", "#b56576", "#6d597a", "#0a6ebd"]
    fig = new_figure(15.0, 8.0)
    axes = fig.subplots(2, 2)
    for name, colour, places, bound in zip(names, colours, results["places_m"], results["bounds_m"]):
        last = name == "descended"
        axes[0, 0].scatter(
            *(100 * places.T),
            s=60 if last else 25,
            color=colour,
            label=name,
            zorder=3 if last else 2,
            edgecolors="k" if last else "none",
        )
        axes[0, 1].axhline(100 * bound, color=colour, ls="-" if last else "--", label=f"{name}: {100 * bound:.2g} cm")
    axes[0, 0].set(xlabel="x [cm]", ylabel="z [cm]", aspect="equal", title="sixteen antennas in an aperture")
    axes[0, 1].plot(100 * results["course_m"], color="k", label="descent, on its own poses")
    axes[0, 1].set(
        xlabel="step",
        ylabel="bound on the position error [cm]",
        yscale="log",
        title=f"bound at {10 * np.log10(SNR):.0f} dB (lines: poses not seen)",
    )
    for axis, cut, title in zip(axes[1], range(2), ("along the line of sight", "across it")):
        for name, colour, curves in zip(names, colours, results["likeness"]):
            axis.plot(100 * results["shifts_m"], curves[cut], color=colour, lw=2 if name == "descended" else 1.2)
        axis.set(
            xlabel="shift of the drone [cm]",
            ylabel="likeness of the channels",
            title=f"ambiguity {title}",
            ylim=(0, 1.02),
        )
    for axis in axes.flat:
        axis.grid(True, alpha=0.3)
    axes[0, 0].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))
    axes[0, 1].legend(fontsize=8)
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "design", compute, draw)
