"""The report of an evaluation: accuracy over SNR as one HTML file that works offline.

The page is ``accuracy.html`` with the rows put in as JSON: curves of every metric with their standard errors, baselines
and bound, the numbers at each SNR, and what a search among known craft expects of itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from august_jax.app.page import write_page
from august_jax.app.plotting import styles_of
from august_jax.schemes import SCHEMES
from august_jax.schemes.networks import AUGUST

OTHERS = SCHEMES.keys() - {AUGUST.name}
"""Schemes that are not networks, behind which the lines of networks stand out."""
_DASHES: dict[str, list[int]] = {"-": [], "--": [7, 4], ":": [2, 4]}


def write_accuracy(
    path: str | Path,
    rows: Sequence[Mapping[str, Any]],
    thresholds: Sequence[Mapping[str, Any]],
    *,
    title: str,
    lead: str,
    note: str,
    setup: Sequence[tuple[str, str]],
    following: Sequence[tuple[str, str]],
    repeat: Sequence[tuple[str, str]],
    configuration: str,
) -> None:
    """Write the report of an evaluation.

    Args:
        path: the HTML file.
        rows: of :func:`august_jax.evaluation.evaluate`.
        thresholds: of :func:`august_jax.evaluation.thresholds`.
        title, lead, note: heading, the sentence below it, and the remark under the table of schemes.
        setup: pairs of name and value that say how the samples were made.
        following: pairs of a command to try next and what it does.
        repeat: pairs of a command that evaluates again and what it needs.
        configuration: of the evaluation, as text.
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
    payload = {
        "title": title,
        "lead": lead,
        "note": note,
        "setup": [list(pair) for pair in setup],
        "next": [list(pair) for pair in following],
        "repeat": [list(pair) for pair in repeat],
        "configuration": configuration,
        "schemes": schemes,
        "rows": [dict(row) for row in rows],
        "thresholds": [dict(each) for each in thresholds],
    }
    write_page(path, "accuracy.html", payload)
