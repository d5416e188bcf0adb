"""A flight that was followed against the truth, slot by slot and on average, beside answering the prediction.

:func:`score_flown` is of one that hypotheses followed, :func:`score_followed` of one that any other scheme did.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from august_jax.config import Config
from august_jax.evaluation import calibration
from august_jax.evaluation.score import Row, hypotheses, score_track
from august_jax.inference.follow import Step
from august_jax.schemes.followed import Flown
from august_jax.tracking import Track
from august_jax.tracking.loop import DETECTED_SLOTS

FOLLOWED = "followed"
"""Name of the scheme in rows and pictures."""
SETTLED = 5
"""From this slot on a flight is averaged on its own as well: before, detections say where to listen, and the level of
the gain is being learned."""


def score_followed(track: Track, config: Config, size_m: float, *, scheme: str, seed: int = 0) -> dict[str, list[Row]]:
    """Errors of a flight that a scheme followed by :func:`august_jax.pipeline.sense`.

    Args:
        track: of a loop that tells of detections, losses and thresholds.
        config: that it was followed with.
        size_m: half-wheelbase of the craft [m].
        scheme: whose answers it holds.
        seed: of what the baselines draw.

    Returns:
        ``slots`` and ``schemes`` as :func:`august_jax.evaluation.score_track` has them. ``summary``: one row over all
        slots and one over those after the first detections: ``slots`` (first and last), ``mpe_m``, ``predicted_m``,
        ``mde`` (None without normals), ``lost``, ``detected``, and ``narrow``, the number of slots whose prediction
        needs a larger region than the configuration's.
    """
    scores = score_track(track, config, size_m, seed=seed, scheme=scheme)
    slots = scores["slots"]
    limit = config.region.threshold_m

    def summary(first: int) -> Row:
        chosen = slots[first:]
        return {
            "slots": [first, len(slots) - 1],
            **_errors(chosen),
            "lost": sum(slot["lost"] for slot in chosen),
            "detected": sum(slot["detected"] for slot in chosen),
            "narrow": sum((slot["threshold_m"] or 0.0) > limit for slot in chosen),
        }

    return {**scores, "summary": [summary(first) for first in sorted({0, min(DETECTED_SLOTS, len(slots) - 1)})]}


def score_flown(flown: Flown, config: Config, size_m: float, *, seed: int = 0) -> dict[str, list[Row]]:
    """Errors of a followed flight.

    Args:
        flown: of :func:`august_jax.schemes.followed.follow_flight`.
        config: that it was followed with.
        size_m: half-wheelbase of the craft [m].
        seed: of what the baselines draw.

    Returns:
        ``slots`` and ``schemes`` as :func:`august_jax.evaluation.score_track` has them, ``followed`` in the place of
        the networks. Each slot also has ``expected_error_m`` and ``expected_mde``, what the posterior itself expects
        its means to err by; ``level``, the probability of the smallest credible region that holds the true position;
        and ``search``: ``craft`` (its name, None where it is lost), ``craft_probability`` by name,
        ``explained``, ``probability`` (that noise leaves as much), ``position`` [m], ``normal``, ``hypotheses``, most
        probable first (``craft``, ``probability``, ``position``, ``normal``, ``heading_deg``, ``permittivity``,
        ``conductivity``), ``whole`` (all attitudes of all craft were searched) and ``seconds``. ``summary``: one row
        over all slots and one over those from SETTLED on: ``slots`` (first and last), ``mpe_m``, ``mde``,
        ``predicted_m``, ``expected_m``, ``expected_mde``, ``craft_accuracy`` (None where the craft is not known),
        ``explained``, ``inside_50``, ``inside_90``, ``lost``, ``whole``, ``seconds`` (median).
    """
    scores = score_track(flown.track, config, size_m, seed=seed)
    slots = [
        slot | _told(step, flown, position)
        for slot, step, position in zip(scores["slots"], flown.steps, flown.track.position, strict=True)
    ]
    schemes = []
    for row in scores["schemes"]:
        mine = (
            {"scheme": FOLLOWED, "label": "hypotheses carried from slot to slot"} if row["scheme"] == "august" else {}
        )
        schemes.append(row | mine)
    summary = [_summary(slots, flown, first) for first in sorted({0, min(SETTLED, len(slots) - 1)})]
    return {"slots": slots, "schemes": schemes, "summary": summary}


def _told(step: Step, flown: Flown, position: np.ndarray) -> Row:
    alike = np.full(len(step.samples), 1.0 / len(step.samples))
    best = int(np.argmax(step.craft_probability))
    return {
        "expected_error_m": step.expected_error_m,
        "expected_mde": step.expected_mde,
        "level": float(calibration.position_level(step.samples, alike, np.asarray(position, float))),
        "search": {
            "craft": None if step.lost else flown.names[best],
            "craft_probability": dict(zip(flown.names, map(float, step.craft_probability), strict=True)),
            "explained": bool(step.explained),
            "probability": step.probability,
            "position": step.mean_position.tolist(),
            "normal": step.mean_normal.tolist(),
            "hypotheses": hypotheses(step, flown.names, len(flown.clouds[step.slot])),
            "whole": bool(step.searched),
            "seconds": step.seconds,
        },
    }


def _summary(slots: list[Row], flown: Flown, first: int) -> Row:
    chosen, searches = slots[first:], [slot["search"] for slot in slots[first:]]

    own = None if flown.craft is None else flown.names[flown.craft]
    return {
        "slots": [first, len(slots) - 1],
        **_errors(chosen),
        "expected_m": _mean(slot["expected_error_m"] for slot in chosen),
        "expected_mde": _mean(slot["expected_mde"] for slot in chosen),
        "craft_accuracy": None if own is None else _mean(each["craft"] == own for each in searches),
        "explained": _mean(each["explained"] for each in searches),
        "inside_50": _mean(slot["level"] <= 0.5 for slot in chosen),
        "inside_90": _mean(slot["level"] <= 0.9 for slot in chosen),
        "lost": sum(slot["lost"] for slot in chosen),
        "whole": sum(each["whole"] for each in searches),
        "seconds": float(np.median([each["seconds"] for each in searches])),
    }


def _errors(slots: list[Row]) -> Row:
    """Mean errors of slots: of the estimate, of the prediction and of the normal, where there is one."""
    normals = [1.0 - np.dot(slot["normal"], slot["normal_estimate"]) for slot in slots if slot["normal_estimate"]]
    return {
        "mpe_m": _mean(slot["position_error_m"] for slot in slots),
        "predicted_m": _mean(slot["predicted_error_m"] for slot in slots),
        "mde": _mean(normals) if normals else None,
    }


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(np.asarray(list(values), float)))
