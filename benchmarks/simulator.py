"""Channels per second of the factored body, against the dense solve of the same system, in one run.

    python benchmarks/simulator.py --json simulator.json

Prints a table and writes JSON: for each airframe-like body, the time of one channel through ``sensing_channel``
("mom": jitted assembly and ``jnp.linalg.solve`` in complex64), the time of one channel of a batch
through ``body_channel``, their ratio, and the error of both against the same solve in complex128. The two are timed in turn, and
the medians are compared. About 4 minutes on two cores for the default size, most of it factoring.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics import PlanarArray, body_channel, contrast, factor_body, sensing_channel
from august_jax.scene import procedural_airframe, random_rotation


def machine() -> dict[str, str | int]:
    """What the figures were measured on."""
    return {
        "processor": platform.processor() or platform.machine(), "cores": len(os.sched_getaffinity(0)),
        "device": jax.devices()[0].device_kind, "jax": jax.__version__, "python": platform.python_version(),
    }


def seconds(call) -> float:
    """Wall time of one call that returns arrays."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def measure(name: str, cell_m: float, distance_m: float, batch: int, repeats: int) -> dict:
    """One row: a procedural airframe at ``distance_m``, permittivity 3."""
    array = PlanarArray(16, 4, 3e9)
    cells = procedural_airframe(name).cells(cell_m, 0.002)
    start = time.perf_counter()
    body = factor_body(cells, array.frequency_hz, nearest_m=0.9 * distance_m)
    factoring = time.perf_counter() - start
    keys = jax.random.split(jax.random.key(0), batch)
    rotations = jax.vmap(random_rotation)(keys)
    toward = jnp.asarray([0.6, 0.64, 0.48])
    places = distance_m * toward + jax.vmap(lambda key: jax.random.uniform(key, (3,), minval=-0.5, maxval=0.5))(keys)
    chi = contrast(3.0, 5e-3, array.frequency_hz).astype(jnp.complex64)

    fast = jax.jit(jax.vmap(lambda turn, place: body_channel(body, array, turn, place, chi)))
    plain = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
    dense = jax.jit(lambda turn, place: sensing_channel(array, plain.moved(turn, place), chi))
    channels, one = fast(rotations, places), dense(rotations[0], places[0])
    with jax.enable_x64(True):
        turn, place = (np.asarray(part[0], np.float64) for part in (rotations, places))
        moved = cells.moved(jnp.asarray(turn), jnp.asarray(place))
        exact = np.asarray(sensing_channel(array, moved, complex(chi)))
    times = {"dense": [], "factored": []}
    for _ in range(repeats):
        times["dense"].append(seconds(lambda: dense(rotations[0], places[0])))
        times["factored"].append(seconds(lambda: fast(rotations, places)) / batch)
    dense_s, factored_s = (float(np.median(times[kind])) for kind in ("dense", "factored"))

    def error(channel):
        return float(np.linalg.norm(np.asarray(channel) - exact) / np.linalg.norm(exact))

    return {
        "airframe": name, "cells": cells.count, "antennas": array.count, "batch": batch, "distance_m": distance_m,
        "factoring_or_cache_s": factoring, "dense_s": dense_s, "factored_s": factored_s, "ratio": dense_s / factored_s,
        "dense_error": error(one), "factored_error": error(channels[0]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--airframes", nargs="+", default=["quad_x"])
    parser.add_argument("--cell-mm", type=float, default=12.0)
    parser.add_argument("--distance", type=float, nargs="+", default=[7.0, 20.0], help="metres")
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    about = machine()
    print(about)
    print("airframe      cells  place [m]  dense [ms]  factored [ms]   ratio  dense error  factored error")
    rows = []
    for name in args.airframes:
        for distance in args.distance:
            row = measure(name, args.cell_mm / 1e3, distance, args.batch, args.repeats)
            rows.append(row)
            print(f"{name:12s}  {row['cells']:5d}  {distance:9.0f}  {1e3 * row['dense_s']:10.0f}"
                  f"  {1e3 * row['factored_s']:13.2f}"
                  f"  {row['ratio']:6.0f}  {row['dense_error']:11.1e}  {row['factored_error']:14.1e}", flush=True)
    if args.json:
        args.json.write_text(json.dumps({"machine": about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
