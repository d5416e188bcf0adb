"""Refining a pose from an estimated channel by gradients: where it converges, and where the phase's period stops it.

    python experiments/refine_pose.py compute [--small]     writes experiments/results/refine_pose.npz
    python experiments/refine_pose.py draw                  reads it, writes experiments/results/refine_pose.png

A known airframe, one tone, 16 x 4 antennas, an estimated channel at 30 dB. Levenberg-Marquardt descends

    |H_est - g H(place, attitude)|^2 / |H_est|^2

in place and attitude, from many starts about the truth, with the complex gain g either known (g = 1) or fitted in
closed form. A known gain makes range count by its phase, which repeats every half wavelength (5 cm): the descent ends
in the nearest valley, a wrong one beyond 2.5 cm. A fitted gain leaves one wide valley, whose floor is the bound of
august_jax.physics.information.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.config import preset
from august_jax.physics import (
    Parameters,
    PlanarArray,
    factor_body,
    fisher_information,
    parameter_channel,
    position_bound,
)
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler
from august_jax.signal import observe

PLACE = np.array([3.0, 4.5, 2.5])
ANGLES = np.array([0.15, -0.2, 0.7])
PERMITTIVITY, CONDUCTIVITY, SNR_DB = 3.0, 5e-3, 30.0
SCALES = np.array([0.05, 0.05, 0.05, 0.1, 0.1, 0.1])
"""Steps of unit size in place [m] and in a rotation vector [rad]."""


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Valleys along the line of sight, and errors before and after the descent from every start."""
    config = preset("laptop")
    cell_m, starts, steps = (0.03, 24, 30) if small else (0.016, 192, 60)
    array = PlanarArray(16, 4, 3e9)
    cells = procedural_airframe("quad_x", half_wheelbase_m=0.25).cells(cell_m, 0.002)
    progress(f"quad_x: {cells.count} cells; {starts} starts of {steps} steps, with the gain known and fitted")
    body = factor_body(cells, 3e9, nearest_m=4.0)
    turn0 = jnp.asarray(rotation_from_euler(*ANGLES), jnp.float32)
    place0 = jnp.asarray(PLACE, jnp.float32)

    def channel(scaled):
        step = SCALES * scaled
        away = Parameters(step[:3], step[3:])
        return parameter_channel(body, array, away, turn0, place0, PERMITTIVITY, CONDUCTIVITY)

    truth = channel(jnp.zeros(6))
    seen = observe(
        jax.random.key(0), truth, place0, array=config.array, signal=config.signal, region=config.region, snr_db=SNR_DB
    ).estimated_channel
    seen = seen / jnp.linalg.norm(truth)

    def misfit(theta, known):
        model = channel(theta) / jnp.linalg.norm(truth)
        fitted = jnp.vdot(model, seen) / jnp.vdot(model, model)
        rest = seen - jnp.where(known, 1.0, fitted) * model
        return jnp.concatenate([rest.real.ravel(), rest.imag.ravel()])

    @jax.jit
    def descend(start, known):
        def step(state, _):
            theta, damping = state
            rest, slope = misfit(theta, known), jax.jacfwd(misfit)(theta, known)
            normal = slope.T @ slope
            move = jnp.linalg.solve(normal + damping * jnp.diag(jnp.diag(normal) + 1e-9), slope.T @ rest)
            better = jnp.sum(misfit(theta - move, known) ** 2) < jnp.sum(rest**2)
            theta = jnp.where(better, theta - move, theta)
            return (theta, jnp.clip(jnp.where(better, damping / 3.0, damping * 4.0), 1e-7, 1e6)), jnp.sum(rest**2)

        (theta, _), path = jax.lax.scan(step, (start, jnp.float32(1e-2)), length=steps)
        return theta, path

    sight = PLACE / np.linalg.norm(PLACE)
    offsets = np.linspace(-0.2, 0.2, 161)
    along = jnp.asarray(offsets[:, None] * np.append(sight, [0, 0, 0]) / SCALES, jnp.float32)
    valleys = np.stack(
        [np.asarray(jax.lax.map(lambda t, known=k: jnp.sum(misfit(t, known) ** 2), along)) for k in (True, False)]
    )
    generator = np.random.default_rng(0)
    ways = generator.normal(size=(starts, 6))
    ways /= np.linalg.norm(ways[:, :3], axis=1, keepdims=True)
    reach = np.geomspace(0.005, 0.3, starts)
    begin = np.concatenate([reach[:, None] * ways[:, :3], 0.4 * reach[:, None] * ways[:, 3:]], axis=1) / SCALES
    ends, paths = [], []
    for known in (True, False):
        theta, path = jax.lax.map(partial(descend, known=known), jnp.asarray(begin, jnp.float32), batch_size=8)
        ends.append(np.asarray(theta) * SCALES)
        paths.append(np.asarray(path))
        good = np.linalg.norm(ends[-1][:, :3], axis=1) < 0.02
        progress(
            f"gain {'known' if known else 'fitted'}: {good.mean():.0%} of the starts end within 2 cm, "
            f"the farthest of them from {100 * reach[good].max() if good.any() else 0:.0f} cm"
        )
    information = fisher_information(
        body, array, np.asarray(turn0), PLACE, PERMITTIVITY, CONDUCTIVITY, 10 ** (SNR_DB / 10)
    )
    return {
        "offsets_m": offsets,
        "valleys": valleys,
        "starts_m": reach,
        "ends": np.stack(ends),
        "paths": np.stack(paths),
        "sight": sight,
        "bound_m": position_bound(information),
    }


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Three panels: the valleys in range, errors after against before, and what multi-start picks."""
    fig = new_figure(15.0, 4.6)
    left, middle, right = fig.subplots(1, 3)
    for valley, label, color in zip(results["valleys"], ("gain known", "gain fitted"), ("#c8641b", "#0a6ebd")):
        left.semilogy(100 * results["offsets_m"], valley, label=label, color=color)
    left.set(xlabel="offset in range [cm]", ylabel="relative misfit", title="valleys along the line of sight")
    for end, label, color in zip(results["ends"], ("gain known", "gain fitted"), ("#c8641b", "#0a6ebd")):
        middle.loglog(
            100 * results["starts_m"], 100 * np.linalg.norm(end[:, :3], axis=1), ".", label=label, color=color
        )
    middle.axhline(100 * float(results["bound_m"]), color="0.4", ls="--", label="bound, gain unknown")
    middle.plot([0.5, 30], [0.5, 30], color="0.8", lw=1)
    middle.set(xlabel="distance of the start [cm]", ylabel="distance of the end [cm]", title="where descents end")
    for end, path_, label, color in zip(
        results["ends"], results["paths"], ("gain known", "gain fitted"), ("#c8641b", "#0a6ebd")
    ):
        right.loglog(path_[:, -1], 100 * np.linalg.norm(end[:, :3], axis=1), ".", label=label, color=color)
    right.set(
        xlabel="relative misfit at the end",
        ylabel="distance of the end [cm]",
        title="the misfit tells which start to believe",
    )
    for axis in (left, middle, right):
        axis.grid(True, which="both", alpha=0.3)
        axis.legend(fontsize=8)
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "refine_pose", compute, draw)
