"""The report of a training run: its numbers over the steps as one HTML file that works offline.

The page is ``learning.html`` with the lines of ``metrics.jsonl`` put in as JSON: a chart of each number beside what it
is held against, where the run stands, and the commands that go on from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from august_jax.app.page import About, write_page
from august_jax.app.plotting import training_panels

_BASES = {"validation_prediction_m": "answering the prediction"}


def write_learning(path: str | Path, lines: Sequence[Mapping[str, Any]], steps: int, about: About) -> None:
    """Write the report of a run.

    Args:
        path: the HTML file.
        lines: of ``metrics.jsonl``, at least one.
        steps: that the run is to have.
        about: what the report says of itself.
    """
    panels = [
        {**panel._asdict(), "held": _BASES.get(panel.base, "the Kalman filter alone") if panel.base else ""}
        for panel in training_panels(lines)
    ]
    write_page(path, "learning.html", {**about.payload(), "panels": panels, "steps": steps, "lines": list(lines)})
