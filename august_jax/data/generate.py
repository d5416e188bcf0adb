"""Samples: from a row's number to what flew, its channel, what the base station made of it, and the label.

Row i belongs to flight i // slots and is a function of the configuration and i alone: a flight's track, airframe and
material come from the streams ``flight`` and ``material`` by the flight's number, label and observation from
``points`` and ``observation`` by the row's (:mod:`august_jax.streams`). Airframes take turns by flight; a flight keeps
its material (paper, Section VI-A).

Rows of one airframe are computed together, ``_BATCH`` at a time on each device, through that airframe's table or
factored body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Int

from august_jax import streams
from august_jax.arrays import rows_not_finite
from august_jax.config import Config
from august_jax.data.fields import Observed, Sample, pack
from august_jax.data.observe import draw_level, draw_prediction
from august_jax.data.simulator import Target, check_table, simulated_channel
from august_jax.mesh import SPLIT, WHOLE, own_accelerators, placed, spread
from august_jax.physics import Body, Cells, Table
from august_jax.scene.airframes import sample_triangles
from august_jax.scene.trajectory import fly_many
from august_jax.signal.station import observe

_BATCH = 64


def split_of(flight: Int[np.ndarray, " n"], config: Config) -> Int[np.ndarray, " n"]:
    """0 (train), 1 (validation) or 2 (test) for flight numbers; every airframe is shared out alike."""
    shares = np.cumsum(config.data.split)
    return np.searchsorted(shares, (np.asarray(flight) // len(config.target.airframes)) % shares[-1], side="right")


@streams.pin
def generate(
    config: Config,
    rows: Sequence[int] | Int[np.ndarray, " n"],
    targets: Sequence[Target],
    *,
    seed: int | None = None,
    domain: Literal["data", "evaluate", "validation"] = "data",
    mesh: Mesh | None = None,
) -> Sample:
    """The samples of the given rows, in their order, as NumPy arrays.

    Args:
        config: everything the samples depend on. With ``data.observed`` they hold what the base station made of them.
        rows: row numbers (n,), not negative.
        targets: from :func:`~august_jax.data.simulator.prepare_targets` for the same configuration.
        seed: of all that is drawn; None takes ``data.seed``.
        domain: whose streams they come from: an evaluation's samples are never those of a data set, nor those that a
            streamed training is validated on.
        mesh: devices that share the rows; None takes :func:`~august_jax.mesh.own_accelerators`.

    Raises:
        ValueError: no rows; targets whose tables do not hold all that this configuration's craft may be.
        FloatingPointError: a channel or an observation is not finite; names the row and the craft.
    """
    for target in targets:
        if target.table is not None:
            check_table(config, target.table)
    rows = np.asarray(rows, np.int64)
    if not rows.size:
        raise ValueError("rows: got none; give the numbers of one row or more")
    seed = config.data.seed if seed is None else seed
    slots, kinds = config.flight.slots, len(config.target.airframes)
    numbers, place = np.unique(rows // slots, return_inverse=True)
    # Padding to a power of two keeps the number of compilations small.
    padded = np.pad(numbers, (0, (1 << (len(numbers) - 1).bit_length()) - len(numbers)), mode="edge")
    tracks = fly_many(streams.members(streams.key(seed, f"{domain}.flight"), padded), config.flight)
    material = streams.members(streams.key(seed, f"{domain}.material"), padded)
    share = np.asarray(jax.vmap(lambda key: jax.random.uniform(key, (2,)))(material))

    def between(span: tuple[float, float], value: np.ndarray) -> np.ndarray:
        return (span[0] + (span[1] - span[0]) * value).astype(np.float32)

    slot = rows % slots
    known = {
        "position": np.asarray(tracks.positions, np.float32)[place, slot],
        "rotation": np.asarray(tracks.rotations, np.float32)[place, slot],
        "permittivity": between(config.target.permittivity, share[place, 0]),
        "conductivity": between(config.target.conductivity_s_m, share[place, 1]),
    }
    craft = (rows // slots) % kinds
    parents = [streams.key(seed, f"{domain}.{name}") for name in ("points", "observation")]
    mesh = own_accelerators() if mesh is None else mesh
    together = _BATCH * mesh.size
    drawn: dict[str, np.ndarray] = {}
    for kind in np.unique(craft):
        mine = np.flatnonzero(craft == kind)
        craft_here = placed((targets[kind].scatterer, *targets[kind].surface), mesh, WHOLE)
        for start in range(0, len(mine), together):
            batch = mine[start : start + together]
            filled = np.pad(batch, (0, together - len(batch)), mode="edge")
            keys = tuple(streams.members(parent, rows[filled]) for parent in parents)
            own = placed((keys, {name: value[filled] for name, value in known.items()}), mesh, SPLIT)
            results = _compiled(*own, *craft_here, config, mesh)
            for name, value in results.items():
                store = drawn.setdefault(name, np.empty((len(rows), *value.shape[1:]), value.dtype))
                store[batch] = np.asarray(value)[: len(batch)]
    for name, value in drawn.items():
        if len(wrong := rows_not_finite(value)):
            kinds_here = ", ".join(sorted({targets[kind].airframe.name for kind in craft[wrong]}))
            raise FloatingPointError(
                f"rows: {name} of {len(wrong)} of {len(rows)} samples holds NaN or infinity, the first is row "
                f"{rows[wrong[0]]} (craft: {kinds_here}); take another data.solver or other craft"
            )
    counted = {"airframe": craft, "flight": rows // slots, "slot": slot}
    return Sample.of_columns(known | {name: value.astype(np.int32) for name, value in counted.items()} | drawn)


def fresh_samples(
    config: Config,
    flights: Int[np.ndarray, " n"],
    targets: Sequence[Target],
    *,
    seed: int,
    domain: Literal["evaluate", "validation"],
) -> Sample:
    """One sample of each of these flights (n,), slots and craft in turn, not observed; arguments as of
    :func:`generate`."""
    unheard, slots = replace(config, data=replace(config.data, observed=False)), config.flight.slots
    return generate(unheard, flights * slots + flights % slots, targets, seed=seed, domain=domain)


@partial(jax.jit, static_argnames=("config", "mesh"))
def _compiled(
    keys, known, scatterer: Table | Body | Cells, surface, cumulative, config: Config, mesh: Mesh
) -> dict[str, jax.Array]:
    made = partial(_made, config)
    return spread(made, mesh, (SPLIT, SPLIT, WHOLE, WHOLE, WHOLE), SPLIT)(keys, known, scatterer, surface, cumulative)


def _made(config: Config, keys, known, scatterer: Table | Body | Cells, surface, cumulative) -> dict[str, jax.Array]:
    def one(points_key, observation_key, row):
        channel = simulated_channel(
            config, scatterer, row["rotation"], row["position"], row["permittivity"], row["conductivity"]
        )
        points = sample_triangles(points_key, surface, cumulative, config.target.points) @ row["rotation"].T
        found = {"points": points, "true_channel": pack(channel)}
        if config.data.observed:
            predicted_key, level_key, echo_key = jax.random.split(observation_key, 3)
            predicted = draw_prediction(predicted_key, row["position"], config)
            seen = observe(
                echo_key,
                channel,
                predicted,
                array=config.array,
                signal=config.signal,
                region=config.region,
                **draw_level(level_key, config),
            )
            found |= Observed(
                predicted, seen.snr_db, seen.snr_estimate_db, seen.power_dbm, pack(seen.estimated_channel)
            )._asdict()
        return found

    return jax.vmap(one)(*keys, known)  # type: ignore[call-arg]  # keys are two
