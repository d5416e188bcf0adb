"""Samples: from a key to what flew, its channel, what the base station made of it, and the label.

Row i belongs to flight i // slots and is a function of the configuration and i alone: a flight's track, airframe and
material come from ``fold_in(flights, flight)``, all else of the row from ``fold_in(samples, i)``. Airframes take
turns by flight; a flight keeps its material (paper, Section VI-A).

Rows of one airframe are computed together, ``_BATCH`` at a time, through that airframe's factored body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.config import Config, TargetConfig
from august_jax.physics import Body, Cells, PlanarArray, alike, body_channel, contrast, factor_bodies, sensing_channel
from august_jax.scene.airframes import Airframe, resolve_airframe, sample_triangles
from august_jax.scene.trajectory import fly_many
from august_jax.signal.estimation import observe

_BATCH = 64
_MATERIAL = 1 << 20  # numbers below draw a flight's tracks (scene.trajectory)
_UNEVEN = 1.4
"""Bodies are padded to one shape, to compile once, unless the largest is this many times the mean."""

Sample = dict[str, np.ndarray]


@dataclass(frozen=True)
class Target:
    """An airframe ready to be simulated.

    Attributes:
        airframe: the mesh.
        cells: its cells, in the body frame.
        cell_m: the edge of the lattice that was used [m].
        body: its factored response; None where the solver needs none.
        surface: triangles (T, 3, 3) [m] and cumulative areas (T,) [m^2], float32, padded to one T for the set.
    """

    airframe: Airframe
    cells: Cells
    cell_m: float
    body: Body | None
    surface: tuple[np.ndarray, np.ndarray]


def nearest_distance(config: Config) -> float:
    """A distance that every craft in the flight box keeps from every antenna, a tenth to spare, in steps of 0.5 m [m].

    Raises:
        ValueError: the flight box comes within 1 m of the array.
    """
    array = PlanarArray(config.array.nx, config.array.nz, config.array.frequency_hz)
    corner = [min(max(0.0, low), high) for low, high in config.flight.box_m]
    gap = np.linalg.norm(corner) - np.linalg.norm(array.positions, axis=1).max()
    if gap < 1.0:
        raise ValueError(
            f"flight.box_m: the box comes within {max(gap, 0.0):.2g} m of the array at the origin; keep it 1 m away"
        )
    return float(np.floor(2.0 * 0.9 * gap) / 2.0)


def lattice_of(airframe: Airframe, target: TargetConfig) -> tuple[Cells, float]:
    """An airframe's cells as the configuration wants them, and their edge [m]."""
    cell_m = airframe.cell_size_for(target.max_cells, target.cell_m, target.skin_m)
    return airframe.cells(cell_m, target.skin_m), cell_m


def lattices_of(airframes: Sequence[Airframe], target: TargetConfig) -> list[tuple[Cells, float]]:
    """:func:`lattice_of` each, two at a time: NumPy works on one core."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda airframe: lattice_of(airframe, target), airframes))


def prepare_targets(config: Config, report: Callable[[str], None] = lambda line: None) -> list[Target]:
    """Airframes, lattices and, for ``mom``, factored bodies (minutes for the first time, then from the cache)."""
    target, nearest = config.target, nearest_distance(config)
    airframes = [resolve_airframe(name, target.half_wheelbase_m) for name in target.airframes]
    lattices, bodies = lattices_of(airframes, target), []
    for airframe, (cells, cell_m) in zip(airframes, lattices):
        report(f"{airframe.name}: {cells.count} cells of {1e3 * cell_m:.3g} mm")
    if config.data.solver == "mom":
        tones = config.array.tones_hz or config.array.frequency_hz
        bodies = factor_bodies([cells for cells, _ in lattices], tones, nearest_m=nearest)
    sizes = [np.prod(body.weights.shape) for body in bodies]
    if bodies and max(sizes) < _UNEVEN * np.mean(sizes):
        bodies = alike(bodies)
    bodies = bodies or [None] * len(airframes)
    most = max(len(airframe.surface[0]) for airframe in airframes)
    # Repeating the last triangle adds no area: it is never chosen.
    surfaces = [tuple(np.pad(part, [(0, most - len(part))] + [(0, 0)] * (part.ndim - 1), mode="edge")
                      for part in airframe.surface) for airframe in airframes]
    return [Target(airframe, *lattice, body, surface)
            for airframe, lattice, body, surface in zip(airframes, lattices, bodies, surfaces, strict=True)]


def split_of(flight: np.ndarray, config: Config) -> np.ndarray:
    """0 (train), 1 (validation) or 2 (test) for flight numbers; every airframe is shared out alike."""
    shares = np.cumsum(config.data.split)
    return np.searchsorted(shares, (np.asarray(flight) // len(config.target.airframes)) % shares[-1], side="right")


def generate(config: Config, rows: Sequence[int] | np.ndarray, targets: Sequence[Target]) -> Sample:
    """The samples of the given rows, in their order.

    Args:
        config: everything the samples depend on.
        rows: row numbers (n,), not negative.
        targets: from :func:`prepare_targets` for the same configuration.

    Returns:
        Arrays with a leading axis n (float32, complex64 and int32):
        ``position`` (3,) [m], ``rotation`` (3, 3) body to world, ``permittivity``, ``conductivity`` [S/m],
        ``airframe`` (index), ``flight``, ``slot``, ``predicted`` (3,) [m], ``snr_db`` (realised), ``snr_estimate_db``,
        ``power_dbm``, ``channel`` and ``estimate`` (F, N_b (N_b + 1)/2), upper triangles of H and H_est, and
        ``points`` (M, 3): surface points in world axes about ``position`` [m].
    """
    rows = np.asarray(rows, np.int64)
    slots, kinds = config.flight.slots, len(config.target.airframes)
    flights_key, samples_key = jax.random.split(jax.random.key(config.data.seed))
    numbers, place = np.unique(rows // slots, return_inverse=True)
    # Padding to a power of two keeps the number of compilations small.
    padded = np.pad(numbers, (0, (1 << (len(numbers) - 1).bit_length()) - len(numbers)), mode="edge")
    flight_keys = jax.vmap(jax.random.fold_in, (None, 0))(flights_key, jnp.asarray(padded))
    tracks = fly_many(flight_keys, config.flight)
    share = np.asarray(jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, _MATERIAL), (2,)))(flight_keys))

    def between(span, value):
        return (span[0] + (span[1] - span[0]) * value).astype(np.float32)

    slot = rows % slots
    known = {
        "position": np.asarray(tracks.positions, np.float32)[place, slot],
        "rotation": np.asarray(tracks.rotations, np.float32)[place, slot],
        "permittivity": between(config.target.permittivity, share[place, 0]),
        "conductivity": between(config.target.conductivity_s_m, share[place, 1]),
    }
    craft = (rows // slots) % kinds
    drawn: Sample = {}
    for kind in np.unique(craft):
        mine = np.flatnonzero(craft == kind)
        for start in range(0, len(mine), _BATCH):
            batch = mine[start : start + _BATCH]
            filled = np.pad(batch, (0, _BATCH - len(batch)), mode="edge")
            keys = jax.vmap(jax.random.fold_in, (None, 0))(samples_key, jnp.asarray(rows[filled]))
            results = _simulate(keys, {name: value[filled] for name, value in known.items()}, targets[kind], config)
            for name, value in results.items():
                store = drawn.setdefault(name, np.empty((len(rows), *value.shape[1:]), value.dtype))
                store[batch] = np.asarray(value)[: len(batch)]
    numbers32 = {"airframe": craft, "flight": rows // slots, "slot": slot}
    return known | {name: value.astype(np.int32) for name, value in numbers32.items()} | drawn


def _simulate(keys, known, target: Target, config: Config):
    return _compiled(keys, known, target.body if target.body is not None else target.cells, *target.surface, config)


@partial(jax.jit, static_argnames="config")
def _compiled(keys, known, body: Body | Cells, surface, cumulative, config: Config):
    array = PlanarArray(config.array.nx, config.array.nz, config.array.frequency_hz)
    tones = config.array.frequencies_hz

    def channel_of(position, rotation, permittivity, conductivity):
        chi = contrast(permittivity, conductivity, jnp.asarray(tones, jnp.float32)).astype(jnp.complex64)
        if isinstance(body, Body):
            channel = body_channel(body, array, rotation, position, chi[0] if body.single else chi)
            return channel.reshape(len(tones), *channel.shape[-2:])
        moved = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), body).moved(rotation, position)
        return sensing_channel(array, moved, chi[:, None], solver=config.data.solver, frequencies_hz=tones)

    def one(key, row):
        points_key, predicted_key, level_key, echo_key = jax.random.split(key, 4)
        channel = channel_of(**row)
        seen_from = draw_prediction(predicted_key, row["position"], config)
        observed = observe(echo_key, channel, seen_from, array=config.array, signal=config.signal, region=config.region,
                           **draw_level(level_key, config))
        points = sample_triangles(points_key, surface, cumulative, config.target.points) @ row["rotation"].T
        return {
            "predicted": seen_from, "snr_db": observed.snr_db, "snr_estimate_db": observed.snr_estimate_db,
            "power_dbm": observed.power_dbm, "channel": pack(channel), "estimate": pack(observed.channel),
            "points": points,
        }

    return jax.vmap(one)(keys, known)


def draw_prediction(key: jax.Array, position: jax.Array, config: Config) -> jax.Array:
    """A predicted position (3,) [m]: the true one, missed uniformly within the threshold along each axis."""
    threshold = config.region.threshold_m
    return position + jax.random.uniform(key, (3,), minval=-threshold, maxval=threshold)


def draw_level(key: jax.Array, config: Config) -> dict[str, jax.Array]:
    """``snr_db`` or ``power_dbm``, uniform in its range, as ``signal.draw`` says; arguments of ``observe``."""
    name = "snr_db" if config.signal.draw == "snr" else "power_dbm"
    low, high = getattr(config.signal, name)
    return {name: jax.random.uniform(key, minval=low, maxval=high)}


def pack(channel: jax.Array) -> jax.Array:
    """Upper triangles (..., N(N + 1)/2) of symmetric matrices (..., N, N)."""
    return channel[..., *np.triu_indices(channel.shape[-1])]


def unpack(packed: jax.Array) -> jax.Array:
    """Symmetric matrices (..., N, N) from :func:`pack`'s triangles."""
    size = int((np.sqrt(8 * packed.shape[-1] + 1) - 1) / 2)
    rows, columns = np.triu_indices(size)
    place = np.zeros((size, size), np.int32)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return packed[..., place]
