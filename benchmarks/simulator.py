"""The simulator's speed, each figure beside its peers in the same run and beside its error.

    python benchmarks/simulator.py --json simulator.json
    python benchmarks/simulator.py --parts rigid moving                      only some of the parts below
    python benchmarks/simulator.py --cells 200 --sweep 100 200 --batch 8 --preset smoke --count 64 --repeats 1
                                                                             a minute, to see that all parts run
    taskset -c 0 python benchmarks/simulator.py                              one core

Parts:

``rigid``
    one channel of a batch through ``body_channel``, against the same system solved by LU (jitted, complex64), by SciPy
    (assembly and ``scipy.linalg.solve``, complex64) and by torchgdm, a PyTorch implementation of the Green dyadic
    method, its simulation and ``postproc.green.G_Ep``.
``moving``
    value, and value and gradient in all cell positions, of one target through the Krylov solver, against LU and
    torchgdm.
``scaling``
    ``body_channel`` over cells, antennas and batch.
``set``
    channels of the paper's flights, five airframes (or of another preset's).
``precision``
    channels by factored body and by coupled solve as this device multiplies them when it is asked for all digits, as
    the package asks, and when it is left to its default, which on a GPU or TPU rounds factors; a processor gives the
    same twice.
``tables``
    the same flights' channels by table, all airframes in every batch, beside the time that factoring and tabulating (or
    reading both) takes and the tables' errors; best of batches of 128.

What is compared is timed in turn and by its median; errors are relative to LU in complex128. torchgdm is no
dependency: `pip install torchgdm==0.61` adds its columns, without it they stay empty. ``rigid`` and ``moving`` take a
few minutes on two cores; the others wait for bodies to be factored the first time, half a minute for 1000 cells, two
and a half minutes for 4000.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import time
import warnings
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from common import Figures, machine, medians, parsed, write

from august_jax.config import ArrayConfig, Config, TargetConfig, preset
from august_jax.data.simulator import (
    contrast_of,
    lattice_of,
    lattices_of,
    nearest_distance,
    simulated_channel,
    tabulate_targets,
)
from august_jax.physics import (
    Cells,
    PlanarArray,
    body_channel,
    dipole_fields,
    factor_bodies,
    factor_body,
    interaction_matrix,
    sensing_channel,
    stack_tables,
    table_channel,
)
from august_jax.physics.mom import weighted_fields
from august_jax.scene import random_rotation, resolve_airframe
from august_jax.scene.trajectory import fly_many

# Written out, not a preset's: figures of one release are compared with those of the next.
CONFIG = Config(
    array=ArrayConfig(nx=16, nz=4, frequency_hz=3e9),
    target=TargetConfig(airframes=("quad_x",), half_wheelbase_m=0.25, cell_m=0.004, skin_m=0.002),
)
PERMITTIVITY, CONDUCTIVITY = 3.0, 5e-3
FREQUENCY = CONFIG.array.frequency_hz
ARRAY = PlanarArray.from_config(CONFIG.array)
TOWARD = np.array([0.6, 0.64, 0.48])
CHI = complex(contrast_of(CONFIG, PERMITTIVITY, CONDUCTIVITY)[0])
PEER = importlib.util.find_spec("torchgdm") is not None


def lattice(cells: int) -> Cells:
    """quad_x in at most so many cells."""
    target = replace(CONFIG.target, max_cells=cells)
    made, _ = lattice_of(resolve_airframe(target.airframes[0], target.half_wheelbase_m), target)
    # One place a cell, so that a gradient in positions is that of the whole channel.
    return made._replace(centroids=None)


def poses(count: int, distance_m: float):
    """Random attitudes, and places within half a metre of one at the distance."""
    keys = jax.random.split(jax.random.key(0), count)
    shifts = jax.vmap(lambda key: jax.random.uniform(key, (3,), minval=-0.5, maxval=0.5))(keys)
    return jax.vmap(random_rotation)(keys), jnp.asarray(distance_m * TOWARD, jnp.float32) + shifts


def single(cells: Cells) -> Cells:
    """In single precision."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)


def off(value, reference) -> float:
    """Relative error."""
    return float(np.linalg.norm(np.asarray(value) - reference) / np.linalg.norm(reference))


def in_double(cells: Cells, turn, place, call: Callable):
    """What ``call`` makes of the cells moved in double precision."""
    with jax.enable_x64(True):
        moved = cells.moved(*(jnp.asarray(np.asarray(part, np.float64)) for part in (turn, place)))
        return jax.tree.map(np.asarray, call(moved))


def peer(positions_m: np.ndarray, edge_m: float, array: PlanarArray = ARRAY, chi: complex = CHI):
    """torchgdm's channel of solid cells, and its value and gradient in the cells' positions (no arguments)."""
    import torch
    import torchgdm as tg

    torch.set_num_threads(len(os.sched_getaffinity(0)))
    antennas = torch.as_tensor(1e9 * array.positions, dtype=torch.float32)

    def channel(positions):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            body = tg.struct.StructDiscretized3D(
                positions, tg.materials.MatConstant(1.0 + chi), step=1e9 * edge_m, on_distance_violation="ignore"
            )
            simulation = tg.simulation.Simulation(
                [body], tg.env.EnvHomogeneous3D(env_material=1.0), [], [1e9 * array.wavelength]
            )
            # Probes a little off the sources: the free-space term, which torchgdm adds, is infinite at them.
            return tg.postproc.green.G_Ep(simulation, antennas + 1e7, antennas, 1e9 * array.wavelength)

    def forward():
        with torch.no_grad():
            return channel(torch.as_tensor(1e9 * positions_m, dtype=torch.float32)).numpy()

    def gradient():
        positions = torch.as_tensor(1e9 * positions_m, dtype=torch.float32).requires_grad_()
        channel(positions).abs().square().sum().backward()
        return positions.grad.numpy()

    return forward, gradient


def rigid(args) -> list[dict]:
    """``body_channel`` against LU, SciPy and torchgdm."""
    import scipy.linalg

    cells = lattice(args.cells)
    moving = single(cells)
    rows = []
    for distance in args.distance:
        body, factoring = factored(cells, 0.9 * distance)
        rotations, places = poses(args.batch, distance)
        chi = jnp.asarray(CHI, jnp.complex64)
        fast = jax.jit(jax.vmap(lambda turn, place: body_channel(body, ARRAY, turn, place, chi)))
        dense = jax.jit(lambda turn, place: sensing_channel(ARRAY, moving.moved(turn, place), chi))
        moved = moving.moved(rotations[0], places[0])
        matrix = np.asarray(jax.jit(interaction_matrix)(moved, ARRAY.wavenumber))
        fields = np.asarray(
            weighted_fields(
                moved,
                dipole_fields(
                    moved.positions,
                    jnp.asarray(ARRAY.positions, jnp.float32),
                    jnp.asarray(ARRAY.moments, jnp.float32),
                    ARRAY.wavenumber,
                ),
            )
        )
        system = np.eye(len(matrix), dtype=np.complex64) / np.complex64(CHI) - matrix
        calls = {
            "factored": lambda: fast(rotations, places),
            "dense": lambda: dense(rotations[0], places[0]),
            "scipy": lambda: fields.T @ scipy.linalg.solve(system, fields, check_finite=False),
        }
        if PEER:
            calls["torchgdm"] = peer(np.asarray(moved.positions), float(np.cbrt(cells.volumes[0])))[0]
        times = medians(calls, args.repeats)
        times["factored"] /= args.batch
        exact = in_double(cells, rotations[0], places[0], lambda c: sensing_channel(ARRAY, c, CHI))
        flop = 6.0 * np.prod(body.weights.shape[-2:]) * len(chosen(body))
        row = {
            "cells": cells.count,
            "distance_m": distance,
            "batch": args.batch,
            "factoring_or_cache_s": factoring,
            "modes": list(body.weights.shape[-2:]),
            **{f"{name}_s": value for name, value in times.items()},
            **{f"{name}_over_factored": times[name] / times["factored"] for name in times if name != "factored"},
            "factored_error": off(fast(rotations, places)[0], exact),
            "dense_error": off(calls["dense"](), exact),
            "factored_gflop_s": flop / times["factored"] / 1e9,
        }
        rows.append(row)
        print(
            f"rigid   {cells.count} cells, {distance:g} m: factored {1e3 * times['factored']:.2f} ms "
            f"(error {row['factored_error']:.1e}, {row['factored_gflop_s']:.0f} Gflop/s); "
            + ", ".join(
                f"{name} {1e3 * value:.0f} ms = {value / times['factored']:.0f} x"
                for name, value in times.items()
                if name != "factored"
            )
            + f"; error of dense {row['dense_error']:.1e}",
            flush=True,
        )
    return rows


def chosen(body) -> np.ndarray:
    """The antennas whose fields are computed."""
    from august_jax.physics.body import aperture_skeleton

    return aperture_skeleton(ARRAY, FREQUENCY, body.radius_m, body.nearest_m)[0]


def factored(cells: Cells, nearest_m: float):
    """The factored body, and how long it took to make it or to find it in the cache [s]."""
    start = time.perf_counter()
    body = factor_body(cells, FREQUENCY, nearest_m=nearest_m)
    return body, time.perf_counter() - start


def moving(args) -> list[dict]:
    """Krylov against LU and torchgdm, value and gradient in all positions."""
    cells, distance = lattice(args.cells), max(args.distance)
    rotations, places = poses(1, distance)
    body = jax.tree.map(jnp.asarray, single(cells).moved(rotations[0], places[0]))
    random = np.random.default_rng(0)
    weights = random.normal(size=(2, ARRAY.count, ARRAY.count))
    weights = weights + weights.transpose(0, 2, 1)

    def loss(positions, solver, target):
        channel = sensing_channel(ARRAY, target._replace(positions=positions), CHI, solver=solver)
        return 1e6 * jnp.sum(weights[0] * channel.real + weights[1] * channel.imag)

    calls = {}
    for solver in ("krylov", "mom"):
        value = jax.jit(lambda positions, solver=solver: loss(positions, solver, body))
        both = jax.jit(jax.value_and_grad(lambda positions, solver=solver: loss(positions, solver, body)))
        calls[f"{solver}_value"] = lambda value=value: value(body.positions)
        calls[f"{solver}_gradient"] = lambda both=both: both(body.positions)
    if PEER:
        calls["torchgdm_value"], calls["torchgdm_gradient"] = peer(
            np.asarray(body.positions), float(np.cbrt(cells.volumes[0]))
        )
    times = medians(calls, args.repeats)
    # What is given are the positions in single precision: the same ones in double are the reference.
    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), body)
        exact = sensing_channel(ARRAY, double, CHI)
        slopes = jax.grad(lambda positions: loss(positions, "mom", double))(double.positions)
        exact, slopes = np.asarray(exact), np.asarray(slopes)
    row = {"cells": cells.count, "distance_m": distance, **{f"{name}_s": value for name, value in times.items()}}
    for solver in ("krylov", "mom"):
        found = calls[f"{solver}_gradient"]()
        channel = sensing_channel(ARRAY, body, CHI, solver=solver)
        row[f"{solver}_error"] = off(channel, exact)
        row[f"{solver}_gradient_error"] = off(found[1], slopes)
        row[f"{solver}_gradient_over_value"] = times[f"{solver}_gradient"] / times[f"{solver}_value"]
        for kind in ("value", "gradient"):
            if PEER:
                row[f"torchgdm_over_{solver}_{kind}"] = times[f"torchgdm_{kind}"] / times[f"{solver}_{kind}"]
        print(
            f"moving  {cells.count} cells, {solver}: value {times[f'{solver}_value']:.2f} s "
            f"(error {row[f'{solver}_error']:.1e}), value and gradient {times[f'{solver}_gradient']:.2f} s = "
            f"{row[f'{solver}_gradient_over_value']:.2f} x (error {row[f'{solver}_gradient_error']:.1e})",
            flush=True,
        )
    if PEER:
        print(
            f"        torchgdm: value {times['torchgdm_value']:.2f} s = "
            f"{row['torchgdm_over_krylov_value']:.1f} x krylov, value and gradient {times['torchgdm_gradient']:.2f} s"
            f" = {row['torchgdm_over_krylov_gradient']:.1f} x",
            flush=True,
        )
    return [row]


def scaling(args) -> list[dict]:
    """``body_channel`` over cells, antennas and batch; each sweep in turn, relative to its own middle."""
    distance, chi = max(args.distance), jnp.asarray(CHI, jnp.complex64)
    bodies = {}
    for count in args.sweep:
        cells = lattice(count)
        bodies[cells.count], spent = factored(cells, 0.9 * distance)
        print(
            f"scaling {cells.count} cells: {spent:.0f} s to factor or to read, error "
            f"{bodies[cells.count].error:.1e}, {bodies[cells.count].weights.shape[-2]} modes",
            flush=True,
        )
    middle = bodies[min(bodies, key=lambda count: abs(count - 1000))]

    def call(body, array, batch):
        fast = jax.jit(jax.vmap(lambda turn, place: body_channel(body, array, turn, place, chi)))
        where = poses(batch, distance)
        return lambda: fast(*where)

    sweeps = {
        "cells": {count: (call(body, ARRAY, args.batch), args.batch) for count, body in bodies.items()},
        "antennas": {
            nx * nz: (call(middle, PlanarArray(nx, nz, FREQUENCY), args.batch), args.batch)
            for nx, nz in ((4, 4), (8, 4), (16, 4), (16, 8), (16, 16))
        },
        "batch": {batch: (call(middle, ARRAY, batch), batch) for batch in (1, 4, 16, 64, 256)},
    }
    rows = []
    for name, calls in sweeps.items():
        times = medians({size: run for size, (run, _) in calls.items()}, args.repeats)
        each = {size: times[size] / batch for size, (_, batch) in calls.items()}
        rows += [{"sweep": name, "size": size, "factored_s": value} for size, value in each.items()]
        print(
            f"scaling over {name}: " + ", ".join(f"{size}: {1e3 * value:.2f} ms" for size, value in each.items()),
            flush=True,
        )
    return rows


def flights_set(args) -> list[dict]:
    """Channels of a preset's flights through its airframes' bodies: factoring and channels, each timed."""
    config = preset(args.preset)
    nearest = nearest_distance(config)
    start = time.perf_counter()
    drones = [resolve_airframe(name, config.target.half_wheelbase_m) for name in config.target.airframes]
    lattices = [cells for cells, _ in lattices_of(drones, config.target)]
    # Not padded to one shape, as `prepare_targets` may: more compilations cost less here than larger products.
    bodies = factor_bodies(lattices, config.array.frequency_hz, nearest_m=nearest)
    factoring = time.perf_counter() - start
    fast = jax.jit(
        jax.vmap(
            lambda body, turn, place: simulated_channel(config, body, turn, place, PERMITTIVITY, CONDUCTIVITY),
            (None, 0, 0),
        )
    )
    start = time.perf_counter()
    flights = -(-args.count // config.flight.slots)
    tracks = fly_many(jax.random.split(jax.random.key(0), flights), config.flight)
    rotations, places = (
        part.reshape(-1, *part.shape[2:])[: args.count] for part in (tracks.rotations, tracks.positions)
    )
    for first in range(0, args.count, args.batch):
        turns, where = (part[first : first + args.batch].astype(jnp.float32) for part in (rotations, places))
        if len(turns) < args.batch:  # one shape, one compilation
            turns, where = (jnp.concatenate([part] * args.batch)[: args.batch] for part in (turns, where))
        fast(bodies[(first // args.batch) % len(bodies)], turns, where).block_until_ready()
    spent = time.perf_counter() - start
    sizes = [cells.count for cells in lattices]
    print(
        f"set     {args.count} channels of {len(bodies)} airframes ({min(sizes)} to {max(sizes)} cells): {spent:.0f} "
        f"s, flights and compiling counted; factoring or reading the bodies {factoring:.0f} s",
        flush=True,
    )
    return [{"count": args.count, "cells": sizes, "channels_s": spent, "factoring_or_cache_s": factoring}]


def precision(args) -> list[dict]:
    """Errors of channels by the precision that products of matrices are asked for."""
    cells, distance = lattice(min(args.cells, 500)), max(args.distance)
    body, _ = factored(cells, 0.9 * distance)
    turns, places = poses(4, distance)
    chi = jnp.asarray(CHI, jnp.complex64)
    routes = {
        "body": lambda turn, place: body_channel(body, ARRAY, turn, place, chi),
        "mom": lambda turn, place: sensing_channel(ARRAY, single(cells).moved(turn, place), chi),
    }
    exact = [in_double(cells, turn, place, lambda moved: sensing_channel(ARRAY, moved, CHI)) for turn, place in
             zip(turns, places, strict=True)]  # fmt: skip
    rows = []
    for route, call in routes.items():
        errors = {}
        for asked in ("highest", "default"):
            with jax.default_matmul_precision(asked):
                fast = jax.jit(call)
                found = [off(fast(*pose), whole) for *pose, whole in zip(turns, places, exact, strict=True)]
            errors[asked] = float(np.max(found))
        rows.append({"route": route, "cells": cells.count, **errors})
        print(
            f"precision {route}, {cells.count} cells: error {errors['highest']:.1e} in full, {errors['default']:.1e} "
            "by the device's default",
            flush=True,
        )
    return rows


def tabulated_set(args) -> list[dict]:
    """Channels of a preset's flights through its airframes' tables: preparing and channels, each timed."""
    config = preset(args.preset)
    start = time.perf_counter()
    drones = [resolve_airframe(name, config.target.half_wheelbase_m) for name in config.target.airframes]
    lattices = [cells for cells, _ in lattices_of(drones, config.target)]
    bodies = factor_bodies(lattices, config.array.frequency_hz, nearest_m=nearest_distance(config))
    factoring = time.perf_counter() - start
    start = time.perf_counter()
    tables = tabulate_targets(config, bodies)
    tabulating = time.perf_counter() - start
    start = time.perf_counter()
    stack = stack_tables(tables)
    array = PlanarArray.from_config(config.array)

    @jax.jit
    def channels(stack, craft, turns, places, materials):
        def one(craft, turn, place, material):
            chi = contrast_of(config, material[0], material[1])
            return table_channel(stack, array, turn, place, chi[0], craft=craft)

        return jax.vmap(one)(craft, turns, places, materials)

    flights = -(-args.count // config.flight.slots)
    tracks = fly_many(jax.random.split(jax.random.key(0), flights), config.flight)
    turns, places = (part.reshape(-1, *part.shape[2:]) for part in (tracks.rotations, tracks.positions))
    spans = np.asarray([config.target.permittivity, config.target.conductivity_s_m], np.float32)
    materials = np.random.default_rng(0).uniform(*spans.T, (len(turns), 2)).astype(np.float32)
    for first in range(0, args.count, args.batch):
        rows = np.minimum(np.arange(first, first + args.batch), args.count - 1)  # one shape, one compilation
        channels(stack, rows % len(tables), turns[rows], places[rows], materials[rows]).block_until_ready()
    spent = time.perf_counter() - start
    errors = np.asarray(stack.errors)[:, 0]
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(tables[0])) / 1e6
    print(
        f"tables  {args.count} channels of {len(tables)} airframes: {spent:.1f} s, flights and compiling counted; "
        f"factoring or reading {factoring:.0f} s, tabulating or reading {tabulating:.1f} s; a table {size:.0f} MB, "
        f"errors {errors[:, 0].max():.1e} (median), {errors[:, 1].max():.1e} (95 %)",
        flush=True,
    )
    return [
        {
            "count": args.count,
            "channels_s": spent,
            "factoring_or_cache_s": factoring,
            "tabulating_or_cache_s": tabulating,
            "table_mb": size,
            "errors": errors.tolist(),
        }
    ]


PARTS = {
    "rigid": rigid,
    "moving": moving,
    "precision": precision,
    "set": flights_set,
    "tables": tabulated_set,
    "scaling": scaling,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--cells", type=int, default=1000, help="at most so many, for rigid and moving")
    parser.add_argument("--sweep", type=int, nargs="+", default=[250, 500, 1000, 2000, 4000], help="cells of scaling")
    parser.add_argument("--distance", type=float, nargs="+", default=[5.0, 20.0], help="metres")
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--preset", default="paper", help="whose flights and airframes set takes (%(default)s)")
    parser.add_argument("--count", type=int, default=50_000, help="channels of set")
    parser.add_argument("--repeats", type=int, default=5)
    args = parsed(parser)
    figures: Figures = {"machine": machine()}
    for part in args.parts:
        figures[part] = PARTS[part](args)
        write(args, figures)


if __name__ == "__main__":
    main()
