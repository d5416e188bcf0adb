"""Pages that work offline: a template of this package with numbers put in as JSON, nothing else needed."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

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


class About(NamedTuple):
    """What a report says of itself.

    Attributes:
        title, lead, note: heading, the sentence below it, and the remark under the table of schemes.
        setup: pairs of name and value that say how it was made.
        following: pairs of a command to try next and what it does.
        repeat: pairs of a command that makes the run again and what it needs.
        configuration: of the run, as text.
    """

    title: str
    lead: str
    note: str
    setup: Sequence[tuple[str, str]]
    following: Sequence[tuple[str, str]]
    repeat: Sequence[tuple[str, str]]
    configuration: str

    def payload(self) -> dict[str, Any]:
        """As pages read it."""
        told = self._asdict()
        told["next"] = told.pop("following")
        return told


def write_page(path: str | Path, template: str, payload: Mapping[str, Any]) -> None:
    """Write ``template``, a file beside this one, with what pages share put in: other files beside it, named as
    ``@page.css@``, and ``payload`` in the place of ``@PAYLOAD@``."""
    beside = files("august_jax.app")
    page = beside.joinpath(template).read_text(encoding="utf-8")
    page = re.sub(
        r"@([a-z]+\.(?:css|html|js))@", lambda name: beside.joinpath(name[1]).read_text(encoding="utf-8"), page
    )
    # "<" is written as an escape, so that no text of the payload can close the script element
    text = json.dumps(payload, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    write_text(path, page.replace("@STOPS@", json.dumps(RAMP)).replace("@PAYLOAD@", text))


def steps_of(values: np.ndarray) -> str:
    """Numbers in units of a step as 16-bit integers, little-endian, in base 64."""
    steps = np.clip(np.round(values), -32768, 32767).astype("<i2")
    return base64.b64encode(steps.tobytes()).decode("ascii")
