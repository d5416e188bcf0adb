"""The report of a demo, a reconstruction or a track: one HTML file that works offline, with turnable views.

The page is ``viewer.html`` with the numbers put in as JSON. It needs nothing else, fits a telephone and a wide screen,
follows the reader's light or dark scheme, and does by key what it does by hand. Points go in as 16-bit integers of
``QUANTUM_M``, or of more where the farthest point asks for it, about the true position of their slot, materials as
bytes of their range, so that fifty slots of a thousand points stay below 1.5 MB.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from august_jax.app.page import About, steps_of, write_page

if TYPE_CHECKING:
    from august_jax.scene import WorldCloud
    from august_jax.tracking import Track

QUANTUM_M = 1e-4
"""Step of the coordinates in the page [m]."""


def write_report(
    path: str | Path,
    track: Track,
    scores: Mapping[str, Any],
    about: About,
    *,
    permittivity: tuple[float, float],
    conductivity: tuple[float, float],
    scheme: tuple[str, str] = ("august", "AUGUST"),
    hypotheses: Mapping[int, Sequence[WorldCloud]] | None = None,
) -> None:
    """Write the report of ``track``.

    Args:
        path: the HTML file.
        track: what was true and what was reconstructed.
        scores: ``slots`` and ``schemes`` as :func:`august_jax.evaluation.score_track` gives them, and ``bound`` where
            it is known: ``bound_m`` [m] and ``bound_mde``, what noise leaves to one who knows the craft.
        about: what the report says of itself.
        permittivity, conductivity: ranges of the colour scale, [1] and [S/m].
        scheme: name of the one that made the clouds, and what it is called in charts.
        hypotheses: slot -> surfaces of the hypotheses that its entry of the scores tells of, in their order.
    """
    ranges = {"permittivity": list(permittivity), "conductivity": list(conductivity)}
    places = track.position[:, None, :]
    truth, cloud = track.truth - places, track.points - places
    guessed = {
        index: [np.asarray(each.points) - track.position[index] for each in several]
        for index, several in (hypotheses or {}).items()
    }
    drawn = [truth, cloud, *(points for several in guessed.values() for points in several)]
    farthest = max(float(np.abs(points).max(initial=0.0)) for points in drawn)
    quantum_m = max(QUANTUM_M, farthest / 32767.0)  # of a lost cloud, which the page would move nearer
    reach = float(np.quantile(np.linalg.norm(truth, axis=-1), 0.999)) * 1.25
    bearing = track.position[-1]
    payload = {
        **about.payload(),
        "bound": scores.get("bound"),
        "range": ranges,
        "quantum_m": quantum_m,
        "reach_m": reach,
        "grid_m": next((step for step in (0.02, 0.05, 0.1, 0.2, 0.5) if step > reach / 4), 1.0),
        # from the base station's side, turned a little and lifted, so that rotors and legs both show
        "view": {"turn": math.atan2(-bearing[1], -bearing[0]) + 0.5, "lift": 0.5},
        "scheme": list(scheme),
        "scores": list(scores["schemes"]),
        "slots": [
            {
                **slot,
                "true_points": _coordinates(truth[index], quantum_m),
                "points": _coordinates(cloud[index], quantum_m),
                "point_permittivity": _levels(track.point_permittivity[index], permittivity),
                "point_conductivity": _levels(track.point_conductivity[index], conductivity),
                "hypothesis_points": [_coordinates(points, quantum_m) for points in guessed.get(index, ())],
            }
            for index, slot in enumerate(scores["slots"])
        ],
    }
    write_page(path, "viewer.html", payload)


def _coordinates(points: np.ndarray, quantum_m: float) -> str:
    return steps_of(points / quantum_m)


def _levels(values: np.ndarray, span: tuple[float, float]) -> str:
    level = np.nan_to_num((np.asarray(values) - span[0]) / max(span[1] - span[0], 1e-30), nan=0.5)  # nobody says
    return base64.b64encode(np.round(255 * np.clip(level, 0.0, 1.0)).astype(np.uint8).tobytes()).decode("ascii")
