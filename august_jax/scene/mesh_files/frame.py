"""Unit and axes of a mesh file: what was asked for, what the file fixes, and what was taken in the end.

An argument that is given always wins, with a warning where the file says otherwise; "auto" takes what the file or
its format fixes; what neither says is assumed: metres, z up, x forward.
"""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from august_jax.scene.mesh_files.surface import Declared

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length units of mesh files [m]."""

AXES = {
    sign + axis: factor * np.eye(3)[column]
    for column, axis in enumerate("xyz")
    for sign, factor in (("", 1.0), ("-", -1.0))
}
"""Names of axes and their directions in a file."""

AUTO = "auto"
"""Argument that leaves unit or axis to the file."""

_GIVEN, _ASSUMED = "given", "assumed: the file says nothing"


@dataclass(frozen=True)
class MeshSource:
    """Where a mesh came from and in which unit and axes it was read, and who said so.

    Attributes:
        path: the file.
        unit_m: length of its unit [m].
        up: its axis that points up.
        forward: its axis that points forward.
        unit_from: who fixed the unit: "given" as an argument, the file or its format in words, or "assumed: ...".
        up_from: who fixed ``up``.
        forward_from: who fixed ``forward``.
        doubt: what speaks against it, or nothing.
    """

    path: str
    unit_m: float
    up: str
    forward: str
    unit_from: str
    up_from: str
    forward_from: str
    doubt: str = ""

    def __str__(self) -> str:
        return (
            f"unit {self.unit_m:g} m ({self.unit_from}), up {self.up} ({self.up_from}), "
            f"forward {self.forward} ({self.forward_from}){'; ' if self.doubt else ''}{self.doubt}"
        )

    def doubted(self, extents: Float[np.ndarray, "3"]) -> MeshSource:
        """The same, with a doubt where a craft of these extents [m] stands higher than it is wide and nobody said so.

        Rotors lie in the horizontal plane: ten published multirotors are at most 0.6 times as high as wide. Tools that
        write ``Y_UP`` into every file are common.
        """
        if self.up_from == _GIVEN or extents[2] <= extents[:2].min():
            return self
        return dataclasses.replace(
            self,
            doubt=f"it stands {extents[2]:.3g} m high and is {extents[:2].min():.3g} m wide: if that is wrong, give up",
        )

    def arguments(self) -> dict[str, str | float]:
        """Arguments of :func:`~august_jax.scene.load_airframe` that read the file in the same way."""
        return {"unit": self.unit_m, "up": self.up, "forward": self.forward}

    def record(self) -> dict[str, Any]:
        """All of it as plain strings and numbers, for JSON."""
        return dataclasses.asdict(self)

    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Turns the file's axes to x forward, y to the left, z up."""
        up, forward = AXES[self.up], AXES[self.forward]
        return np.stack([forward, np.cross(up, forward), up])


def check_frame(unit: str | float, up: str, forward: str) -> None:
    """Raise ValueError for arguments that are neither "auto" nor a unit and two axes at right angles."""
    if unit != AUTO:
        unit_in_metres(unit)
    for argument, axis in (("up", up), ("forward", forward)):
        if axis != AUTO and axis not in AXES:
            raise ValueError(f"{argument}={axis!r}: choose one of {AUTO}, {', '.join(AXES)}")
    if AUTO not in (up, forward) and up[-1] == forward[-1]:
        raise ValueError(f"up={up!r}, forward={forward!r}: the two must be perpendicular")


def chosen_frame(path: str, declared: Declared, unit: str | float, up: str, forward: str) -> MeshSource:
    """Unit and axes to read a file in; warns where an argument contradicts the file.

    Args:
        path: the file, for messages.
        declared: what the file says.
        unit: as of :func:`unit_in_metres`, or "auto".
        up: an axis, or "auto".
        forward: an axis at right angles to ``up``, or "auto".

    Raises:
        ValueError: an axis left to the file would be parallel to the one that is given.
    """
    unit_by, up_by, forward_by = declared.by
    if unit != AUTO:
        metres, unit_from = unit_in_metres(unit), _GIVEN
        if declared.unit_m is not None and not np.isclose(metres, declared.unit_m, rtol=1e-3):
            _warn(f"{path}: declares a unit of {declared.unit_m:g} m ({unit_by}), but is read with unit={metres:g} m")
    else:
        metres, unit_from = (1.0, _ASSUMED) if declared.unit_m is None else (declared.unit_m, unit_by)
    for argument, axis, said, by in (
        ("up", up, declared.up, up_by),
        ("forward", forward, declared.forward, forward_by),
    ):
        if axis != AUTO and said is not None and axis != said:
            _warn(f"{path}: declares {argument} {said} ({by}), but is read with {argument}={axis!r}")
    up, up_from = _axis("up", up, declared.up, up_by, "z", forward)
    forward, forward_from = _axis("forward", forward, declared.forward, forward_by, "-y" if up == "x" else "x", up)
    return MeshSource(path, metres, up, forward, unit_from, up_from, forward_from)


def _axis(argument: str, given: str, declared: str | None, by: str, usual: str, other: str) -> tuple[str, str]:
    """An axis and who fixed it: the one given, else declared, else usual, at right angles to ``other``."""
    if given != AUTO:
        return given, _GIVEN
    if declared is not None and declared[-1] != other[-1]:
        return declared, by
    if usual[-1] != other[-1]:
        return usual, _ASSUMED if declared is None else f"assumed: {by}'s {declared} is not perpendicular to {other}"
    raise ValueError(f"{argument}={AUTO!r}: {usual!r} is parallel to the other axis, {other!r}; give {argument} too")


def unit_in_metres(unit: str | float) -> float:
    """Length [m] of a unit's name, or of a number of metres.

    Raises:
        ValueError: the unit is neither a name of :data:`UNITS_M` nor a positive number.
    """
    if unit in UNITS_M:
        return UNITS_M[unit]
    try:
        scale = float(unit)
    except (TypeError, ValueError):
        scale = np.nan
    if not (np.isfinite(scale) and scale > 0.0):
        raise ValueError(f"unit={unit!r}: choose one of {AUTO}, {', '.join(UNITS_M)}, or give a number of metres")
    return scale


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=5)
