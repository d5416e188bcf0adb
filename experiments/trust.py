"""Whether the posterior of a known craft means what it says, in its own world and in wrong ones.

    python experiments/trust.py compute [--small] [--count N] [--world NAME ...] [--snr DB ...] [--meshes DIR]
    python experiments/trust.py draw             reads experiments/results/trust.npz, writes trust.png

Fresh slots are drawn as ``august evaluate`` draws them, observed at 0, 10, 20 and 30 dB, and searched with
august_jax.inference. In the world ``same`` slots come from what the search assumes, but for the gain, which is one
(``drawn`` draws it, too). Levels of the truth among the posterior's samples (august_jax.evaluation.calibration) are
then uniform, regions of 50 and 90 % hold it in 50 and 90 % of the slots, and the best explanation found is no worse
than the one that is reached from the truth. In the other worlds slots come from something else: so far the posterior
can be trusted where the model is wrong, and so often ``explained`` says that it is.

Every slot is one line of JSON in a file of its world and preset in --lines: a run that was stopped goes on where it
was. Another estimator needs another folder. Five to eleven seconds a slot and SNR on two cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from script import run
from searched import SEED, Lines, columns, fresh, observed

from august_jax import streams
from august_jax.app.plotting import new_figure, save
from august_jax.config import Config, preset
from august_jax.data import Sample, Target, prepare_targets, unpack
from august_jax.data.observe import draw_prediction
from august_jax.evaluation import calibration, metrics
from august_jax.evaluation.explanations import arms
from august_jax.inference import Library, Posterior, Prior, find_craft, known_craft, refined
from august_jax.progress import Progress, TimeLeft
from august_jax.scene.airframes import Airframe
from august_jax.scene.mesh_files import FORMATS
from august_jax.schemes.matched_field import expected_errors
from august_jax.signal.station import Statistics

SNRS_DB = (0.0, 10.0, 20.0, 30.0)
COUNT = 300
NO_WORSE = 0.5
"""So much above what is reached from the truth may the best residual be and still count as found, in noise units."""
LABELS = {"along": "along the line of sight", "normal_x": "normal, x", "normal_y": "normal, y"}
"""Of ranks, in the picture."""
RANKS = ("x", "y", "z", "along", "normal_x", "normal_y", "permittivity", "conductivity")
"""Quantities whose ranks are kept; ``along`` is the position along the line of sight."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class World:
    """Where slots come from.

    Attributes:
        label: what is wrong in it.
        target: fields of ``target`` that differ from the library's.
        gain: complex gain of a slot, of its key.
        left_out: the library lacks the craft that flies.
    """

    label: str
    target: dict[str, Any] = field(default_factory=dict)
    gain: Callable[[jax.Array], complex] = lambda key: 1.0 + 0.0j
    left_out: bool = False


def drawn_gain(key: jax.Array) -> complex:
    """Of the prior: its level to 1 dB, its phase unknown."""
    level, turn = jax.random.split(key)
    decibels = float(jax.random.normal(level))
    return 10.0 ** (decibels / 20.0) * np.exp(1j * float(jax.random.uniform(turn, maxval=2.0 * np.pi)))


WORLDS = {
    "same": World("as the library has it"),
    "drawn": World("gain drawn from the prior", gain=drawn_gain),
    "unknown": World("a craft that the library lacks", left_out=True),
    "meshes": World("real craft, library of the procedural"),
    "permittivity": World("permittivity 6 to 8, library to 5", {"permittivity": (6.0, 8.0)}),
    "gain": World("gain off by 1 dB and 30 degrees", gain=lambda key: 10.0**0.05 * np.exp(1j * np.pi / 6.0)),
    "thin": World("skin of 1 mm, library 2 mm", {"skin_m": 1e-3}),
    "thick": World("skin of 3 mm, library 2 mm", {"skin_m": 3e-3}),
    "fine": World("cells of 8 mm, library 12 mm", {"cell_m": 8e-3, "max_cells": 4000}),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """What this experiment takes besides."""
    parser.add_argument("--count", type=int, help=f"slots of each SNR ({COUNT}; 3 with --small)")
    parser.add_argument("--world", dest="worlds", nargs="+", choices=WORLDS, default=("same",), metavar="NAME",
                        help=f"of {', '.join(WORLDS)} (%(default)s)")  # fmt: skip
    parser.add_argument(
        "--snr", dest="snrs_db", type=float, nargs="+", metavar="DB", help="in place of 0, 10, 20 and 30"
    )
    parser.add_argument("--meshes", type=Path, help="folder of the mesh files that fly in the world `meshes`")
    parser.add_argument("--lines", type=Path, default=Path("august_runs/trust"), help="slots done (%(default)s)")


def compute(
    small: bool,
    progress: Progress = print,
    count: int | None = None,
    worlds: Sequence[str] = ("same",),
    snrs_db: Sequence[float] | None = None,
    meshes: Path | None = None,
    lines: Path | None = None,
) -> dict[str, np.ndarray]:
    """Columns, one row a slot and SNR of every world that has lines in the folder ``lines`` or is asked for."""
    config = preset("smoke" if small else "laptop")
    count, snrs_db = count or (3 if small else COUNT), snrs_db or ((10.0, 30.0) if small else SNRS_DB)
    if "meshes" in worlds:
        _mesh_files(meshes)  # refused before the work
    targets = prepare_targets(config, progress)
    kept = {name: Lines(None if lines is None else lines / f"{config.preset}_{name}.jsonl") for name in WORLDS}
    for name in worlds:
        _explore(name, config, targets, count, snrs_db, meshes, kept[name], progress)
        progress(table({"crafts": np.array(len(targets)), **columns(kept[name].rows)}))
    return {"crafts": np.array(len(targets)), **columns(row for lines in kept.values() for row in lines.rows)}


def _mesh_files(folder: Path | None) -> tuple[str, ...]:
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in FORMATS) if folder else []
    if not files:
        raise SystemExit(f"--meshes: the world `meshes` needs a folder of mesh files, got {folder}; give one")
    return tuple(map(str, files))


def _explore(
    name: str,
    config: Config,
    targets: Sequence[Target],
    count: int,
    snrs: Sequence[float],
    meshes: Path | None,
    lines: Lines,
    progress: Progress,
) -> None:
    """Add the lines of a world that are not there."""
    world = WORLDS[name]
    target = replace(config.target, **world.target)
    flown = replace(
        config,
        target=target,
        region=replace(config.region, permittivity_max=max(config.region.permittivity_max, target.permittivity[1])),
    )
    flying = list(targets)
    if name == "meshes":
        flown = replace(flown, target=replace(flown.target, airframes=_mesh_files(meshes)))
    if flown.target != config.target:
        flying = prepare_targets(flown, progress)
    done = {(row["slot"], row["snr_db"]) for row in lines.rows}
    left = [(slot, snr) for slot in range(count) for snr in snrs if (slot, snr) not in done]
    if not left:
        return
    samples = fresh(flown, flying, count)
    libraries: dict[int | None, tuple[Library, Prior]] = {}
    clock = TimeLeft(len(left))
    for at, (slot, snr_db) in enumerate(left, 1):
        kind = int(samples.airframe[slot])
        without = kind if world.left_out else None
        if without not in libraries:
            known = [target for row, target in enumerate(targets) if row != without]
            names = tuple(craft for row, craft in enumerate(config.target.airframes) if row != without)
            own = replace(config, target=replace(config.target, airframes=names))
            libraries[without] = known_craft(own, known, progress=progress), Prior.from_config(own)
        lines.add({"world": name, **_looked(*libraries[without], samples, slot, snr_db, flying[kind].airframe, world)})
        time_left = clock.after_one()
        if at == len(left) or left[at][0] != slot:
            mine = [row for row in lines.rows if row["slot"] == slot]
            errors = ", ".join(f"{100.0 * row['error_m']:.1f} cm at {row['snr_db']:g} dB" for row in mine)
            progress(f"{name} {slot + 1}/{count}: {errors}  {clock.each_s:.1f} s each  {time_left}")


@streams.pin
def _looked(
    library: Library, prior: Prior, samples: Sample, slot: int, snr_db: float, airframe: Airframe, world: World
) -> dict[str, Any]:
    """A slot is observed and searched: a line of plain numbers."""
    gain_key, predicted_key, echo_key, reference_key = jax.random.split(
        streams.key(SEED, "evaluate.observation", slot), 4
    )
    truth = {
        name: np.asarray(getattr(samples, name)[slot])
        for name in ("position", "rotation", "permittivity", "conductivity")
    }
    place, normal = truth["position"].astype(float), truth["rotation"][:, 2].astype(float)
    predicted = draw_prediction(predicted_key, truth["position"], library.config)
    channel = jnp.complex64(world.gain(gain_key)) * unpack(jnp.asarray(samples.true_channel[slot]))
    statistics = observed(echo_key, channel, predicted, library.config, snr_db)
    sample_key = streams.key(SEED, "inference.samples", slot)
    found = find_craft(library, statistics, prior, key=sample_key)
    craft = library.names.index(airframe.name) if airframe.name in library.names else -1
    estimate, best = np.asarray(found.mean_position, float), found.hypotheses
    reference = np.asarray(predicted, float) + float(prior.half_m) * np.asarray(
        jax.random.uniform(reference_key, (3,), minval=-1.0, maxval=1.0), float
    )
    weights = np.asarray(found.weights, float)
    turn = truth["rotation"].T @ np.asarray(best.rotation[0])
    heading = np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    by_arms = 360.0 / arms(airframe)
    cloud = library.airframes[int(best.craft[0])].sample_surface(sample_key, len(samples.points[slot]))
    probabilities = np.asarray(found.craft_probability, float)
    line = {
        "slot": slot,
        "snr_db": snr_db,
        "craft": airframe.name,
        "named": library.names[int(np.argmax(probabilities))],
        "named_probability": float(probabilities.max()),
        "craft_probability": float(probabilities[craft]) if craft >= 0 else 0.0,
        "position": place.tolist(),
        "estimate": estimate.tolist(),
        "error_m": float(np.linalg.norm(estimate - place)),
        "best_error_m": float(np.linalg.norm(best.position[0] - place)),
        "prediction_error_m": float(np.linalg.norm(np.asarray(predicted) - place)),
        "normal_error": float(1.0 - np.asarray(found.mean_normal) @ normal),
        "best_normal_error": float(1.0 - best.rotation[0, :, 2] @ normal),
        "up_error": float(1.0 - UP @ normal),
        "heading_error_deg": float(abs(heading)),
        "heading_by_arms_deg": float(abs((heading + by_arms / 2.0) % by_arms - by_arms / 2.0)),
        "mcd_m2": float(metrics.shape_distance(cloud @ best.rotation[0].T, jnp.asarray(samples.points[slot]))),
        **dict(zip(("expected_error_m", "expected_normal_error"), map(float, expected_errors(found)))),
        "explanations": int(np.sum(np.asarray(best.weight) > 0.01)),
        "position_level": calibration.position_level(found.position, weights, place),
        "normal_level": calibration.normal_level(found.rotation[:, :, 2], weights, normal),
        "distance_level": calibration.distance_level(found.position, weights, place, reference),
        **{f"rank_{name}": value for name, value in _ranks(found, weights, truth, np.asarray(predicted)).items()},
        "effective": float(found.effective),
        "residual": float(found.residual),
        "degrees": int(found.degrees),
        "explained": bool(found.found),
        "probability": float(found.probability),
        "seconds": float(sum(found.seconds.values())),
        **{f"{stage}_s": float(value) for stage, value in found.seconds.items()},
    }
    return line | _from_truth(library, statistics, prior, craft, truth, found, place, normal)


def _from_truth(
    library: Library,
    statistics: Statistics,
    prior: Prior,
    craft: int,
    truth: dict[str, np.ndarray],
    found: Posterior,
    place: np.ndarray,
    normal: np.ndarray,
) -> dict[str, Any]:
    """What a search that starts at the truth comes to, where the library has the craft."""
    if craft < 0:
        return {"start_residual": np.nan, "start_error_m": np.nan, "start_normal_error": np.nan, "searched": False}
    pose = truth["rotation"], truth["position"]
    start, _ = refined(
        library, statistics, prior, craft, *pose, float(truth["permittivity"]), float(truth["conductivity"])
    )
    residual, rotation, position = (
        float(start.residual[0]),
        np.asarray(start.rotation[0]),
        np.asarray(start.position[0]),
    )
    return {
        "start_residual": residual,
        "start_error_m": float(np.linalg.norm(position - place)),
        "start_normal_error": float(1.0 - rotation[:, 2] @ normal),
        "searched": bool(found.residual <= residual + NO_WORSE),
    }


def _ranks(
    found: Posterior, weights: np.ndarray, truth: dict[str, np.ndarray], predicted: np.ndarray
) -> dict[str, float]:
    sight = predicted / np.linalg.norm(predicted)

    def numbers(position, rotation, permittivity):
        return [*np.moveaxis(position, -1, 0), position @ sight, rotation[..., 0, 2], rotation[..., 1, 2], permittivity]

    samples = numbers(np.asarray(found.position, float), np.asarray(found.rotation, float), found.permittivity)
    true = numbers(*(np.asarray(truth[name], float) for name in ("position", "rotation", "permittivity")))
    pairs = zip(RANKS, [*samples, found.conductivity], [*true, truth["conductivity"]], strict=True)
    return {name: calibration.rank(np.asarray(values), weights, float(own)) for name, values, own in pairs}


def table(numbers: dict[str, np.ndarray]) -> str:
    """Markdown: a row a world and SNR, shares and means with standard errors, what answers without an echo beside."""
    head = (
        "world", "SNR [dB]", "slots", "MPE [m]", "q_pre", "MDE", "up", "expects", "MCD [dB]", "craft", "believed",
        "chance", "from the truth", "found", "explained", "50 % place", "90 % place", "50 % normal", "90 % normal",
        "least p", "effective", "s",
    )  # fmt: skip
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    chance = 1.0 / int(numbers["crafts"])
    for world, snr, at in _groups(numbers):
        part = {name: values[at] for name, values in numbers.items() if name != "crafts"}
        count = int(at.sum())

        def mean(name, digits, part=part, count=count):
            error = part[name].std(ddof=1) / np.sqrt(count) if count > 1 else np.nan
            return f"{part[name].mean():.{digits}f} ± {error:.{digits}f}"

        def percent(pair):
            return f"{100.0 * pair[0]:.0f} ± {100.0 * pair[1]:.0f}"

        levels = [name for name in part if name.endswith("_level") or name.startswith("rank_")]
        least = min((calibration.uniformity(part[name])[1], name) for name in levels) if count > 1 else (np.nan, "")
        known = np.isfinite(part["start_residual"])
        told = [part.get(f"expected_{name}", np.full(count, np.nan)) for name in ("error_m", "normal_error")]
        whole = bool(np.all(np.isfinite(told)))  # of part of the slots a mean would say nothing
        cells = (
            world,
            f"{snr:g}",
            str(count),
            mean("error_m", 3),
            f"{part['prediction_error_m'].mean():.3f}",
            mean("normal_error", 4),
            f"{part['up_error'].mean():.3f}",
            f"{told[0].mean():.3f}, {told[1].mean():.4f}" if whole else "",
            f"{10.0 * np.log10(part['mcd_m2'].mean()):.1f}",
            percent(calibration.share(part["named"] == part["craft"])),
            f"{100.0 * part['named_probability'].mean():.0f}",
            f"{100.0 * chance:.0f}",
            f"{part['start_error_m'].mean():.3f}, {part['start_normal_error'].mean():.5f}" if known.all() else "",
            percent(calibration.share(part["searched"])) if known.all() else "",
            percent(calibration.share(part["explained"])),
            *(
                percent(calibration.coverage(part[f"{what}_level"], credibility))
                for what in ("position", "normal")
                for credibility in (0.5, 0.9)
            ),
            f"{least[0]:.2g} ({least[1].removeprefix('rank_')})",
            f"{np.median(part['effective']):.0f}",
            f"{np.median(part['seconds']):.1f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _groups(numbers: dict[str, np.ndarray]):
    """(world, SNR, rows) that have slots, in order."""
    for world in WORLDS:
        for snr in np.unique(numbers["snr_db"]):
            at = (numbers["world"] == world) & (numbers["snr_db"] == snr)
            if at.any():
                yield world, float(snr), at


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """The first world's ranks, coverage, reference points and errors; coverage and ``explained`` of all worlds."""
    print(table(results))
    groups = list(_groups(results))
    first = [(snr, at) for world, snr, at in groups if world == groups[0][0]]
    worlds = list(dict.fromkeys(world for world, *_ in groups))
    colors = ("#a63d7b", "#c8641b", "#3a8f5c", "#0a6ebd")
    fig = new_figure(16.0, 11.5)
    axes = fig.subplots(3, 4)
    bins = 10
    for axis, (snr, at) in zip(axes[0], first):
        count = int(at.sum())
        for row, name in enumerate(RANKS):
            counts = calibration.histogram(results[f"rank_{name}"][at], bins)
            axis.plot(
                (np.arange(bins) + 0.5) / bins,
                counts,
                "-",
                lw=1,
                marker="o",
                ms=2.5,
                color=f"C{row}",
                label=LABELS.get(name, name),
            )
        spread = 2.0 * np.sqrt(count / bins * (1.0 - 1.0 / bins))
        axis.axhspan(max(count / bins - spread, 0.0), count / bins + spread, color="0.9", zorder=0)
        axis.set(xlabel="rank of the truth", ylabel="slots", title=f"{snr:g} dB, {count} slots", ylim=(0.0, None))
    axes[0, 0].legend(fontsize=6, ncols=2)
    wanted = np.linspace(0.0, 1.0, 41)
    for axis, name, title in zip(
        axes[1],
        ("position_level", "normal_level", "distance_level"),
        ("ellipsoids of position", "cones of the normal", "balls about random points"),
    ):
        for (snr, at), color in zip(first, colors):
            covered = [calibration.coverage(results[name][at], credibility)[0] for credibility in wanted]
            axis.plot(wanted, covered, color=color, label=f"{snr:g} dB")
        error = 2.0 * np.sqrt(wanted * (1.0 - wanted) / max(int(first[0][1].sum()), 1))
        axis.fill_between(wanted, wanted - error, wanted + error, color="0.9", zorder=0)
        axis.set(xlabel="credibility", ylabel="share that holds the truth", title=title, xlim=(0, 1), ylim=(0, 1))
        axis.legend(fontsize=8)
    for axis, name, other, label in (
        (axes[1, 3], "error_m", "prediction_error_m", "position error [m]"),
        (axes[2, 0], "normal_error", "up_error", "1 - cos of the normal's error"),
    ):
        for (_, at), color in zip(first, colors):
            axis.plot(np.sort(np.maximum(results[name][at], 1e-7)), np.linspace(0, 1, int(at.sum())), color=color)
        at = first[-1][1]
        axis.plot(np.sort(np.maximum(results[other][at], 1e-7)), np.linspace(0, 1, int(at.sum())), color="0.5", ls="--")
        axis.set(xlabel=label, ylabel="share of slots below", xscale="log", ylim=(0, 1))
        axis.grid(True, alpha=0.3)
    axes[1, 3].set_title("errors; dashed: without an echo")
    step = 0.8 / len(worlds)
    for axis, value, title in (
        (
            axes[2, 1],
            lambda at: calibration.coverage(results["position_level"][at], 0.9),
            "90 % regions hold the place",
        ),
        (axes[2, 2], lambda at: calibration.share(results["explained"][at]), "told to be explained"),
        (axes[2, 3], lambda at: calibration.share(results["named"][at] == results["craft"][at]), "craft named rightly"),
    ):
        every = np.unique(results["snr_db"])
        for row, world in enumerate(worlds):
            mine = [(snr, *value(at)) for name, snr, at in groups if name == world]
            snrs, shares, errors = np.array(mine).T
            places = np.searchsorted(every, snrs) + step * row - 0.4 + step / 2.0
            axis.bar(
                places,
                shares,
                0.9 * step,
                yerr=errors,
                color=f"C{row}",
                label=WORLDS[world].label,
                error_kw={"lw": 0.8},
            )
        axis.set_xticks(np.arange(len(every)), [f"{snr:g} dB" for snr in every])
        axis.set(title=title, ylim=(0, 1))
    axes[2, 1].axhline(0.9, color="0.4", ls="--")
    axes[2, 3].axhline(1.0 / int(results["crafts"]), color="0.4", ls="--")
    handles, labels = axes[2, 2].get_legend_handles_labels()
    fig.legend(handles, labels, title="worlds", fontsize=8, ncols=5, loc="outside lower center")
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "trust", compute, draw, add_options)
