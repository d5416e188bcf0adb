"""An answer against the truth: every metric that the answer defines, and the errors of a track slot by slot."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from august_jax import streams
from august_jax.config import Config
from august_jax.evaluation import calibration, metrics
from august_jax.inference import Hypotheses, Step
from august_jax.scene.airframes import resolve_airframe
from august_jax.scene.cloud import WorldCloud
from august_jax.schemes import SCHEMES, Answer, Setting, Slots, Truth
from august_jax.schemes.matched_field import Found, Search
from august_jax.tracking import Track, cloud_normals

Row = dict[str, Any]
"""A line of a table: names and plain values."""

NOTE = (
    "MPE: mean distance between true and estimated position. MDE: mean of 1 - cos between true and estimated normal. "
    "MCD: squared distance to the nearest neighbour, both ways, of clouds about their own means; WD adds the squared "
    "position error; both in dB re 1 m^2."
)


def score(answer: Answer, truth: Truth, size_m: float) -> dict[str, float | None]:
    """The metrics that ``answer`` defines.

    Args:
        answer: of B slots.
        truth: of the same slots.
        size_m: half-wheelbase of the craft [m].

    Returns:
        ``mpe_m`` [m] and its standard error ``mpe_se_m`` [m] (None for one sample), ``mde``, ``mde_triples``, ``wd_db``
        and ``mcd_db`` [dB re 1 m^2], with standard errors ``mde_se``, ``wd_se_db`` and ``mcd_se_db`` [dB] (None for one
        sample), ``wd_size_db`` [dB]; ``along_m`` and ``across_m``, the position's
        root-mean-square error along the line of sight and across it [m]; ``craft_accuracy``, the share of slots whose
        craft is named, and ``craft_chance``, that of guessing; ``explained``, the share of slots in which a known craft
        explains the echo; ``inside_50`` and ``inside_90``, how often the truth lies in the credible regions of these
        probabilities, of the slots for which there is one; ``expected_mpe_m`` [m] and ``expected_mde``, the errors that
        the answer itself expects, over the slots where it says so, and ``mpe_over_expected`` and ``mde_over_expected``,
        how many times as much it errs in the same slots (one where it is calibrated); ``seconds``, the median time of a
        slot [s].
    """
    values: dict[str, float | None] = dict.fromkeys(
        ("mpe_m", "mpe_se_m", "mde", "mde_se", "mde_triples", "wd_db", "wd_se_db", "wd_size_db", "mcd_db",
         "mcd_se_db", "along_m", "across_m",
         "craft_accuracy", "craft_chance", "explained", "inside_50", "inside_90", "expected_mpe_m", "expected_mde",
         "mpe_over_expected", "mde_over_expected", "seconds")
    )  # fmt: skip
    if answer.position is not None:
        values["mpe_m"] = float(metrics.mpe_m(answer.position, truth.position))
        errors = np.linalg.norm(np.asarray(answer.position) - truth.position, axis=-1)
        if len(errors) > 1:
            values["mpe_se_m"] = float(np.std(errors, ddof=1) / np.sqrt(len(errors)))
        if np.linalg.norm(np.asarray(truth.position), axis=-1).min() > 0.0:  # positions about themselves have no sight
            along, across = metrics.along_and_across_m(answer.position, truth.position)
            values |= {"along_m": float(along), "across_m": float(across)}
    if answer.normal is not None:
        values["mde"] = float(metrics.mde(answer.normal, truth.normal))
        apart = 1.0 - np.sum(np.asarray(answer.normal, np.float64) * truth.normal, axis=-1)
        if len(apart) > 1:
            values["mde_se"] = float(np.std(apart, ddof=1) / np.sqrt(len(apart)))
    if answer.triple_normal is not None:
        values["mde_triples"] = float(metrics.mde(answer.triple_normal, truth.normal))
    if answer.cloud is not None:
        place = answer.centre if answer.position is None else answer.position
        if place is None:
            raise ValueError("answer: got a cloud without a position or a centre; say where it lies")
        shapes = np.asarray(metrics.shape_distances(answer.cloud.points, truth.cloud), np.float64)
        weighted = shapes + np.sum((np.asarray(place, np.float64) - truth.position) ** 2, axis=-1)
        (wd_db, wd_se_db), (mcd_db, mcd_se_db) = metrics.decibels(weighted), metrics.decibels(shapes)
        values |= {"wd_db": wd_db, "wd_se_db": wd_se_db, "mcd_db": mcd_db, "mcd_se_db": mcd_se_db}
        values["wd_size_db"] = wd_db - float(20.0 * np.log10(size_m))
    if answer.craft is not None and truth.craft is not None:
        values["craft_accuracy"] = float(np.mean(np.asarray(answer.craft) == np.asarray(truth.craft)))
        if answer.craft_probability is not None:
            values["craft_chance"] = 1.0 / answer.craft_probability.shape[1]
    if answer.explained is not None:
        values["explained"] = float(np.mean(answer.explained))
    if answer.samples is not None:
        samples = np.asarray(answer.samples, np.float64)
        alike = np.full(samples.shape[1], 1.0 / samples.shape[1])
        levels = np.array(
            [
                calibration.position_level(each, alike, true)
                for each, true in zip(samples, np.asarray(truth.position), strict=True)
                if np.isfinite(each).all()
            ]
        )
        if len(levels):
            values |= {f"inside_{share:.0f}": calibration.coverage(levels, share / 100.0)[0] for share in (50, 90)}
    for name, unit, expected, own, true, apart in (
        ("mpe", "_m", answer.expected_error_m, answer.position, truth.position, metrics.mpe_m),
        ("mde", "", answer.expected_normal_error, answer.normal, truth.normal, metrics.mde),
    ):
        told = np.zeros(0, bool) if expected is None or own is None else np.isfinite(expected)
        if np.any(told):
            mean = float(np.mean(np.asarray(expected, np.float64)[told]))
            error = float(apart(np.asarray(own)[told], np.asarray(true)[told]))
            values |= {f"expected_{name}{unit}": mean, f"{name}_over_expected": error / mean if mean > 0.0 else None}
    if answer.seconds is not None:
        values["seconds"] = float(np.median(answer.seconds))
    return values


def score_track(
    track: Track, config: Config, size_m: float, *, seed: int = 0, search: Search | None = None, scheme: str = "august"
) -> dict[str, list[Row]]:
    """Errors of a track, slot by slot and on average, beside the baselines.

    Where a mesh that the networks were trained on is not there any more, a warning says so and ``mean_shape`` is left
    out.

    Args:
        track: what was true and reconstructed.
        config: of the networks.
        size_m: half-wheelbase of the craft [m].
        seed: of what the baselines draw.
        search: of some of its slots among known craft.
        scheme: whose answers the track holds.

    Returns:
        ``slots``: one entry a slot, plain numbers and lists: ``slot``, ``time_s``, ``snr_db``; ``position``,
        ``predicted``, ``estimate`` [m]; ``normal``, ``normal_estimate``; ``tilt_deg``, ``tilt_estimate_deg``;
        ``permittivity``, ``conductivity`` [S/m] and their estimates, the clouds' means; ``position_error_m``,
        ``predicted_error_m``, ``normal_error_deg``, and ``normal_error_up_deg``, that of answering a level craft; None
        where the scheme says nothing of it. Where the track knows, also ``detected`` (a detection said where to
        listen), ``lost`` and ``threshold_m``, what the region had to allow for the prediction [m] (None at detections).
        With a search also ``search``, None where the slot was not searched, else ``craft`` (its name, None where no
        known one explains the echo), ``craft_probability`` by name, ``explained``, ``probability`` (that noise leaves
        as much), ``position`` [m], ``normal``, and ``hypotheses``, most probable first: ``craft``, ``probability``,
        ``position``, ``normal``, ``heading_deg`` of the nose about z from x, ``permittivity``, ``conductivity``.
        ``schemes``: one row a scheme: ``scheme``, ``label`` and the metrics over all slots, for ``matched_field`` over
        those that were searched, whose number is ``count``.
    """
    # about the true positions: single precision keeps the digits of a centimetre better there than in the world
    origin = track.position[:, None]
    truth = Truth(np.zeros_like(track.position), track.normal, track.truth - origin, track.resampled - origin)
    points = jnp.asarray(track.points - origin)
    root = streams.key(seed, "sense.answer")
    own = Answer(position=track.estimated_position - track.position)
    if points.shape[1] > 1:  # more than a place
        own = own._replace(
            normal=track.normal_estimate,
            triple_normal=cloud_normals(streams.named(root, scheme), points)[1],
            cloud=WorldCloud(points, track.point_permittivity, track.point_conductivity),
        )
    answers = {scheme: own}
    try:
        airframes = [resolve_airframe(name, config.target.half_wheelbase_m) for name in config.target.airframes]
    except ValueError as error:
        warnings.warn(f"no mean_shape to compare with, of the airframes that the weights know: {error}", stacklevel=2)
        airframes = None
    if search is not None and search.found:
        answers["matched_field"] = _about(search, track)
    setting = Setting(config, None, airframes, streams.named(root, "prepared"))
    slots = Slots(track.predicted - track.position, None, None, truth)
    for name, each in SCHEMES.items():
        ask = None if each.hears else each.prepare(setting)
        if ask is not None:
            answers[name] = ask(streams.named(root, name), slots)
    rows = []
    for name, answer in answers.items():
        these = truth
        if name == "matched_field" and search is not None:
            chosen = np.array([found.slot for found in search.found])
            craft = None if search.craft is None else np.full(len(chosen), search.craft)
            these = jax.tree.map(lambda part, rows=chosen: part[rows], truth)._replace(craft=craft)
        row = {"scheme": name, "label": SCHEMES[name].label, **score(answer, these, size_m)}
        rows.append(row | {"count": len(these.position)})
    told = [_slot(track, number) for number in range(track.slots)]
    if search is not None:
        by_slot = {found.slot: _searched(found, search.names) for found in search.found}
        told = [slot | {"search": by_slot.get(slot["slot"])} for slot in told]
    return {"slots": told, "schemes": rows}


def _about(search: Search, track: Track) -> Answer:
    """A search's answers about the true positions, as the others of a track are."""
    whole = jax.tree.map(lambda *parts: np.concatenate(parts), *(found.answer for found in search.found))
    true = track.position[[found.slot for found in search.found]]
    cloud = whole.cloud._replace(points=whole.cloud.points - true[:, None])
    return whole._replace(position=whole.position - true, samples=whole.samples - true[:, None], cloud=cloud)


def _searched(found: Found, names: Sequence[str]) -> Row:
    posterior, answer = found.posterior, found.answer
    assert answer.craft is not None and answer.position is not None and answer.normal is not None
    craft = int(answer.craft[0])
    return {
        "craft": None if craft < 0 else names[craft],
        "craft_probability": dict(zip(names, map(float, posterior.craft_probability), strict=True)),
        "explained": bool(posterior.found),
        "probability": float(posterior.probability),
        "position": np.asarray(answer.position[0], float).tolist(),
        "normal": np.asarray(answer.normal[0], float).tolist(),
        "hypotheses": hypotheses(posterior.hypotheses, names, len(found.clouds)),
    }


def hypotheses(these: Hypotheses | Step, names: Sequence[str], count: int) -> list[Row]:
    """The first ``count`` hypotheses of a slot as plain numbers, most probable first."""
    return [
        {
            "craft": names[int(these.craft[row])],
            "probability": float(these.weight[row]),
            "position": np.asarray(these.position[row], float).tolist(),
            "normal": np.asarray(these.rotation[row, :, 2], float).tolist(),
            "heading_deg": float(np.degrees(np.arctan2(*these.rotation[row, 1::-1, 0]))),
            "permittivity": float(these.permittivity[row]),
            "conductivity": float(these.conductivity[row]),
        }
        for row in range(count)
    ]


def _slot(track: Track, slot: int) -> Row:
    def known(value: Any) -> Any:
        return value if np.all(np.isfinite(value)) else None

    up = np.array([0.0, 0.0, 1.0])
    position, predicted, estimate = track.position[slot], track.predicted[slot], track.estimated_position[slot]
    normal, normal_estimate = track.normal[slot], track.normal_estimate[slot]
    loop: Row = {}
    if track.detected is not None and track.lost is not None:
        loop = {"detected": bool(track.detected[slot]), "lost": bool(track.lost[slot])}
    if track.threshold_m is not None:
        loop["threshold_m"] = known(float(track.threshold_m[slot]))
    return {
        "slot": slot,
        "time_s": float(track.time_s[slot]),
        "snr_db": float(track.snr_db[slot]),
        "position": position.tolist(),
        "predicted": predicted.tolist(),
        "estimate": estimate.tolist(),
        "position_error_m": float(np.linalg.norm(estimate - position)),
        "predicted_error_m": float(np.linalg.norm(predicted - position)),
        "normal": normal.tolist(),
        "normal_estimate": known(normal_estimate.tolist()),
        "normal_error_deg": known(_angle_deg(normal_estimate, normal)),
        "normal_error_up_deg": _angle_deg(up, normal),
        "tilt_deg": _angle_deg(up, normal),
        "tilt_estimate_deg": known(_angle_deg(up, normal_estimate)),
        "permittivity": track.permittivity,
        "permittivity_estimate": known(float(track.point_permittivity[slot].mean())),
        "conductivity": track.conductivity,
        "conductivity_estimate": known(float(track.point_conductivity[slot].mean())),
        **loop,
    }


def _angle_deg(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))
