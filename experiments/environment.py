"""What a ground and a wall do to a search that does not know them, and what it would be worth to know them.

    python experiments/environment.py compute [--small] [--count N] [--case NAME ...] [--level L ...] [--snr DB ...]
    python experiments/environment.py draw       reads experiments/results/environment.npz, writes environment.png

The slots of ``august evaluate`` are heard beside a ground 1.5 m below the array, a wall 2 to 6 m beside the craft, or
both, which reflect with the constant coefficient minus ``level`` (0 is free space, -1 a perfect conductor; dry soil of
permittivity 9 reflects a third of the field at these flights' angles). `Blind` is august_jax.inference as it is: its
library knows free space alone. `Known` starts from what the blind search found, its two heaviest hypotheses, and
descends, as that search does, on the factored body beside the planes (august_jax.physics.environment_channel); the one
that ends lowest answers. Valleys are narrow: what such descents miss and one from the truth finds was there to find. A
whole search beside planes would need tables of all pairs of directions, array and image, and a subspace of both: that
is not built. The bound (august_jax.physics.information, with the planes) says what an estimator that knows them could
do.

Every search is one line of JSON in a file of its preset in --lines: a run that was stopped goes on where it was. A
search takes five to eleven seconds on two cores, as in experiments/trust.py, and twice as many more where nothing
explains the echo and it is made again with more patience; the descents add as much. 8 slots, free space, and 3 levels
in 2 cases are 56 searches, some twenty minutes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from script import run
from searched import SEED, Lines, columns, fresh, observed

from august_jax import streams
from august_jax.app.plotting import new_figure, save
from august_jax.config import Config, preset, to_dict
from august_jax.data import Sample, Target, prepare_targets
from august_jax.data.observe import draw_prediction
from august_jax.data.simulator import contrast_of
from august_jax.evaluation import calibration
from august_jax.evaluation.bound import spread_of
from august_jax.inference import Library, Posterior, Prior, find_craft, known_craft
from august_jax.inference.echo import chance, degrees_left
from august_jax.inference.refine import EASIER, FIRST, SCALES
from august_jax.physics import (
    Parameters,
    PlanarArray,
    Plane,
    environment_channel,
    fisher_information,
    mean_position_error,
    moved,
    parameter_channel,
    tilt_bound,
)
from august_jax.progress import Progress, TimeLeft
from august_jax.schemes.matched_field import expected_errors
from august_jax.signal.roi import project
from august_jax.signal.station import Statistics, codebook

COUNT = 8
LEVELS = (0.0, 0.1, 0.3, 0.7)
SNRS_DB = (30.0,)
USUAL = ("ground", "ground and wall")
GROUND_M, WALL_M = -1.5, 9.0
"""Height of the ground and x of the wall, from the array's centre."""
CASES = {"ground": ("ground",), "wall": ("wall",), "ground and wall": ("ground", "wall")}
STARTS, STEPS = 2, 12
"""Hypotheses of the blind search from which `Known` starts, and its steps."""
BEYOND_M = 0.2
"""Beyond the region a descent may go so far, as a search's may."""
UP = np.array([0.0, 0.0, 1.0])
LOOKS = {
    "": ("search, planes unknown", "#0072b2", "o", "-"),
    "known_": ("descents from there, planes known", "#d55e00", "s", "--"),
    "truth_": ("a descent from the truth, planes known", "#009e73", "^", ":"),
}  # colours that the colour-blind tell apart
"""Prefix of columns -> label, colour, marker and style."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """What this experiment takes besides."""
    parser.add_argument("--count", type=int, help=f"slots ({COUNT}; 2 with --small)")
    parser.add_argument("--case", dest="cases", nargs="+", choices=CASES, metavar="NAME",
                        help=f"of {', '.join(map(repr, CASES))} (first and last; first with --small)")  # fmt: skip
    parser.add_argument("--level", dest="levels", type=float, nargs="+", metavar="L",
                        help=f"from 0 to 1 ({', '.join(map(str, LEVELS))}; 0 and 0.5 with --small)")  # fmt: skip
    parser.add_argument("--snr", dest="snrs_db", type=float, nargs="+", metavar="DB", help="in place of 30")
    parser.add_argument(
        "--lines", type=Path, default=Path("august_runs/environment"), help="what is done (%(default)s)"
    )


def compute(
    small: bool,
    progress: Progress = print,
    count: int | None = None,
    cases: Sequence[str] | None = None,
    levels: Sequence[float] | None = None,
    snrs_db: Sequence[float] | None = None,
    lines: Path | None = None,
) -> dict[str, np.ndarray]:
    """Columns, one row a case, level, slot and SNR of all that has lines in the folder ``lines`` or is asked for."""
    config = preset("smoke" if small else "laptop")
    count, snrs = count or (2 if small else COUNT), snrs_db or ((30.0,) if small else SNRS_DB)
    levels = sorted({0.0, *(levels or ((0.5,) if small else LEVELS))})  # beside free space the others are compared
    kept = Lines(None if lines is None else lines / f"{config.preset}.jsonl")
    done = {(row["case"], row["level"], row["slot"], row["snr_db"]) for row in kept.rows}
    left = [
        (slot, case, float(level), float(snr))
        for slot in range(count)
        for case in cases or USUAL[: 1 if small else 2]
        for level in levels
        for snr in snrs
        if (case, level, slot, snr) not in done
    ]
    if left:
        scene = _Scene.prepared(config, max(slot for slot, *_ in left) + 1, progress)
    clock = TimeLeft(len(left))
    for at, (slot, case, level, snr_db) in enumerate(left, 1):
        same = (
            row for row in kept.rows if level == row["level"] == 0.0 and (row["slot"], row["snr_db"]) == (slot, snr_db)
        )
        found = next(same, None) or scene.looked(slot, snr_db, _planes(case, level))  # free space is that of all cases
        kept.add({**found, "case": case, "level": level, "slot": slot, "snr_db": snr_db})
        time_left = clock.after_one()
        if at == len(left) or left[at][:3] != (slot, case, level):
            row = kept.rows[-1]
            progress(
                f"slot {slot + 1} of {count}, {case} at {level:g}: blind {100.0 * row['error_m']:.1f} cm, known "
                f"{100.0 * row['known_error_m']:.1f} cm, bound {100.0 * row['bound_m']:.1f} cm at {snr_db:g} dB  "
                f"{clock.each_s:.1f} s each  {time_left}"
            )
    settings = {
        "small": small,
        "ground_m": GROUND_M,
        "wall_m": WALL_M,
        "starts": STARTS,
        "steps": STEPS,
        "configuration": to_dict(config),
    }
    results = {**columns(kept.rows), "crafts": np.array(len(config.target.airframes))}
    return {**results, "settings": np.array(json.dumps(settings))}


def _planes(case: str, level: float) -> tuple[Plane, ...]:
    """Of z-polarised antennas a ground of -1 doubles the field along itself, a wall of -1 takes it away."""
    known = {
        "ground": Plane([0.0, 0.0, GROUND_M], [0.0, 0.0, 1.0], coefficient=-level),
        "wall": Plane([WALL_M, 0.0, 0.0], [-1.0, 0.0, 0.0], coefficient=-level),
    }
    return tuple(known[name] for name in CASES[case])


class _Scene(NamedTuple):
    """Slots and all that is known of the craft."""

    config: Config
    targets: Sequence[Target]
    library: Library
    prior: Prior
    samples: Sample

    @classmethod
    def prepared(cls, config: Config, count: int, progress: Progress) -> _Scene:
        targets = prepare_targets(config, progress)
        library = known_craft(config, targets, progress=progress)
        return cls(config, targets, library, Prior.from_config(config), fresh(config, targets, count))

    @streams.pin
    def looked(self, slot: int, snr_db: float, planes: tuple[Plane, ...]) -> dict[str, Any]:
        """A slot beside planes is observed and searched: a line of plain numbers. Prediction and noise are drawn alike
        whatever the planes and the SNR are."""
        truth = self.samples.at(slice(slot, slot + 1)).each(np.asarray)
        place, rotation = truth.position[0].astype(float), truth.rotation[0].astype(float)
        kind, array = int(truth.airframe[0]), PlanarArray.from_config(self.config.array)
        body = self.targets[kind].body
        chi = np.asarray(contrast_of(self.config, float(truth.permittivity[0]), float(truth.conductivity[0])))
        pose = (truth.rotation[0], truth.position[0], chi[0] if body.single else chi)
        free, channel = (
            np.asarray(environment_channel(body, array, *pose, each)).reshape(-1, array.count, array.count)
            for each in ((), planes)
        )
        predicted_key, echo_key = jax.random.split(streams.key(SEED, "evaluate.observation", slot))
        predicted = draw_prediction(predicted_key, truth.position[0], self.config)
        statistics = observed(echo_key, jnp.asarray(channel), predicted, self.config, snr_db)
        found = find_craft(self.library, statistics, self.prior, key=streams.key(SEED, "inference.samples", slot))
        named = self.library.names[int(np.argmax(found.craft_probability))]
        line = {
            "craft": self.targets[kind].airframe.name,
            "named": named,
            "added": float(np.linalg.norm(channel - free) / np.linalg.norm(free)),
            "error_m": float(np.linalg.norm(found.mean_position - place)),
            "prediction_error_m": float(np.linalg.norm(np.asarray(predicted) - place)),
            "normal_error": float(1.0 - found.mean_normal @ rotation[:, 2]),
            "up_error": float(1.0 - UP @ rotation[:, 2]),
            **dict(zip(("expected_error_m", "expected_normal_error"), map(float, expected_errors(found)))),
            "craft_probability": float(found.craft_probability[kind]),
            "explained": bool(found.found),
            "probability": float(found.probability),
            "seconds": float(sum(found.seconds.values())),
        }
        began = time.monotonic()
        line |= self._known(statistics, found, planes, place, rotation[:, 2])
        end = self._descended(
            statistics,
            kind,
            (truth.rotation[0], truth.position[0]),
            (float(truth.permittivity[0]), float(truth.conductivity[0])),
            planes,
        )
        line |= {
            "truth_error_m": float(np.linalg.norm(end.position - place)),
            "truth_normal_error": float(1.0 - end.rotation[:, 2] @ rotation[:, 2]),
            "truth_explained": bool(chance(end.residual, degrees_left(statistics)) >= found.level),
        }
        return line | {"known_s": time.monotonic() - began} | self._bound(truth, np.asarray(predicted), snr_db, planes)

    def _known(
        self, statistics: Statistics, found: Posterior, planes: tuple[Plane, ...], place: np.ndarray, normal: np.ndarray
    ) -> dict[str, Any]:
        """The lowest end of descents beside known planes."""
        start = found.hypotheses
        ends = [
            self._descended(
                statistics,
                int(start.craft[row]),
                (start.rotation[row], start.position[row]),
                (float(start.permittivity[row]), float(start.conductivity[row])),
                planes,
            )
            for row in range(min(STARTS, len(start.craft)))
        ]
        end = min(ends, key=lambda each: each.cost)
        probability = chance(end.residual, degrees_left(statistics))
        return {
            "known_error_m": float(np.linalg.norm(end.position - place)),
            "known_normal_error": float(1.0 - end.rotation[:, 2] @ normal),
            "known_named": self.library.names[end.craft],
            "known_explained": bool(found.heard and probability >= found.level),
            "known_probability": probability,
            "known_cost": end.cost,
            "known_start_cost": end.start_cost,
        }

    def _descended(
        self,
        statistics: Statistics,
        craft: int,
        start: tuple[np.ndarray, np.ndarray],
        material: tuple[float, float],
        planes: tuple[Plane, ...],
    ) -> _End:
        """Levenberg-Marquardt in the ten numbers of august_jax.physics.parameters, from a craft, a rotation and a
        place, a permittivity and a conductivity [S/m]."""
        prior = self.prior
        pose = np.asarray(start[0], np.float32), np.asarray(start[1], np.float32)
        rest = np.array([*material, 0.0, 0.0])  # and log-gain and phase
        precision, scales = 1.0 / np.asarray(prior.spreads(), float) ** 2, np.asarray(SCALES, float)
        middle = np.array([*map(float, prior.middle()), 0.0])
        ranges = np.asarray([prior.permittivity, prior.conductivity], float)
        centre, received = np.asarray(statistics.centre, float), np.asarray(statistics.received).reshape(-1)

        def judged(pose, rest):
            model, slopes = map(
                np.asarray, _heard(self.library.body(craft), self.library.subspace, statistics, planes, *pose, *rest)
            )
            left = received - model
            apart = np.concatenate([pose[1] - centre, np.zeros(3), rest[:3] - middle, [0.0]])
            residual = float(np.sum(np.abs(left) ** 2))
            information = 2.0 * np.real(slopes @ slopes.conj().T) + np.diag(precision)
            slope = 2.0 * np.real(slopes.conj() @ left) - precision * apart
            return residual, residual + 0.5 * float(precision @ apart**2), information, slope, model

        rest[3] = np.angle(np.vdot(judged(pose, rest)[4], received))
        now = judged(pose, rest)
        start_cost, damping = now[1], FIRST
        for _ in range(STEPS):
            system = now[2] * scales * scales[:, None]
            step = scales * np.linalg.solve(system + damping * np.diag(np.diag(system)), scales * now[3])
            step[3:6] *= min(1.0, 0.2 / max(np.linalg.norm(step[3:6]), 1e-9))  # a model is linear for ten degrees
            turned, place = moved(Parameters(jnp.asarray(step[:3], jnp.float32), jnp.asarray(step[3:6], jnp.float32)),
                                  *pose)  # fmt: skip
            reach = float(prior.half_m) + BEYOND_M
            tried_pose = (
                np.asarray(turned),
                np.clip(np.asarray(place), centre - reach, centre + reach).astype(np.float32),
            )
            tried_rest = rest + step[6:]
            tried_rest[:2] = np.clip(tried_rest[:2], *ranges.T)
            tried = judged(tried_pose, tried_rest)
            better = tried[1] <= now[1]
            if better:
                pose, rest, now = tried_pose, tried_rest, tried
            damping *= EASIER if better else 8.0
        return _End(craft, pose[0].astype(float), pose[1].astype(float), now[0], now[1], start_cost)

    def _bound(
        self, truth: Sample, predicted: np.ndarray, snr_db: float, planes: tuple[Plane, ...]
    ) -> dict[str, float]:
        """Of an estimator that knows craft and planes, as august_jax.evaluation.bound has it in free space."""
        config, target = self.config, self.targets[int(truth.airframe[0])]
        assert target.body is not None
        array = PlanarArray.from_config(config.array)
        book = np.asarray(codebook(jnp.asarray(predicted), config.array, config.signal))
        known = fisher_information(
            target.body,
            array,
            truth.rotation,
            truth.position,
            truth.permittivity,
            truth.conductivity,
            10.0 ** (snr_db / 10.0) * (config.signal.symbols or array.count) / array.count,
            illumination=(book @ book.conj().T)[None],
            planes=planes,
        )
        spread = spread_of(config)
        tilt = tilt_bound(known, truth.rotation[:, :, 2].astype(float), spread)
        return {"bound_m": float(mean_position_error(known, spread)[0]), "bound_mde": float(0.5 * tilt[0] ** 2)}


class _End(NamedTuple):
    """Where a descent ends, what it leaves, and what it cost at its start."""

    craft: int
    rotation: np.ndarray
    position: np.ndarray
    residual: float
    cost: float
    start_cost: float


@partial(jax.jit, static_argnames="subspace")
def _heard(body, subspace, statistics, planes, rotation, position, permittivity, conductivity, log_gain, phase):
    """What is heard of a craft beside planes, in units of the noise (F K K,), and its derivatives (10, F K K).

    The phase of the way there and back is taken out, as it is of a search's candidates: the gain has it.
    """

    def model(theta):
        change = Parameters.split(theta)
        channel = parameter_channel(
            body, subspace.array, change, rotation, position, permittivity, conductivity, planes=planes
        )
        away = jnp.linalg.norm(position + change.position)
        gain = jnp.exp(log_gain + 1j * (phase - 2.0 * np.mean(subspace.wavenumbers) * away))
        return (gain * project(channel, statistics.centre, subspace).values @ statistics.pilots).reshape(-1)

    start = jnp.zeros(10, jnp.float32)
    value, linear = jax.linearize(model, start)
    return value, jax.lax.map(linear, jnp.eye(10, dtype=jnp.float32))


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Errors, named craft and explained echoes over the coefficient's modulus, a column a case."""
    settings = json.loads(str(results["settings"]))
    cases = [case for case in CASES if np.any(results["case"] == case)]
    snrs = np.unique(results["snr_db"])
    fig = new_figure(7.16, 7.4)
    axes = fig.subplots(4, len(cases), sharex=True, sharey="row", squeeze=False)
    for column, case in enumerate(cases):
        for number, snr in enumerate(snrs):
            at = (results["case"] == case) & (results["snr_db"] == snr)
            levels = np.unique(results["level"][at])
            rows = [at & (results["level"] == level) for level in levels]
            tell = f", {snr:g} dB" if len(snrs) > 1 else ""
            for own, (label, colour, marker, line) in LOOKS.items():
                style = {"label": f"{label}{tell}", "color": colour, "marker": marker, "ls": line, "ms": 3.5, "lw": 1.1,
                         "capsize": 1.5, "alpha": (number + 1) / len(snrs)}  # fmt: skip
                for row, name in enumerate(("error_m", "normal_error")):
                    values = [results[f"{own}{name}"][mine] for mine in rows]
                    middle = np.array([np.mean(each) for each in values])
                    spread = np.array([np.std(each) / np.sqrt(max(len(each) - 1, 1)) for each in values])
                    bars = (np.minimum(spread, 0.7 * middle), spread)
                    axes[row, column].errorbar(levels, np.maximum(middle, 1e-7), bars, **style)
                shown = [(3, results[f"{own}explained"])]
                if own != "truth_":
                    shown.append((2, results[f"{own}named"] == results["craft"]))
                for row, holds in shown:
                    shares, errors = np.array([calibration.share(holds[mine]) for mine in rows]).T
                    bars = (np.minimum(errors, shares), np.minimum(errors, 1.0 - shares))
                    axes[row, column].errorbar(levels, shares, bars, **style)
            for row, bound in enumerate(("bound_m", "bound_mde")):
                least = [np.mean(results[bound][mine]) for mine in rows]
                axes[row, column].plot(
                    levels, least, color="black", ls="-.", lw=1.0, label=f"bound, planes known{tell}"
                )
        for row, level in enumerate(
            (np.mean(results["prediction_error_m"]), np.mean(results["up_error"]), 1.0 / float(results["crafts"]))
        ):
            axes[row, column].axhline(level, color="#555555", ls="--", lw=1.0, label="without an echo")
        axes[0, column].set_title(case, fontsize=8)
        axes[3, column].set_xlabel("modulus of the coefficient", fontsize=8)
    for row, label in enumerate(
        ("position error [m]", "1 - cos of the\nnormal's error", "craft named rightly", "told to be explained")
    ):
        axes[row, 0].set_ylabel(label, fontsize=8)
        for axis in axes[row]:
            axis.grid(True, lw=0.4, color="0.88")
            axis.tick_params(labelsize=7)
            axis.spines[["top", "right"]].set_visible(False)
            axis.set(ylim=(-0.05, 1.05)) if row > 1 else axis.set_yscale("log")
    named = dict(zip(*reversed(axes[0, 0].get_legend_handles_labels())))
    fig.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=6.5)
    slots, crafts = len(np.unique(results["slot"])), int(results["crafts"])
    heard = f"{' and '.join(f'{snr:g}' for snr in snrs)} dB"
    fig.suptitle(f"{slots} slots at {heard}, {crafts} known craft{', small' if settings['small'] else ''}",
                 fontsize=8)  # fmt: skip
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "environment", compute, draw, add_options)
