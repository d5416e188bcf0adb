"""What a search through the simulator costs: coefficients by every route, the first look, a slot by stages, memory.

    python benchmarks/inference.py --json inference.json
    python benchmarks/inference.py --parts routes slots                      only some of the parts below
    python benchmarks/inference.py --small                                   a few poses and two slots of `smoke`
    python benchmarks/inference.py --draw inference.json                     the tables of an earlier run again

Parts:

``slots``
    one echo searched, the stages apart; the first of the process, which compiles, and the later ones; at each SNR, with
    what the answers err by.
``routes``
    the channel, or the region's coefficients, of a craft in a pose: torchgdm, coupled solve by LU, factored body,
    table, survey, and about the craft's own place with and without derivatives. Called in turn; batches count per
    pose. The error beside each is relative, against the coupled solve of the same cells in complex128; that of the
    survey is what a complex factor leaves, because a search takes the gain out of it.
``screen``
    every attitude of every craft looked at once.
``tables``
    a table made anew, in memory and on the disk, and the largest memory of the process so far.
``craft``, ``candidates``, ``tones``
    a slot again with fewer craft, with finer and coarser attitudes, and with several tones (of one craft: bodies and
    tables of several tones are made for it).

Times are medians of what was called in turn, compilation left out, unless they say otherwise. torchgdm is no
dependency: `pip install torchgdm==0.61` adds its row. It is asked for the same number of cells, on the processor, but
solves cells that are filled to the edge, of other self-terms: no error is told for it. The first run factors and
tabulates the craft: minutes, told apart.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from common import Figures, machine, medians, parsed, write
from simulator import PEER, in_double, off, peer, single

from august_jax import streams
from august_jax.config import Config, override, preset
from august_jax.data import Sample, Target, contrast_of, generate, observed_anew, prepare_targets, tabulate_targets
from august_jax.inference import Library, Posterior, Prior, find_craft, known_craft
from august_jax.inference.screen import BLOCK, attitude_lattice, screen
from august_jax.physics import Parameters, body_channel, cache_folder, parameter_channel, sensing_channel, table_channel
from august_jax.physics.body.local import local_coefficients
from august_jax.physics.body.survey import nearest_directions, surveyed_coefficients
from august_jax.scene.trajectory import fly_many
from august_jax.signal import project
from august_jax.signal.station import Statistics

SEED = 17
_TILT_BEYOND_DEG = 1.0  # of a library's attitudes
_SPACING_HZ = 60e6  # of tones: the phase between neighbours repeats every 2.5 m
_BLOCKS = 64
_KEPT = 16_000  # of a first look, as a search keeps


@dataclass(frozen=True)
class Setting:
    """What all parts share."""

    args: argparse.Namespace
    config: Config
    targets: tuple[Target, ...]
    library: Library


def prepared(args: argparse.Namespace, figures: Figures) -> Setting:
    """Craft, bodies, tables: made, or read from the cache."""
    config = preset(args.preset)
    start = time.perf_counter()
    targets = prepare_targets(config)
    factoring = time.perf_counter() - start
    start = time.perf_counter()
    library = known_craft(config, targets, spacing_deg=args.spacing[-1])
    tabulating = time.perf_counter() - start
    figures["prepared"] = {
        "craft": list(library.names),
        "cells": [target.cells.count for target in library.targets],
        "antennas": config.array.count,
        "factoring_or_cache_s": factoring,
        "tabulating_or_cache_s": tabulating,
    }
    print(
        f"prepared {len(library.names)} craft: bodies {factoring:.0f} s, tables {tabulating:.0f} s, made or read",
        flush=True,
    )
    tables = [jax.tree.map(lambda leaf, row=row: leaf[row], library.table) for row in range(len(library.targets))]
    known = tuple(replace(target, table=table) for target, table in zip(library.targets, tables, strict=True))
    return Setting(args, config, known, replace(library, targets=known))


def memory() -> Figures:
    """The largest memory of the process so far, and of the accelerator [MB]."""
    found = {"peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}
    told = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in told:
        found["device_peak_mb"] = told["peak_bytes_in_use"] / 1e6
    return found


def size_mb(tree: Any) -> float:
    """Of a tree of arrays."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) / 1e6


def echoes(config: Config, targets: Sequence[Target], count: int, snr_db: float) -> tuple[Sample, list[Statistics]]:
    """Fresh slots, one of a flight each, and what the station keeps of their echoes."""
    numbers = np.arange(count)
    samples = generate(config, numbers * config.flight.slots, targets, seed=SEED, domain="evaluate")
    said = observed_anew(jax.random.key(SEED), samples, config, snr_db, statistics=True).statistics
    return samples, [jax.tree.map(lambda leaf, row=row: np.asarray(leaf[row]), said) for row in range(count)]


def searched(library: Library, samples: Sample, said: Sequence[Statistics]) -> list[Figures]:
    """A row a slot: wall time, the stages', and what the answer errs by; ``craft`` counts as the library's."""
    prior, rows = Prior.from_config(library.config), []
    for row, statistics in enumerate(said):
        start = time.perf_counter()
        found = find_craft(library, statistics, prior, key=jax.random.key(row))
        spent = time.perf_counter() - start
        rows.append({"wall_s": spent, "stages_s": dict(found.seconds), **judged(found, samples, row)})
    return rows


def judged(found: Posterior, samples: Sample, row: int) -> Figures:
    """What an answer errs by."""
    normal = np.asarray(samples.rotation[row])[:, 2]
    return {
        "error_m": float(np.linalg.norm(found.mean_position - samples.position[row])),
        "normal_error": float(1.0 - found.mean_normal @ normal),
        "craft_right": bool(np.argmax(found.craft_probability) == samples.airframe[row]),
        "explained": bool(found.explained),
        "effective": float(found.effective),
    }


def summed_up(rows: Sequence[Figures]) -> Figures:
    """Median and ends of the times of rows, and means of what they err by."""

    def spread(values):
        return {"median": float(np.median(values)), "least": float(np.min(values)), "most": float(np.max(values))}

    return {
        "slots": len(rows),
        "wall_s": spread([row["wall_s"] for row in rows]),
        "stages_s": {name: spread([row["stages_s"][name] for row in rows]) for name in rows[0]["stages_s"]},
        "error_m": float(np.mean([row["error_m"] for row in rows])),
        "normal_error": float(np.mean([row["normal_error"] for row in rows])),
        "craft_right": float(np.mean([row["craft_right"] for row in rows])),
        "explained": float(np.mean([row["explained"] for row in rows])),
    }


def line(what: str, summary: Figures) -> str:
    """A row of a search in words."""
    stages = ", ".join(f"{name} {values['median']:.2f}" for name, values in summary["stages_s"].items())
    wall = summary["wall_s"]
    return (
        f"{what}: {wall['median']:.2f} s ({wall['least']:.2f} to {wall['most']:.2f}; {stages}), place "
        f"{100.0 * summary['error_m']:.1f} cm off, craft right {100.0 * summary['craft_right']:.0f} %"
    )


def slots(made: Setting) -> Figures:
    """A slot, stage by stage: the first one, then the later ones at each SNR."""
    args, found = made.args, {"later": []}
    for snr_db in args.snr:
        samples, said = echoes(made.config, made.targets, args.slots, snr_db)
        if "first" not in found:
            [found["first"]] = searched(made.library, samples, said[:1])
            found["cached_compilation"] = bool(jax.config.jax_compilation_cache_dir)
            print(f"slots   the first: {found['first']['wall_s']:.1f} s, compilation counted", flush=True)
        summary = {"snr_db": snr_db, **summed_up(searched(made.library, samples, said))}
        found["later"].append(summary)
        print(line(f"slots   {snr_db:g} dB", summary), flush=True)
    return found


def routes(made: Setting) -> list[Figures]:
    """Every way to a pose's channel or coefficients, in turn, each with its error."""
    args, config, library, craft = made.args, made.config, made.library, 0
    subspace, target = library.subspace, made.targets[0]
    array, basis, tones = subspace.array, subspace.basis, config.array.frequencies_hz
    tracks = fly_many(jax.random.split(jax.random.key(SEED), args.batch), config.flight)
    turns, places = (jnp.asarray(part[:, 0], jnp.float32) for part in (tracks.rotations, tracks.positions))
    material = jnp.float32(1.0 + library.survey_contrast), jnp.float32(np.mean(config.target.conductivity_s_m))
    chi = contrast_of(config, *material)
    cells, body, table = single(target.cells), library.body(craft), library.table
    number, own_chi = jnp.int32(craft), chi[0] if body.single else chi

    def with_waves(turn, place):
        combine = jnp.swapaxes(subspace.waves(place).conj(), -1, -2)
        return table_channel(table, array, turn, place, own_chi, craft=craft, combine=combine)

    def about(derivatives):
        def one(turn, place):
            found = local_coefficients(table, array, basis, number, turn, place, *material, derivatives=derivatives)
            return found if derivatives else found.values

        return jax.jit(jax.vmap(one))

    dense = jax.jit(
        lambda turn, place: sensing_channel(array, cells.moved(turn, place), chi[:, None], frequencies_hz=tones)
    )
    batched = {
        "body": jax.jit(jax.vmap(lambda turn, place: body_channel(body, array, turn, place, own_chi))),
        "table": jax.jit(jax.vmap(lambda turn, place: table_channel(table, array, turn, place, own_chi, craft=craft))),
        "table, coefficients": jax.jit(jax.vmap(with_waves)),
        "local": about(False),
        "local, 8 derivatives": about(True),
    }
    survey = jax.jit(
        lambda place, directions, rotations: jax.lax.map(
            lambda each: surveyed_coefficients(library.survey, array, basis, place, number, *each),
            (directions, rotations),
        )
    )
    grid, blocks = library.survey.directions.shape[1], min(_BLOCKS, args.batch)
    looked = jnp.resize(jnp.asarray(library.attitudes), (blocks, BLOCK, 3, 3))
    directions = jnp.asarray(np.arange(blocks) % grid, jnp.int32)
    calls: dict[str, Callable[[], Any]] = {"LU": lambda: dense(turns[0], places[0])}
    calls |= {name: (lambda call=call: call(turns, places)) for name, call in batched.items()}
    calls["survey"] = lambda: survey(places[0], directions, looked)
    if PEER:
        solid = np.asarray(cells.moved(turns[0], places[0]).positions)
        calls["torchgdm"] = peer(solid, float(np.cbrt(cells.volumes[0])), array, complex(chi[0]))[0]
    times = medians(calls, args.repeats)
    counts = dict.fromkeys(batched, args.batch) | {"LU": 1, "torchgdm": 1, "survey": blocks * BLOCK}

    def exact(row):
        return in_double(
            target.cells,
            turns[row],
            places[row],
            lambda moved: sensing_channel(array, moved, np.asarray(chi)[:, None], frequencies_hz=tones),
        )

    def reduced(channel, place):
        """Coefficients about the place, the common phase of its distance left out."""
        wave = np.exp(-2j * np.mean(subspace.wavenumbers.astype(float)) * np.linalg.norm(np.asarray(place, float)))
        return np.asarray(project(jnp.asarray(channel * wave, jnp.complex64), place, subspace).values)

    def fitted(value, reference):
        """Error after a complex factor: what a survey leaves to the gain."""
        return off(value * np.vdot(value, reference) / np.vdot(value, value), reference)

    errors: dict[str, list[float]] = {name: [] for name in calls}
    everything = {name: jax.tree.map(np.asarray, call(turns, places)) for name, call in batched.items()}
    for row in range(min(args.references, args.batch)):
        turn, place = turns[row], places[row]
        whole = exact(row)
        small = reduced(whole, place)
        free = np.asarray(project(jnp.asarray(whole, jnp.complex64), place, subspace).values)
        errors["LU"].append(off(dense(turn, place), whole))
        for name, wanted in (("body", whole), ("table", whole), ("table, coefficients", free), ("local", small)):
            errors[name].append(off(everything[name][row].reshape(wanted.shape), wanted))
        errors["local, 8 derivatives"].append(off(everything["local, 8 derivatives"].values[row], small))
        sight = np.asarray(place / jnp.linalg.norm(place))
        nearest = nearest_directions(library.survey, craft, -sight @ np.asarray(turn)[None])
        one = survey(place, jnp.asarray(nearest, jnp.int32), jnp.broadcast_to(turn, (1, BLOCK, 3, 3)))
        errors["survey"].append(fitted(np.asarray(one)[0, :, 0], small))
    slopes = derivative_errors(made, turns, places, material, everything["local, 8 derivatives"].derivatives)
    rows = []
    for name in sorted(calls, key=lambda name: -times[name] / counts[name]):
        each = times[name] / counts[name]
        rows.append(
            {
                "route": name,
                "poses": counts[name],
                "seconds": each,
                "error_median": float(np.median(errors[name])) if errors[name] else None,
                "error_most": float(np.max(errors[name])) if errors[name] else None,
                "errors_of": len(errors[name]),
            }
        )
    by_name = {row["route"]: row for row in rows}
    by_name["local, 8 derivatives"]["derivative_errors"] = slopes
    for row in rows:
        for peer_name in ("torchgdm", "LU", "body"):
            if peer_name in by_name:
                row[f"{peer_name}_over_it"] = by_name[peer_name]["seconds"] / row["seconds"]
        error = "not measured" if row["error_median"] is None else f"{row['error_median']:.1e}"
        print(
            f"routes  {row['route']:22s} {1e6 * row['seconds']:12.1f} us a pose, error {error}, "
            f"{row['LU_over_it']:.1f} x as fast as LU, {row['body_over_it']:.1f} x as the body",
            flush=True,
        )
    return rows


def derivative_errors(made: Setting, turns, places, material, found) -> dict[str, float]:
    """Median relative errors of the derivatives in place, turn and material against those of the factored body."""
    subspace, body = made.library.subspace, made.library.body(0)
    k = jnp.asarray(subspace.wavenumbers)

    @jax.jit
    def slopes(turn, place):
        offset = place - jnp.asarray(subspace.positions)
        unit = jnp.mean(offset / jnp.linalg.norm(offset, axis=1, keepdims=True), axis=0)

        def parts(theta):
            channel = parameter_channel(body, subspace.array, Parameters.split(theta), turn, place, *material)
            path = jnp.linalg.norm(place) + unit @ theta[:3]
            values = project(channel * jnp.exp(-2j * jnp.mean(k) * path), place, subspace).values
            return jnp.stack([values.real, values.imag])

        real, imag = jax.jacfwd(parts)(jnp.zeros(10))
        return jnp.moveaxis(jax.lax.complex(real, imag), -1, 0)[:8]

    errors: dict[str, list[float]] = {"place": [], "turn": [], "material": []}
    for row in range(min(made.args.references, len(turns))):
        wanted = np.asarray(slopes(turns[row], places[row]))
        for name, part in zip(errors, (slice(0, 3), slice(3, 6), slice(6, 8)), strict=True):
            errors[name] += [off(found[row][each], wanted[each]) for each in range(8)[part]]
    return {name: float(np.median(values)) for name, values in errors.items()}


def looked_at(made: Setting) -> Figures:
    """The first look at an echo alone: poses screened a second."""
    library = made.library
    _, [statistics] = echoes(made.config, made.targets, 1, made.args.snr[-1])
    place, poses = np.asarray(statistics.centre), len(library.attitudes) * len(made.targets)
    keep = min(_KEPT, poses)
    said = jax.tree.map(jnp.asarray, statistics)
    call = {"screen": lambda: list(screen(library.survey, library.subspace, said, place, library.attitudes, keep))}
    spent = medians(call, made.args.repeats)["screen"]
    print(f"screen  {poses} poses in {spent:.2f} s: {poses / spent:.0f} a second", flush=True)
    return {"poses": poses, "seconds": spent, "poses_per_s": poses / spent}


def tables(made: Setting) -> Figures:
    """A table made anew, what it takes up, and the process's memory."""
    body, library = made.library.body(0), made.library
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, AUGUST_CACHE=folder):
        start = time.perf_counter()
        [table] = tabulate_targets(made.config, [body])
        jax.block_until_ready(table.responses)
        spent = time.perf_counter() - start
        disk = sum(path.stat().st_size for path in cache_folder().iterdir()) / 1e6
    errors = np.asarray(table.errors)
    found = {
        "seconds": spent,
        "disk_mb": disk,
        "memory_mb": size_mb(table),
        "library_mb": size_mb(library.table),
        "survey_mb": size_mb(library.survey),
        "error_median": float(errors[:, 0].max()),
        "error_95": float(errors[:, 1].max()),
        **memory(),
    }
    print(
        f"tables  one in {spent:.1f} s, compilation counted: {disk:.0f} MB on the disk, {found['memory_mb']:.0f} MB in "
        f"memory, errors {found['error_median']:.1e} (median), {found['error_95']:.1e} (95 %); the library "
        f"{found['library_mb']:.0f} and {found['survey_mb']:.0f} MB; the process at most {found['peak_rss_mb']:.0f} MB",
        flush=True,
    )
    return found


def again(library: Library, samples: Sample, said: Sequence[Statistics]) -> Figures:
    """The times of slots after one that compiles."""
    searched(library, samples, said[:1])
    summary = summed_up(searched(library, samples, said))
    jax.clear_caches()
    gc.collect()
    return summary


def with_craft(made: Setting) -> list[Figures]:
    """A slot of the first craft among the first so many."""
    rows, first = (
        [],
        replace(made.config, target=replace(made.config.target, airframes=made.config.target.airframes[:1])),
    )
    samples, said = echoes(first, made.targets[:1], made.args.slots, made.args.snr[-1])
    for count in sorted({min(count, len(made.targets)) for count in made.args.craft}):
        names = made.config.target.airframes[:count]
        config = replace(made.config, target=replace(made.config.target, airframes=names))
        library = known_craft(config, made.targets[:count], spacing_deg=made.args.spacing[-1])
        summary = again(library, samples, said)
        rows.append({"craft": count, "poses": count * len(library.attitudes), **summary})
        print(line(f"craft   {count}", summary), flush=True)
    return rows


def with_candidates(made: Setting) -> list[Figures]:
    """A slot after a coarser or a finer first look."""
    rows, (samples, said) = [], echoes(made.config, made.targets, made.args.slots, made.args.snr[-1])
    for spacing in made.args.spacing:
        attitudes = attitude_lattice(made.config.flight.tilt_deg + _TILT_BEYOND_DEG, spacing)
        summary = again(replace(made.library, attitudes=attitudes), samples, said)
        rows.append({"spacing_deg": spacing, "poses": len(made.targets) * len(attitudes), **summary})
        print(line(f"poses   {rows[-1]['poses']} ({spacing:g} degrees apart)", summary), flush=True)
    return rows


def with_tones(made: Setting) -> list[Figures]:
    """A slot of the first craft, the only one that is known, with so many tones about the carrier."""
    rows, carrier = [], made.config.array.frequency_hz
    for count in made.args.tones:
        offsets = _SPACING_HZ * (np.arange(count) - (count - 1) / 2.0)
        tones = [] if count == 1 else [float(carrier + offset) for offset in offsets]
        words = [f"array.tones_hz={tones}", f"target.airframes=[{made.config.target.airframes[0]}]"]
        config = override(made.config, words)
        start = time.perf_counter()
        targets = prepare_targets(config)
        library = known_craft(config, targets, spacing_deg=made.args.spacing[-1])
        spent = time.perf_counter() - start
        samples, said = echoes(config, targets, made.args.slots, made.args.snr[-1])
        summary = again(library, samples, said)
        sizes = {"preparing_or_cache_s": spent, "table_mb": size_mb(library.table)}
        rows.append({"tones": count, "poses": len(library.attitudes), **sizes, **summary})
        print(line(f"tones   {count}", summary), flush=True)
    return rows


PARTS: dict[str, Callable[[Setting], Any]] = {
    "slots": slots,
    "screen": looked_at,
    "tables": tables,
    "routes": routes,
    "craft": with_craft,
    "candidates": with_candidates,
    "tones": with_tones,
}


def markdown(figures: Figures) -> str:
    """The figures as tables for `docs/results.md`."""
    parts = []

    def add(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        parts.append("\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)))

    def spread(values: Figures) -> str:
        return f"{values['median']:.2f} ({values['least']:.2f} to {values['most']:.2f})"

    def answers(row: Figures) -> list[str]:
        return [f"{row['error_m']:.3f}", f"{row['normal_error']:.4f}", f"{100.0 * row['craft_right']:.0f}"]

    if "routes" in figures:
        rows = []
        for row in figures["routes"]:
            error = "-"
            if row["error_median"] is not None:
                error = f"{row['error_median']:.1e}, {row['error_most']:.1e}"
            if "derivative_errors" in row:
                error += "; of derivatives " + ", ".join(
                    f"{value:.1e} ({name})" for name, value in row["derivative_errors"].items()
                )
            ratios = [
                f"{row[f'{name}_over_it']:.3g}" if f"{name}_over_it" in row else "-"
                for name in ("torchgdm", "LU", "body")
            ]
            rows.append([row["route"], _time(row["seconds"]), f"{1.0 / row['seconds']:.3g}", error, *ratios])
        add(
            ["route", "a pose", "a second", "error: median, worst", "times torchgdm", "times LU", "times the body"],
            rows,
        )
    if "screen" in figures:
        row = figures["screen"]
        parts.append(
            f"The first look takes {row['seconds']:.2f} s for {row['poses']} poses, {row['poses_per_s']:.0f} a second."
        )
    if "slots" in figures:
        found = figures["slots"]
        stages = list(found["later"][0]["stages_s"])
        rows = [
            [
                f"{row['snr_db']:g}",
                str(row["slots"]),
                spread(row["wall_s"]),
                *(spread(row["stages_s"][stage]) for stage in stages),
                *answers(row),
            ]
            for row in found["later"]
        ]
        first = found["first"]
        rows.append(
            [
                "the first, compiled",
                "1",
                f"{first['wall_s']:.1f}",
                *(f"{first['stages_s'][stage]:.1f}" for stage in stages),
                *["-"] * 3,
            ]
        )
        add(["SNR [dB]", "slots", "in all [s]", *stages, "MPE [m]", "MDE", "craft [%]"], rows)
    if "tables" in figures:
        row = figures["tables"]
        parts.append(
            f"A table: {row['seconds']:.0f} s, {row['disk_mb']:.0f} MB on the disk, {row['memory_mb']:.0f} MB in "
            f"memory, errors {row['error_median']:.1e} (median) and {row['error_95']:.1e} (95 %). The library's tables "
            f"are {row['library_mb']:.0f} MB, its survey {row['survey_mb']:.0f} MB; the process took at most "
            f"{row['peak_rss_mb'] / 1e3:.1f} GB"
            + (f", the accelerator {row['device_peak_mb'] / 1e3:.1f} GB." if "device_peak_mb" in row else ".")
        )
    for part, name in (("craft", "craft"), ("candidates", "attitudes apart [deg]"), ("tones", "tones (one craft)")):
        if part in figures:
            stages = list(figures[part][0]["stages_s"])
            key = {"craft": "craft", "candidates": "spacing_deg", "tones": "tones"}[part]
            rows = [
                [
                    f"{row[key]:g}",
                    str(row["poses"]),
                    spread(row["wall_s"]),
                    *(f"{row['stages_s'][stage]['median']:.2f}" for stage in stages),
                    *answers(row),
                ]
                for row in figures[part]
            ]
            add([name, "poses looked at", "in all [s]", *stages, "MPE [m]", "MDE", "craft [%]"], rows)
    return "\n\n".join(parts)


def _time(seconds: float) -> str:
    """With a unit that suits it."""
    unit, scale = next((pair for pair in (("s", 1.0), ("ms", 1e3)) if seconds * pair[1] >= 1.0), ("us", 1e6))
    return f"{seconds * scale:.3g} {unit}"


SMALL = {
    "preset": "smoke", "batch": 8, "references": 2, "repeats": 1, "slots": 2, "snr": [30.0], "craft": [1, 2],
    "spacing": [16.0, 12.0], "tones": [1, 2],
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--small", action="store_true", help="small values of all that follows, to see that it runs")
    parser.add_argument("--preset", default="laptop", help="whose craft and flights (%(default)s)")
    parser.add_argument("--batch", type=int, default=128, help="poses of a call of routes")
    parser.add_argument("--references", type=int, default=16, help="coupled solves in complex128 that tell errors")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--slots", type=int, default=6, help="that are searched for each figure")
    parser.add_argument(
        "--snr", type=float, nargs="+", default=[10.0, 20.0, 30.0], help="dB; craft and others: the last"
    )
    parser.add_argument("--craft", type=int, nargs="+", default=[1, 3, 5])
    parser.add_argument(
        "--spacing", type=float, nargs="+", default=[6.4, 4.5, 3.2], help="degrees; all but candidates: the last"
    )
    parser.add_argument("--tones", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--draw", help="print the tables of the figures in this file, and measure nothing")
    args = parsed(parser)
    if args.draw:
        print(markdown(json.loads(Path(args.draw).read_text())))
        return
    if args.small:
        vars(args).update(SMALL)
    with streams.pinned():
        figures: Figures = {"machine": machine(), "preset": args.preset}
        made = prepared(args, figures)
        for part in args.parts:
            figures[part] = PARTS[part](made)
            figures["memory"] = memory()
            write(args, figures)
    print(f"\n{markdown(figures)}")


if __name__ == "__main__":
    main()
