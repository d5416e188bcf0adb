"""The report of an evaluation: accuracy over SNR as one HTML file that works offline.

The page is ``accuracy.html`` with the rows put in as JSON: curves of every metric with their standard errors, baselines
and bound, the numbers at each SNR, and what a search among known craft expects of itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from august_jax.app.page import About, write_page
from august_jax.app.plotting import styles_of
from august_jax.schemes import SCHEMES
from august_jax.schemes.networks import AUGUST

OTHERS = SCHEMES.keys() - {AUGUST.name}
"""Schemes that are not networks, behind which the lines of networks stand out."""
_DASHES: dict[str, list[int]] = {"-": [], "--": [7, 4], ":": [2, 4]}


def write_accuracy(
    path: str | Path, rows: Sequence[Mapping[str, Any]], thresholds: Sequence[Mapping[str, Any]], about: About
) -> None:
    """Write the report of an evaluation.

    Args:
        path: the HTML file.
        rows: of :func:`august_jax.evaluation.evaluate`.
        thresholds: of :func:`august_jax.evaluation.thresholds`.
        about: what the report says of itself.
    """
    labels = {row["scheme"]: row["label"] for row in rows}
    schemes = [
        {
            "name": name,
            "label": labels[name],
            "strong": name not in OTHERS,
            "colour": style["color"],
            "dash": _DASHES[style.get("ls", "-")],
        }
        for name, style in styles_of(labels).items()
    ]
    payload = {**about.payload(), "schemes": schemes, "rows": list(rows), "thresholds": list(thresholds)}
    write_page(path, "accuracy.html", payload)
