"""Who flies where, made of what: a random flight in the configuration's box, or one pose of a craft of one's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from august_jax import streams
from august_jax.config import Config
from august_jax.scene.airframes import Airframe, resolve_airframe
from august_jax.scene.pose import rotation_from_euler
from august_jax.scene.trajectory import fly

SIZE_RATIO = (0.8, 1.25)
"""A drone's half-wheelbase may be this many times that of the weights."""
_TURN_DEG = 360.0
"""Largest angle of a pose [deg]: a full turn either way."""


@dataclass(frozen=True)
class Scenario:
    """An airframe of one material in T poses.

    Attributes:
        airframe: the body.
        time_s: (T,) [s].
        positions: of the surface centroid (T, 3) [m].
        rotations: body to world (T, 3, 3).
        permittivity, conductivity: of the whole craft, [1] and [S/m].
    """

    airframe: Airframe
    time_s: Float[np.ndarray, " slots"]
    positions: Float[np.ndarray, "slots 3"]
    rotations: Float[np.ndarray, "slots 3 3"]
    permittivity: float
    conductivity: float

    @property
    def slots(self) -> int:
        """Number of poses T."""
        return len(self.time_s)

    def surface(self, key: jax.Array, count: int) -> Float[np.ndarray, "slots {count} 3"]:
        """``count`` area-uniform points of the craft's surface in the world (T, count, 3) [m]; the same ones of the
        body in every slot."""
        body = np.asarray(self.airframe.sample_surface(key, count), np.float64)
        return np.einsum("tab,nb->tna", self.rotations, body) + self.positions[:, None]


@streams.pin
def draw_scenario(config: Config, seed: int, slots: int, airframe: str | None = None) -> Scenario:
    """A random flight in the configuration's box, with a material from its ranges.

    Args:
        config: box, style, materials and airframes.
        seed: of all that is drawn.
        slots: T, at least 1.
        airframe: name of a procedural family or path of a mesh; drawn from the configuration when None.
    """
    if slots < 1:
        raise ValueError(f"slots: {slots} is too short a flight; wanted at least 1")
    target = config.target
    if airframe is None:
        drawn = jax.random.randint(streams.key(seed, "scenario.airframe"), (), 0, len(target.airframes))
        airframe = target.airframes[int(drawn)]
    craft = resolve_airframe(airframe, target.half_wheelbase_m)
    flight = fly(streams.key(seed, "scenario.flight"), replace(config.flight, slots=slots))
    share = np.asarray(jax.random.uniform(streams.key(seed, "scenario.material"), (2,)), float)
    return Scenario(
        airframe=craft,
        time_s=config.flight.slot_s * np.arange(slots),
        positions=np.asarray(flight.positions, np.float64),
        rotations=np.asarray(flight.rotations, np.float64),
        permittivity=_between(target.permittivity, share[0]),
        conductivity=_between(target.conductivity_s_m, share[1]),
    )


def pose_scenario(
    config: Config,
    airframe: Airframe,
    *,
    position: Sequence[float] | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    permittivity: float | None = None,
    conductivity: float | None = None,
) -> Scenario:
    """One pose of one craft, checked against what networks trained with ``config`` have seen.

    Place and material are the middle of their ranges where they are not given.

    Raises:
        ValueError: the craft's size, its place, attitude or material lies outside the configuration's ranges.
    """
    flight, target = config.flight, config.target
    ratio = airframe.half_wheelbase_m / target.half_wheelbase_m
    if not SIZE_RATIO[0] <= ratio <= SIZE_RATIO[1]:
        raise ValueError(
            f"half_wheelbase_m: {airframe.name} has {airframe.half_wheelbase_m:.3g} m, the weights know "
            f"{SIZE_RATIO[0] * target.half_wheelbase_m:.3g} to {SIZE_RATIO[1] * target.half_wheelbase_m:.3g} m\n"
            f"load it with half_wheelbase_m={target.half_wheelbase_m:g}, or check the unit of its file"
        )
    if position is None:
        position = tuple(_between(span, 0.5) for span in flight.box_m)
    if not all(low <= value <= high for value, (low, high) in zip(position, flight.box_m, strict=True)):
        box = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", flight.box_m, strict=True))
        raise ValueError(
            f"position: ({', '.join(f'{value:g}' for value in position)}) m is outside the box that the "
            f"weights know: {box} m\nchoose a place inside it, e.g. "
            + ",".join(f"{_between(span, 0.5):g}" for span in flight.box_m)
        )
    for name, angle in (("yaw_deg", yaw_deg), ("pitch_deg", pitch_deg), ("roll_deg", roll_deg)):
        if not (math.isfinite(angle) and abs(angle) <= _TURN_DEG):
            raise ValueError(f"{name}: {angle:g} is no angle of a pose; give -360 to 360 degrees")
    rotation = np.asarray(rotation_from_euler(*np.radians([roll_deg, pitch_deg, yaw_deg])), np.float64)
    slope = np.tan(np.radians(flight.tilt_deg))
    if not (rotation[2, 2] > 0.0 and np.hypot(*rotation[:2, 2]) <= slope * rotation[2, 2] * (1.0 + 1e-5)):
        tilt = np.degrees(np.arccos(np.clip(rotation[2, 2], -1.0, 1.0)))
        raise ValueError(
            f"pitch_deg, roll_deg: {pitch_deg:g} and {roll_deg:g} degrees tilt the drone by {tilt:.3g} "
            f"degrees, more than the {flight.tilt_deg:g} degrees that the weights know; use smaller angles"
        )
    material = []
    for name, value, span in (
        ("permittivity", permittivity, target.permittivity),
        ("conductivity", conductivity, target.conductivity_s_m),
    ):
        value = _between(span, 0.5) if value is None else value
        if not span[0] <= value <= span[1]:
            raise ValueError(
                f"{name}: {value:g} is outside the range that the weights know, "
                f"{span[0]:g} to {span[1]:g}{' S/m' if name == 'conductivity' else ''}"
            )
        material.append(float(value))
    return Scenario(airframe, np.zeros(1), np.asarray([position], np.float64), rotation[None], *material)


def _between(span: Sequence[float], share: float) -> float:
    return float(span[0] + share * (span[1] - span[0]))
