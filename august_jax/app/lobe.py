"""A radar cross-section as a lobe that can be turned: one HTML file that works offline.

The page is ``lobe.html`` with the numbers put in as JSON: cross-sections as 16-bit integers of ``STEP_DB``, and some
points of the craft in the middle, which say where ahead and up are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from august_jax.app.page import steps_of, write_page

STEP_DB = 0.01
"""Step of the cross-sections in the page [dB]."""
_LEAST_DB = -300.0


def write_lobe(
    path: str | Path,
    azimuth_deg: Float[np.ndarray, " a"],
    elevation_deg: Float[np.ndarray, " e"],
    frequency_hz: Sequence[float],
    entries: Mapping[str, Float[np.ndarray, "e a f"]],
    craft: Float[np.ndarray, "n 3"],
    *,
    title: str,
    lead: str,
    repeat: str,
) -> None:
    """Write the page.

    Args:
        path: the HTML file.
        azimuth_deg, elevation_deg: of the directions [degrees], growing; one of either makes a cut.
        frequency_hz: F frequencies [Hz].
        entries: name of two polarisations, received and sent -> dBsm by elevation, azimuth and frequency.
        craft: some points of the surface (N, 3), about the craft's origin, in one unit of length.
        title, lead: heading, and the sentence below it.
        repeat: the command line that makes it again.
    """
    reach = max(float(np.linalg.norm(craft, axis=-1).max(initial=0.0)), 1e-12)
    payload = {
        "title": title,
        "lead": lead,
        "repeat": repeat,
        "azimuth_deg": [float(value) for value in azimuth_deg],
        "elevation_deg": [float(value) for value in elevation_deg],
        "frequency_hz": [float(value) for value in frequency_hz],
        "entries": {
            name: [steps_of(np.maximum(values[..., tone], _LEAST_DB) / STEP_DB) for tone in range(len(frequency_hz))]
            for name, values in entries.items()
        },
        "step_db": STEP_DB,
        "craft": steps_of(np.asarray(craft) / reach * 32767),
    }
    write_page(path, "lobe.html", payload)
