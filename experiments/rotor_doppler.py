"""What turning rotors do to the echo of a drone: micro-Doppler by flashes and by lines, and range over Doppler.

    python experiments/rotor_doppler.py compute [--small]     writes experiments/results/rotor_doppler.npz
    python experiments/rotor_doppler.py draw                  reads it, writes experiments/results/rotor_doppler.png

A quad_x of 0.25 m half-wheelbase hovers 12 m from one horizontal antenna, or comes nearer at 10 m/s; its four rotors
turn at 83 to 97 turns a second, each its own way. The hull and every rotor are factored bodies; scattering between them
is single. What that leaves out is measured beside, by coupled solves of the whole craft at some angles of its rotors
(without the cells of hubs that lie in the motors). Conductivity is that of plastic; closed forms: 2 v/lambda for the
hull, 2 (2 pi f a) cos(elevation)/lambda for the tips, blades x turns a second for the flashes.
"""

from __future__ import annotations

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.physics import (
    AntennaArray,
    Cells,
    Spinning,
    contrast,
    doppler_shift,
    factor_body,
    looking,
    range_doppler,
    scattering_matrix,
    slow_time_channels,
    spectrogram,
)
from august_jax.progress import Progress
from august_jax.scene import procedural_airframe, rotation_from_euler, rotorcraft

CARRIER, PLACE = 3e9, np.array([0.0, 11.0, 5.0])
MATERIAL = (3.0, 5e-3)
RATES_HZ = np.array([90.0, 97.0, 83.0, 93.0])
SPEED = 10.0
SKIN_M = 0.002


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """Slow-time series and what single scattering leaves out."""
    cell_m, blade_m, pulses, angles = (0.03, 0.02, 256, 2) if small else (0.016, 0.01, 2048, 8)
    tones = np.array([2.95e9, 3.05e9]) if small else np.linspace(2.9e9, 3.1e9, 6)
    parts = rotorcraft(procedural_airframe("quad_x", 0.25))
    turn = np.asarray(rotation_from_euler(0.05, 0.03, 0.4), float)
    antenna = AntennaArray(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), CARRIER)
    interval = 1e-4
    times = np.arange(pulses) * interval
    hull, rotors = parts.hull.cells(cell_m, SKIN_M), [each.cells(blade_m, SKIN_M) for each in parts.rotors]

    def series(frequencies, moving, times):
        made = [
            factor_body(cells, frequencies, nearest_m=5.0, cache=frequencies == CARRIER) for cells in (hull, *rotors)
        ]
        spinning = [
            Spinning(body, centre, hand * rate, phase)
            for body, centre, hand, rate, phase in zip(
                made[1:], parts.centres_m, parts.hands, RATES_HZ, (0.0, 0.5, 1.1, 1.7)
            )
        ]
        away = PLACE / np.linalg.norm(PLACE)
        chi = np.asarray([complex(contrast(*MATERIAL, each)) for each in np.atleast_1d(frequencies)])
        found = slow_time_channels(
            made[0],
            spinning,
            antenna,
            turn,
            PLACE,
            times,
            chi if np.ndim(frequencies) else complex(chi[0]),
            velocity_m_s=-SPEED * away * moving,
        )
        return np.asarray(found)[..., 0, 0]

    began = time.perf_counter()
    hovering = series(CARRIER, 0.0, times)
    progress(f"{pulses} pulses, hovering: {time.perf_counter() - began:.0f} s")
    began = time.perf_counter()
    slow = np.arange(pulses // 8) * 8 * interval  # the hull's speed needs no more
    approaching = series([float(each) for each in tones], 1.0, slow)
    progress(f"{len(slow)} pulses at {len(tones)} tones, approaching: {time.perf_counter() - began:.0f} s")
    left_out, added = neglected(parts, cell_m, angles, progress)
    return {
        "interval_s": np.array(interval),
        "hovering": hovering,
        "approaching": approaching,
        "approaching_interval_s": np.array(8 * interval),
        "tones_hz": tones,
        "rates_hz": RATES_HZ,
        "blades": parts.blades,
        "radii_m": parts.radii_m,
        "left_out": left_out,
        "added": added,
    }


def neglected(parts, cell_m: float, angles: int, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """Scattering matrices (angle, look, 2, 2) [m] of what single scattering leaves out, and of what rotors add."""
    chi = complex(contrast(*MATERIAL, CARRIER))
    looks = jnp.asarray(looking(np.array([0.0, 30.0, 60.0, 100.0, 150.0]), np.array([-10.0, -30.0, -20.0, -45.0, 0.0])))
    hull, rotors = parts.hull.cells(cell_m, SKIN_M), [each.cells(cell_m, SKIN_M) for each in parts.rotors]
    tree = cKDTree(hull.positions)

    def solved(cells):
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
        return np.asarray(scattering_matrix(single, looks.astype(jnp.float32), chi, frequency_hz=CARRIER))

    alone = solved(hull)
    left_out, added = [], []
    for angle in np.linspace(0.0, np.pi, angles, endpoint=False):
        moved = []
        for cells, centre, hand in zip(rotors, parts.centres_m, parts.hands):
            turned = cells.moved(np.asarray(rotation_from_euler(0.0, 0.0, hand * angle), float), centre)
            free = tree.query(np.asarray(turned.positions))[0] > 0.5 * cell_m
            moved.append(Cells(*(np.asarray(part)[free] for part in turned)))
        every = [hull, *moved]
        whole = solved(
            Cells(
                *(
                    np.concatenate([np.asarray(part) for part in column])
                    for column in zip(*((c.positions, c.volumes, c.fractions(), c.tensors(), c.sites()) for c in every))
                )
            )
        )
        left_out.append(whole - alone - sum(solved(cells) for cells in moved))
        added.append(whole - alone)
        progress(
            f"rotors at {np.degrees(angle):.0f} degrees: single scattering leaves out "
            f"{np.linalg.norm(left_out[-1]) / np.linalg.norm(added[-1]):.0%} of what rotors add, "
            f"{np.linalg.norm(left_out[-1]) / np.linalg.norm(whole):.0%} of the echo"
        )
    return np.array(left_out), np.array(added)


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Flashes, lines, and range over Doppler."""
    fig = new_figure(15.0, 4.8)
    flashes, lines, ranges = fig.subplots(1, 3)
    interval, series = float(results["interval_s"]), results["hovering"]
    level = PLACE[1] / np.linalg.norm(PLACE)
    tip = [
        float(doppler_shift(2.0 * np.pi * rate * radius * level, CARRIER))
        for rate, radius in zip(results["rates_hz"], results["radii_m"])
    ]
    length = len(series) * interval
    for axis, window, title in ((flashes, 0.0035, "short windows: flashes"), (lines, length / 3.0, "long: lines")):
        picture = spectrogram(series, interval, window_s=window, hop_s=max(interval, window / 12.0))
        power = 20.0 * np.log10(np.maximum(np.abs(picture.values), 1e-12))
        top = power.max()
        drawn = axis.pcolormesh(
            1e3 * picture.across, picture.doppler_hz, power - top, vmin=-60, vmax=0, cmap="viridis", shading="nearest"
        )
        for edge in (max(tip), -max(tip)):
            axis.axhline(edge, color="white", lw=0.8, ls="--")
        axis.set(xlabel="time [ms]", title=title, ylim=(-1.6 * max(tip), 1.6 * max(tip)))
    flashes.set_xlim(0.0, min(1e3 * length, 60.0))
    flashes.set_ylabel("Doppler shift [Hz], approaching above")
    fig.colorbar(drawn, ax=[flashes, lines], label="dB of the strongest")
    picture = range_doppler(results["approaching"], float(results["approaching_interval_s"]), results["tones_hz"])
    power = 20.0 * np.log10(np.maximum(np.abs(picture.values.T), 1e-12))
    drawn = ranges.pcolormesh(
        picture.doppler_hz, picture.across, power - power.max(), vmin=-60, vmax=0, cmap="viridis", shading="nearest"
    )
    ranges.axvline(float(doppler_shift(SPEED, CARRIER)), color="white", lw=0.8, ls="--")
    ranges.set(xlabel="Doppler shift [Hz]", ylabel="range, folded [m]", title=f"approaching at {SPEED:g} m/s")
    fig.colorbar(drawn, ax=ranges, label="dB of the strongest")
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "rotor_doppler", compute, draw)
