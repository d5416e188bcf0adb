"""Five rotary-wing families as closed solids, drawn with one tool: a loft through rings.

Frame: x forward, y to the left, z up. Sizes are those of a craft with a half-wheelbase of 0.25 m; other sizes are
scaled copies. Every craft has a tapered hull with its camera under the nose and its antenna mast at the tail, tubes
of 14 mm for arms, motors, two-blade rotors and landing gear. The parts cut through one another where they join; each
is closed by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

REFERENCE_HALF_WHEELBASE_M = 0.25
"""Half-wheelbase [m] of the solids that :func:`build` returns."""


@dataclass(frozen=True)
class Family:
    """What distinguishes one family from another; lengths in metres, angles in degrees from forward."""

    arms_deg: tuple[float, ...]
    coaxial: bool
    hull: tuple[float, float, float]
    """Length, width and height of the hull."""
    rotor_radius: float
    gear: str
    """``skids``: two rails along x; ``legs``: a leg below every arm; ``tripod``: legs below every other arm."""


FAMILIES = {
    "quad_x": Family((45.0, 135.0, 225.0, 315.0), False, (0.18, 0.08, 0.05), 0.11, "skids"),
    "quad_plus": Family((0.0, 90.0, 180.0, 270.0), False, (0.13, 0.12, 0.055), 0.11, "legs"),
    "hexa": Family((30.0, 90.0, 150.0, 210.0, 270.0, 330.0), False, (0.14, 0.105, 0.045), 0.09, "tripod"),
    "octo": Family(tuple(22.5 + 45.0 * k for k in range(8)), False, (0.085, 0.076, 0.034), 0.053, "skids"),
    "coaxial_y6": Family((60.0, 180.0, 300.0), True, (0.20, 0.085, 0.055), 0.12, "legs"),
}

_Solid = tuple[np.ndarray, np.ndarray]


def build(name: str) -> tuple[list[_Solid], Float[np.ndarray, "R 3"]]:
    """Parts of the family ``name`` at the reference size.

    Returns:
        closed parts, each (vertices (V, 3) [m], faces (F, 3) with outward normals), and the rotors' centres
        (R, 3) [m].
    """
    family = FAMILIES[name]
    angles = np.radians(family.arms_deg)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    spread = np.linalg.norm(directions[:, None] - directions[None], axis=-1).max()
    tips = directions * (2.0 * REFERENCE_HALF_WHEELBASE_M / spread)

    length, width, height = family.hull
    parts = [_hull(family.hull), *_camera(length, height), *_mast(length, height)]
    centres = []
    for arm, (tip, angle) in enumerate(zip(tips, angles)):
        parts.append(_tube(0.06 * width * directions[arm], tip, 0.007))
        for side in (1.0, -1.0) if family.coaxial else (1.0,):
            motor = [(-0.009, 0.010), (-0.006, 0.014), (0.018, 0.0145), (0.024, 0.011), (0.036, 0.004)]
            parts.append(_turned(tip, [(side * z, radius) for z, radius in motor]))
            centre = tip + np.array([0.0, 0.0, side * 0.031])
            centres.append(centre)
            # neighbours turn against each other, and no two rotors of a craft stand alike
            hand = side * (1.0 if arm % 2 == 0 else -1.0)
            parts.append(_rotor(centre, family.rotor_radius, angle + 0.9 + 0.5 * arm + 0.8 * (side < 0), hand))
    if family.gear == "skids":
        parts += _skids(length, width)
    else:
        step = 2 if family.gear == "tripod" else 1
        for tip, direction in zip(tips[::step], directions[::step]):
            parts += _leg(tip, direction, 0.55 if family.coaxial else 0.62)
    return parts, np.array(centres)


def _loft(rings: np.ndarray) -> _Solid:
    """Closed solid through rings (S, K, 3): quadrilaterals between neighbours, a fan over each end."""
    stations, count, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    here = np.arange(count)
    following = (here + 1) % count
    faces = []
    for station in range(stations - 1):
        a, b = station * count + here, station * count + following
        faces += [np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)]
    last = (stations - 1) * count
    faces.append(np.stack([following, here, np.full(count, stations * count)], 1))
    faces.append(np.stack([last + here, last + following, np.full(count, stations * count + 1)], 1))
    closed = np.concatenate(faces)
    corners = vertices[closed]
    if np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) < 0.0:
        closed = closed[:, ::-1]
    return vertices, closed


def _circle(count: int) -> np.ndarray:
    angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _tube(start: np.ndarray, end: np.ndarray, radius: float, sides: int = 10) -> _Solid:
    axis = (end - start) / np.linalg.norm(end - start)
    helper = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    across = np.cross(helper, axis)
    across /= np.linalg.norm(across)
    ring = radius * _circle(sides) @ np.stack([across, np.cross(axis, across)])
    return _loft(np.stack([start + ring, end + ring]))


def _turned(centre: np.ndarray, profile: list[tuple[float, float]], sides: int = 16) -> _Solid:
    """Solid of revolution about the vertical through ``centre``; profile of (height, radius) pairs."""
    rings = [np.concatenate([r * _circle(sides), np.full((sides, 1), z)], axis=1) for z, r in profile]
    return _loft(centre + np.stack(rings))


def _hull(size: tuple[float, float, float]) -> _Solid:
    """Blunt tail, long tapered nose that droops; superelliptic sections."""
    length, width, height = size
    sections = _circle(24)
    section = np.sign(sections) * np.abs(sections) ** 0.8
    stations = np.sin(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 17))[1:-1]
    rings = []
    for t in stations:
        full = (1.0 - abs(t) ** 3) ** 0.5 if t < 0.0 else (1.0 - t**2.2) ** 0.8
        droop = -0.18 * height * max(t, 0.0) ** 2
        y, z = 0.5 * width * full * section[:, 0], 0.5 * height * full**0.8 * section[:, 1] + droop
        rings.append(np.stack([np.full_like(y, 0.5 * length * t), y, z + 0.1 * height], axis=-1))
    return _loft(np.stack(rings))


def _camera(length: float, height: float) -> list[_Solid]:
    """Gimbal ball on a short neck under the nose, its lens looking forward."""
    ball = np.array([0.34 * length, 0.0, -0.62 * height])
    polar = np.linspace(0.0, np.pi, 9)[1:-1]
    radius = 0.017
    return [
        _turned(ball, [(radius * np.cos(p), radius * np.sin(p)) for p in polar], 14),
        _tube(ball, np.array([0.30 * length, 0.0, 0.0]), 0.006, 8),
        _tube(ball, ball + np.array([0.024, 0.0, 0.0]), 0.008),
    ]


def _mast(length: float, height: float) -> list[_Solid]:
    """Satellite receiver: a puck on a stick behind the middle."""
    foot = np.array([-0.27 * length, 0.0, 0.3 * height])
    top = np.array([-0.27 * length, 0.0, 0.6 * height + 0.022])
    return [_tube(foot, top, 0.004, 8), _turned(top, [(0.0, 0.017), (0.006, 0.019), (0.011, 0.014)], 14)]


def _rotor(centre: np.ndarray, radius: float, angle: float, hand: float) -> _Solid:
    """Two twisted blades as one loft from tip to tip; ``hand`` +1 turns anticlockwise seen from above."""
    outline = _circle(8)
    rings = []
    for t in np.array([-1.0, -0.9, -0.6, -0.3, -0.12, 0.12, 0.3, 0.6, 0.9, 1.0]):
        out = abs(t)
        chord = np.interp(out, [0.12, 0.3, 0.6, 0.9, 1.0], [0.012, 0.024, 0.021, 0.014, 0.007])
        thickness = np.interp(out, [0.12, 0.3, 1.0], [0.006, 0.0025, 0.0018])
        pitch = hand * np.sign(t) * np.radians(np.interp(out, [0.12, 0.3, 1.0], [4.0, 16.0, 7.0]))
        across = 0.5 * chord * outline[:, 0]
        up = 0.5 * thickness * outline[:, 1]
        rings.append(
            np.stack(
                [
                    np.full(len(outline), t * radius),
                    across * np.cos(pitch) - up * np.sin(pitch),
                    across * np.sin(pitch) + up * np.cos(pitch),
                ],
                axis=-1,
            )
        )
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return _loft(centre + np.stack(rings) @ turn.T)


def _skids(length: float, width: float) -> list[_Solid]:
    parts = []
    for side in (1.0, -1.0):
        y = side * (0.5 * width + 0.035)
        parts.append(_tube(np.array([-0.5 * length, y, -0.10]), np.array([0.5 * length, y, -0.10]), 0.005, 8))
        for x in (-0.25 * length, 0.25 * length):
            parts.append(_tube(np.array([x, side * 0.3 * width, 0.0]), np.array([1.2 * x, y, -0.10]), 0.005, 8))
    return parts


def _leg(tip: np.ndarray, direction: np.ndarray, place: float) -> list[_Solid]:
    knee, foot = place * tip, (place + 0.1) * tip + np.array([0.0, 0.0, -0.11])
    return [_tube(knee, foot, 0.0055, 8), _tube(foot - 0.018 * direction, foot + 0.018 * direction, 0.006, 8)]
