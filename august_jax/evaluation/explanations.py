"""How many explanations of an echo a posterior holds, and how much it gives to each.

An explanation is a craft and an attitude. All that the posterior gives to the same craft within 10 degrees of one
attitude counts as one, wherever along the line of sight it stands: where it stands is a matter of error, not of choice.
Turns from arm to arm about the craft's own axis count as the same attitude (:func:`arms`): rotors lie where rotors lay,
and hull and gear alone tell which way the nose points.

    1. Of the weighted samples 2000 are drawn, as often as their weights say.
    2. The explanation that holds most of them is taken: of all balls of 10 degrees about a sample, of the sample's own
       craft, the heaviest. So on with those that are left.

The explanations' weights p add up to one; 1 / sum p^2 is their effective number. There is one explanation where the
first holds at least 0.95.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from august_jax.arrays import Array
from august_jax.inference import Posterior
from august_jax.scene.airframes import Airframe

RADIUS_DEG = 10.0
"""So far apart are attitudes of one explanation, from the one that stands for it [deg]."""
ONE = 0.95
"""Where the heaviest explanation holds as much, it counts as the only one."""
_DRAWS = 2000
_FOLDS = (8, 6, 5, 4, 3, 2)


def explanations(
    posterior: Posterior, folds: Sequence[int], *, radius_deg: float = RADIUS_DEG
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Weights of a posterior's explanations (n,), heaviest first, and the sample (n,) that each lies about.

    Args:
        posterior: of :func:`august_jax.inference.find_craft`.
        folds: of each craft of its library, the part of a circle from arm to arm (:func:`arms`); 1 where headings are
            told apart.
        radius_deg: how far an attitude may be from the one that stands for an explanation [deg].

    Raises:
        ValueError: not as many folds as the library has craft.
    """
    if len(folds) != posterior.crafts:
        raise ValueError(f"folds: got {len(folds)} for a library of {posterior.crafts} craft; give one a craft")
    reached = np.cumsum(np.asarray(posterior.weights, np.float64))
    marks = (np.arange(_DRAWS) + 0.5) / _DRAWS * reached[-1]
    drawn = np.minimum(np.searchsorted(reached, marks), len(reached) - 1)
    rows, times = np.unique(drawn, return_counts=True)
    left, craft = times / _DRAWS, posterior.craft[rows]
    near = [_near(posterior.rotation[rows[craft == name]], folds[name], radius_deg) for name in np.unique(craft)]
    members = [np.flatnonzero(craft == name) for name in np.unique(craft)]
    weights: list[float] = []
    centres: list[int] = []
    while left.sum() > 0.5 / _DRAWS:
        held = [each @ left[own] for each, own in zip(near, members, strict=True)]
        which = int(np.argmax([each.max() for each in held]))
        centre = int(np.argmax(held[which]))
        weights.append(float(held[which][centre]))
        centres.append(int(rows[members[which][centre]]))
        left[members[which][near[which][centre]]] = 0.0
    return np.asarray(weights), np.asarray(centres)


def effective_number(weights: Float[Array, " n"]) -> float:
    """1 / sum p^2 of the explanations' shares p of n weights."""
    shares = np.asarray(weights, np.float64) / np.sum(weights)
    return float(1.0 / np.sum(shares**2))


def turned_deg(first: Float[Array, "3 3"], second: Float[Array, "3 3"], fold: int) -> float:
    """Angle between two attitudes of a craft of so many arms, turns from arm to arm not counted [deg]."""
    most = np.max(_traces(np.asarray(first)[None], np.asarray(second)[None], fold))
    return float(np.degrees(np.arccos(np.clip(0.5 * (most - 1.0), -1.0, 1.0))))


def arms(airframe: Airframe) -> int:
    """n of a craft whose rotors lie where rotors lay after 1/n of a turn about its axis; 1 if they are not known."""
    if airframe.rotor_axes_m is None:
        return 1
    tips = np.asarray(airframe.rotor_axes_m)[:, 0] + 1j * np.asarray(airframe.rotor_axes_m)[:, 1]
    tips = tips - tips.mean()
    for count in _FOLDS:
        apart = np.abs(tips[:, None] * np.exp(2j * np.pi / count) - tips)
        if apart.min(axis=1).max() < 0.02 * np.abs(tips).max():
            return count
    return 1


def _traces(first: np.ndarray, second: np.ndarray, fold: int) -> np.ndarray:
    """tr(A^T B S) of attitudes A (n, 3, 3) and B (m, 3, 3) and all turns S from arm to arm (fold, n, m)."""
    angles = 2.0 * np.pi / fold * np.arange(fold)
    turns = np.array([[[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]] for a in angles])
    others = np.asarray(second, np.float64) @ turns[:, None]
    return np.asarray(first, np.float64).reshape(-1, 9) @ np.swapaxes(others.reshape(fold, -1, 9), 1, 2)


def _near(rotations: np.ndarray, fold: int, radius_deg: float) -> np.ndarray:
    return _traces(rotations, rotations, fold).max(axis=0) >= 1.0 + 2.0 * np.cos(np.radians(radius_deg)) - 1e-9
