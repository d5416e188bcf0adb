"""From a configuration to channels, worked out in one place: array, lattices, bodies, contrast, channel.

``august simulate``, the tracks of the demo, evaluation and the benchmarks all take their channels from here.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import Config, TargetConfig
from august_jax.physics import (
    Body,
    Cells,
    PlanarArray,
    Table,
    body_channel,
    contrast,
    evened,
    factor_bodies,
    factor_body,
    judge_contrast,
    sensing_channel,
    stack_tables,
    table_channel,
    tabulate_bodies,
)
from august_jax.progress import Progress, silent
from august_jax.scene.airframes import Airframe, resolve_airframe

_DENSE_POSES = 40
"""So many poses of one craft are solved densely, about a second each; for more its body is factored first."""
_BEYOND_M = 0.25
"""A table holds places up to ``region.threshold_m`` and this much more outside the flight box [m]."""
_BEYOND_DEG = 3.0
"""It holds tilts up to this much more than ``flight.tilt_deg``."""
_BEYOND = 0.05
"""Relative to a range of materials, what a table holds beyond either end."""
FAINTEST = 1e-2
"""The least contrast that a table holds, relative to the greatest: nearer to air an echo is as good as none."""
_FIELDS = {
    "array": "array.nx",
    "contrast": "target.permittivity, target.conductivity_s_m",
    "rotation": "flight.tilt_deg",
    "translation": "flight.box_m",
}
"""Argument of a table's channel -> the fields that its range comes from."""


@dataclass(frozen=True)
class Target:
    """An airframe ready to be simulated.

    Attributes:
        airframe: the mesh.
        cells: its cells, in the body frame.
        cell_m: the edge of the lattice that was used [m].
        body: its factored response; None where the solver needs none.
        surface: triangles (T, 3, 3) [m] and cumulative areas (T,) [m^2], float32, padded to one T for the set.
        table: its tabulated response, for the solver ``table``; else None.
    """

    airframe: Airframe
    cells: Cells
    cell_m: float
    body: Body | None
    surface: tuple[np.ndarray, np.ndarray]
    table: Table | None = None

    @property
    def scatterer(self) -> Table | Body | Cells:
        """What :func:`simulated_channel` takes: the table, the body, or the cells where the solver needs neither."""
        if self.table is not None:
            return self.table
        return self.cells if self.body is None else self.body


def nearest_distance(config: Config) -> float:
    """A distance that every craft in the flight box keeps from every antenna, a tenth to spare, in steps of 0.5 m [m].

    Raises:
        ValueError: the flight box comes within 1 m of the array.
    """
    gap = _nearest_place(config.flight.box_m) - _extent(config)
    if gap < 1.0:
        raise ValueError(
            f"flight.box_m: the box comes within {max(gap, 0.0):.2g} m of the array at the origin; keep it 1 m away"
        )
    return float(np.floor(2.0 * 0.9 * gap) / 2.0)


def _extent(config: Config) -> float:
    """From the array's middle, the origin, to its farthest antenna [m]."""
    return float(np.linalg.norm(PlanarArray.from_config(config.array).positions, axis=1).max())


def _nearest_place(box: Sequence[tuple[float, float]]) -> float:
    """From the origin to the nearest place of a box [m]."""
    return float(np.linalg.norm([min(max(0.0, low), high) for low, high in box]))


def _farthest_place(box: Sequence[tuple[float, float]]) -> float:
    """From the origin to the farthest place of a box [m]."""
    return float(np.linalg.norm([max(abs(low), abs(high)) for low, high in box]))


def _walls(config: Config, beyond_m: float) -> list[tuple[float, float]]:
    """The flight box, and so much more on every side [m]."""
    return [(low - beyond_m, high + beyond_m) for low, high in config.flight.box_m]


class _Ranges(NamedTuple):
    """Arguments of :func:`august_jax.physics.tabulate_bodies`."""

    distance_m: tuple[float, float]
    contrast: tuple[float, float]
    loss: float
    elevation_deg: tuple[float, float]


def _ranges(config: Config, beyond_m: float = 0.0, beyond_deg: float = 0.0, beyond: float = 0.0) -> _Ranges:
    """What the craft of a configuration may be, and so much more of place, tilt and (relative) material."""
    walls = _walls(config, beyond_m)
    near, far = _nearest_place(walls), _farthest_place(walls)
    # A craft above the array has it below: the elevation is that of the place, turned over, give or take its tilt.
    across = (_nearest_place(walls[:2]), _farthest_place(walls[:2]))
    above = np.degrees([np.arctan2(height, width) for height in walls[2] for width in across])
    tilt = config.flight.tilt_deg + beyond_deg
    low, high = (permittivity - 1.0 for permittivity in config.target.permittivity)
    more = beyond * max(high - low, 0.2 * high, 0.02)
    loss = np.imag(contrast_of(config, 1.0, config.target.conductivity_s_m[1])).max()
    return _Ranges(
        distance_m=(max(near, nearest_distance(config) + _extent(config)), far),
        contrast=(max(low - more, FAINTEST * high), high + more),
        loss=(1.0 + beyond) * float(loss),
        elevation_deg=(float(max(-above.max() - tilt, -90.0)), float(min(-above.min() + tilt, 90.0))),
    )


def tabulate_targets(config: Config, bodies: Sequence[Body], progress: Progress = silent) -> list[Table]:
    """Tables of craft for all that a configuration's craft may be: where, how tilted, made of what; cached.

    A search may look somewhat farther than craft fly. Tables hold places up to ``region.threshold_m`` and a quarter of
    a metre outside ``flight.box_m``, tilts up to three degrees more than ``flight.tilt_deg``, and materials a twentieth
    of ``target.permittivity`` and ``target.conductivity_s_m`` beyond either end. Towards the array they end where the
    bodies do, at :func:`nearest_distance` of an antenna, a tenth of the way: the nearer a table's nearest place, the
    more directions it needs.

    Args:
        config: of array and ranges.
        bodies: factored for ``config.array.frequencies_hz`` and :func:`nearest_distance`, in whatever shape
            :func:`august_jax.physics.factor_bodies` left them: padded ones are cached apart.
        progress: told how far it is, and each table's measured error.

    Returns:
        A table each, in order; they stack (:func:`august_jax.physics.stack_tables`).

    Raises:
        ValueError: bodies that were factored for a greater distance, or a box so near that a craft sees the array
            under too wide an angle.
    """
    nearest = nearest_distance(config)
    for row, body in enumerate(bodies):
        if body.nearest_m > nearest * (1.0 + 1e-6):
            raise ValueError(
                f"bodies: body {row} was factored for {body.nearest_m:g} m and beyond, a table holds places down to "
                f"{nearest:g} m; factor it with nearest_m=nearest_distance(config)"
            )
    ranges = _ranges(config, config.region.threshold_m + _BEYOND_M, _BEYOND_DEG, _BEYOND)
    try:
        tables = tabulate_bodies(bodies, PlanarArray.from_config(config.array), **ranges._asdict(), progress=progress)
    except ValueError as error:
        if not str(error).startswith("distance_m: at "):
            raise
        raise ValueError(f"flight.box_m: {config.flight.box_m} is too near for a table: {error}") from None
    for row, table in enumerate(tables):
        median, most = np.asarray(table.errors).max(axis=0)
        progress(f"table {row + 1} of {len(tables)}: relative error {median:.1e} (median), {most:.1e} (95 %)")
    return tables


def check_table(config: Config, table: Table) -> None:
    """Refuse a table that does not hold all that a configuration's craft may be: compiled channels cannot.

    Raises:
        ValueError: names the field of the configuration and what the table holds.
    """
    wanted, slack = _ranges(config), 1e-6
    low, high = table.distance_m
    for path, value, good, holds in (
        (
            "array.tones_hz",
            config.array.frequencies_hz,
            table.frequencies_hz == config.array.frequencies_hz,
            f"tones of {table.frequencies_hz} Hz",
        ),
        (
            "array.nx",
            config.array.nx,
            _extent(config) <= table.extent_m + slack,
            f"antennas up to {table.extent_m:.3g} m from their middle",
        ),
        (
            "flight.box_m",
            config.flight.box_m,
            low - slack <= wanted.distance_m[0] and wanted.distance_m[1] <= high + slack,
            f"places {low:.3g} to {high:.3g} m from the array",
        ),
        (
            "target.permittivity",
            config.target.permittivity,
            table.contrast[0] - slack <= wanted.contrast[0] and wanted.contrast[1] <= table.contrast[1] + slack,
            f"permittivities {1.0 + table.contrast[0]:.3g} to {1.0 + table.contrast[1]:.3g}",
        ),
        (
            "target.conductivity_s_m",
            config.target.conductivity_s_m,
            wanted.loss <= table.loss + slack,
            f"imaginary contrasts up to {table.loss:.3g}",
        ),
        (
            "flight.tilt_deg",
            config.flight.tilt_deg,
            table.elevation_deg[0] - slack <= wanted.elevation_deg[0]
            and wanted.elevation_deg[1] <= table.elevation_deg[1] + slack,
            f"the array at elevations of {table.elevation_deg[0]:.3g} to {table.elevation_deg[1]:.3g} degrees",
        ),
    ):
        if not good:
            raise ValueError(
                f"{path}: {value} is beyond the table, which holds {holds}; make it for this configuration"
            )


def tables_of(config: Config, targets: Sequence[Target]) -> Table:
    """The targets' tables in one stack, in their order.

    Raises:
        ValueError: targets without tables, fewer than craft, or tables that do not hold all that this configuration's
            craft may be.
    """
    tables = [target.table for target in targets if target.table is not None]
    if len(tables) != len(targets) or not tables:
        raise ValueError("targets: they have no tables; prepare them with data.solver=table")
    if len(tables) != len(config.target.airframes):
        raise ValueError(
            f"targets: got {len(tables)} for the {len(config.target.airframes)} of target.airframes; prepare them for "
            "this configuration"
        )
    check_table(config, tables[0])
    return stack_tables(tables)


def lattice_of(airframe: Airframe, target: TargetConfig) -> tuple[Cells, float]:
    """An airframe's cells as the configuration wants them, and their edge [m]."""
    cell_m = airframe.cell_size_for(target.max_cells, target.cell_m, target.skin_m)
    return airframe.cells(cell_m, target.skin_m), cell_m


def lattices_of(airframes: Sequence[Airframe], target: TargetConfig) -> list[tuple[Cells, float]]:
    """:func:`lattice_of` each, two at a time: NumPy works on one core."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda airframe: lattice_of(airframe, target), airframes))


def prepare_targets(config: Config, progress: Progress = silent) -> list[Target]:
    """Airframes, lattices and, for ``mom`` and ``table``, factored bodies; for ``table`` their tables.

    Bodies and tables take minutes for the first time and then come from the cache.

    Warns where the cells, or the reduction of a body, are too coarse for an end of the ranges of material, with the
    figure.
    """
    target, nearest = config.target, nearest_distance(config)
    airframes = [resolve_airframe(name, target.half_wheelbase_m) for name in target.airframes]
    lattices, bodies = lattices_of(airframes, target), []
    tables: Sequence[Table | None] = [None] * len(airframes)
    for airframe, (cells, cell_m) in zip(airframes, lattices):
        progress(f"{airframe.name}: {cells.count} cells of {1e3 * cell_m:.3g} mm")
    if config.data.dense_solver == "mom":
        tones = config.array.tones_hz or config.array.frequency_hz
        bodies = factor_bodies([cells for cells, _ in lattices], tones, nearest_m=nearest)
        for body in bodies:  # channels are compiled, where contrasts are not looked at any more
            for permittivity, conductivity in itertools.product(target.permittivity, target.conductivity_s_m):
                judge_contrast(body, np.asarray(contrast_of(config, permittivity, conductivity)))
    if config.data.solver == "table":
        tables = tabulate_targets(config, bodies, progress)
    bodies = evened(bodies)
    most = max(len(airframe.surface[0]) for airframe in airframes)
    # Repeating the last triangle adds no area: it is never chosen.
    surfaces = [
        tuple(
            np.pad(part, [(0, most - len(part))] + [(0, 0)] * (part.ndim - 1), mode="edge") for part in airframe.surface
        )
        for airframe in airframes
    ]
    found: Sequence[Body | None] = bodies or [None] * len(airframes)
    return [
        Target(airframe, *lattice, body, surface, table)
        for airframe, lattice, body, surface, table in zip(airframes, lattices, found, surfaces, tables, strict=True)
    ]


def contrast_of(config: Config, permittivity: ArrayLike, conductivity: ArrayLike) -> Complex[jax.Array, " tones"]:
    """chi of a material at each tone (F,) complex64; conductivity in [S/m]."""
    tones = jnp.asarray(config.array.frequencies_hz, jnp.float32)
    return contrast(permittivity, conductivity, tones).astype(jnp.complex64)


def simulated_channel(
    config: Config,
    scatterer: Table | Body | Cells,
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    permittivity: ArrayLike,
    conductivity: ArrayLike,
) -> Complex[jax.Array, "tones antennas antennas"]:
    """The true channel H of one craft in one pose (F, N_b, N_b) complex64, by ``config.data.solver``.

    A pure function, in which ``config`` is static.

    Args:
        config: array, tones and solver.
        scatterer: a table, a factored body, or the cells in the body's frame, which ``table`` solves as ``mom`` does.
        rotation: body to world (3, 3).
        position: surface centroid (3,) [m].
        permittivity, conductivity: of the whole craft, [1] and [S/m].

    Raises:
        ValueError: numbers, not traced ones, outside a table's range; names the configuration's field.
    """
    array, tones = PlanarArray.from_config(config.array), config.array.frequencies_hz
    chi = contrast_of(config, permittivity, conductivity)
    if isinstance(scatterer, Table):
        try:
            channel = table_channel(scatterer, array, rotation, position, chi[0] if scatterer.single else chi)
        except ValueError as error:
            path = next((path for name, path in _FIELDS.items() if str(error).startswith(f"{name}: ")), None)
            if path is None or "the table holds" not in str(error):
                raise
            raise ValueError(f"{path}: asked beyond what tables are made for: {error}") from None
        return channel.reshape(len(tones), *channel.shape[-2:])
    if isinstance(scatterer, Body):
        channel = body_channel(scatterer, array, rotation, position, chi[0] if scatterer.single else chi)
        return channel.reshape(len(tones), *channel.shape[-2:])
    moved = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), scatterer).moved(rotation, position)
    return sensing_channel(array, moved, chi[:, None], solver=config.data.dense_solver, frequencies_hz=tones)


def channels_along(
    config: Config,
    airframe: Airframe,
    rotations: Float[Array, "poses 3 3"],
    positions: Float[Array, "poses 3"],
    permittivity: float,
    conductivity: float,
    body: Body | None = None,
) -> Complex[jax.Array, "poses tones antennas antennas"]:
    """True channels of one craft in T poses (T, F, N_b, N_b) complex64, by ``config.data.solver``.

    Args:
        config: array, lattice, solver, and the box that bounds how near the craft comes.
        airframe: the craft. For ``mom`` and more than 40 poses its body is factored first, half a minute for 1000
            cells, and kept in a cache; for fewer poses the dense solve of each is quicker, about a second. So for
            ``table``, too: a table takes as long again, and pays from tens of thousands of poses.
        rotations, positions: body to world (T, 3, 3), surface centroids (T, 3) [m].
        permittivity, conductivity: the material, [1] and [S/m].
        body: the craft's, where it was factored already; taken for any number of poses.
    """
    scatterer: Body | Cells
    if body is None:
        scatterer, _ = lattice_of(airframe, config.target)
        if config.data.dense_solver == "mom" and len(positions) > _DENSE_POSES:
            scatterer = factor_body(scatterer, config.array.frequencies_hz, nearest_m=nearest_distance(config))
    else:
        scatterer = body

    poses = jnp.asarray(rotations, jnp.float32), jnp.asarray(positions, jnp.float32)
    if isinstance(scatterer, Body):
        return _by_body(config, scatterer, *poses, permittivity, conductivity)

    def one(pose: tuple[jax.Array, jax.Array]) -> jax.Array:
        return simulated_channel(config, scatterer, *pose, permittivity, conductivity)

    # Dense solves go one after the other: each holds matrices of hundreds of megabytes.
    return jax.jit(lambda poses: jax.lax.map(one, poses))(poses)


@partial(jax.jit, static_argnames="config")
def _by_body(
    config: Config,
    body: Body,
    rotations: jax.Array,
    positions: jax.Array,
    permittivity: ArrayLike,
    conductivity: ArrayLike,
) -> jax.Array:
    """Compiled once for all flights of craft of a shape."""

    def one(rotation: jax.Array, position: jax.Array) -> jax.Array:
        return simulated_channel(config, body, rotation, position, permittivity, conductivity)

    return jax.vmap(one)(rotations, positions)
