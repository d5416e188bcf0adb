"""Pages that work offline: a template of this package with numbers put in as JSON, nothing else needed."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from august_jax.files import write_text

RAMP = (
    (68, 1, 84),
    (71, 44, 122),
    (59, 81, 139),
    (44, 113, 142),
    (33, 144, 141),
    (39, 173, 129),
    (92, 200, 99),
    (170, 220, 50),
    (253, 231, 37),
)
"""Colours from low to high numbers, red, green and blue of 255: matplotlib's viridis."""


def write_page(path: str | Path, template: str, payload: Mapping[str, Any]) -> None:
    """Write ``template``, a file beside this one, with ``payload`` in the place of its ``@PAYLOAD@``, and what pages
    share, ``view.js``, in that of ``@VIEW@``."""
    # "<" is written as an escape, so that no text of the payload can close the script element
    text = json.dumps(payload, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page, view = (files("august_jax.app").joinpath(name).read_text(encoding="utf-8") for name in (template, "view.js"))
    page = page.replace("@VIEW@", view.replace("@STOPS@", json.dumps(RAMP)))
    write_text(path, page.replace("@PAYLOAD@", text))


def steps_of(values: np.ndarray) -> str:
    """Numbers in units of a step as 16-bit integers, little-endian, in base 64."""
    steps = np.clip(np.round(values), -32768, 32767).astype("<i2")
    return base64.b64encode(steps.tobytes()).decode("ascii")
