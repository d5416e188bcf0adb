"""What an echo says: the modes that explain it, and weighted samples of the posterior about and between them.

Modes are refined candidates that differ; Laplace's approximation of their evidence says where samples are to begin
(:mod:`august_jax.inference.population`), and the samples say what each mode weighs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from august_jax.arrays import Array
from august_jax.inference.prior import Prior
from august_jax.inference.refine import Candidates, scored
from august_jax.signal.station import Statistics

_APART_RAD, _APART_M = np.radians(5.0), 0.1  # that count alike where the mode nearest to a pose is asked for


class Hypotheses(NamedTuple):
    """n explanations of one echo, most probable first; NumPy.

    Attributes:
        craft: which of the library's (n,).
        rotation: body to world (n, 3, 3).
        position: (n, 3) [m].
        permittivity, conductivity: (n,), [1] and [S/m].
        weight: posterior probability of what is nearer to each than to the others (n,); they add up to one.
        residual: ||Z - model||^2 in units of the noise (n,).
        covariance: of displacement [m], turn in world axes [rad], permittivity and conductivity [S/m] (n, 8, 8).
    """

    craft: Int[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]
    position: Float[np.ndarray, "n 3"]
    permittivity: Float[np.ndarray, " n"]
    conductivity: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n 8 8"]


@dataclass(frozen=True)
class Posterior:
    """What one echo says, given the known craft; NumPy arrays of one slot.

    Attributes:
        hypotheses: the modes.
        craft, rotation, position, permittivity, conductivity: m samples (m, ...).
        log_weight: of each sample (m,), normalised.
        crafts: how many the library holds, C.
        effective: effective number of the samples, 1 / sum of squared weights.
        residual: ||Z - model||^2 of the best hypothesis, in units of the noise.
        degrees: real degrees of freedom of 2 ``residual`` where the hypothesis is true.
        probability: that noise alone leaves as much.
        level: below which it counts as unexplained.
        seconds: what each stage took [s].
        silence: probability that noise alone, without any craft, is as loud as the echo.
    """

    hypotheses: Hypotheses
    craft: Int[np.ndarray, " m"]
    rotation: Float[np.ndarray, "m 3 3"]
    position: Float[np.ndarray, "m 3"]
    permittivity: Float[np.ndarray, " m"]
    conductivity: Float[np.ndarray, " m"]
    log_weight: Float[np.ndarray, " m"]
    crafts: int
    effective: float
    residual: float
    degrees: int
    probability: float
    level: float
    seconds: dict[str, float]
    silence: float = 0.0

    @property
    def heard(self) -> bool:
        """Whether the echo is louder than noise alone would be; where it is not, it tells of no craft: some attitudes
        of any craft send next to nothing back, and explain silence."""
        return self.silence < self.level

    @property
    def explained(self) -> bool:
        """Whether the best hypothesis leaves no more than noise would."""
        return self.probability >= self.level

    @property
    def found(self) -> bool:
        """Whether a known craft is there: something is heard, and one of them explains it."""
        return self.heard and self.explained

    @property
    def weights(self) -> Float[np.ndarray, " m"]:
        """Of the samples; they add up to one."""
        return np.asarray(np.exp(self.log_weight))

    @property
    def mean_position(self) -> Float[np.ndarray, "3"]:
        """Posterior mean of the position [m]."""
        return self.weights @ self.position

    @property
    def position_covariance(self) -> Float[np.ndarray, "3 3"]:
        """Posterior covariance of the position [m^2]."""
        apart = self.position - self.mean_position
        return (apart * self.weights[:, None]).T @ apart

    @property
    def mean_normal(self) -> Float[np.ndarray, "3"]:
        """Direction of the posterior mean of the rotor plane's normal, a unit vector."""
        mean = self.weights @ self.rotation[:, :, 2]
        return mean / max(float(np.linalg.norm(mean)), 1e-12)

    @property
    def craft_probability(self) -> Float[np.ndarray, " craft"]:
        """Posterior probability of each craft of the library (C,)."""
        return np.bincount(self.craft, self.weights, self.crafts)

    @property
    def material(self) -> tuple[float, float, float, float]:
        """Mean and standard deviation of permittivity, then of conductivity [S/m]."""
        found = []
        for values in (self.permittivity, self.conductivity):
            mean = float(self.weights @ values)
            found += [mean, float(np.sqrt(max(float(self.weights @ (values - mean) ** 2), 0.0)))]
        return found[0], found[1], found[2], found[3]


def covariances(candidates: Candidates, prior: Prior) -> Float[np.ndarray, "n 10 10"]:
    """Inverse information (n, 10, 10) of candidates under the prior's Gaussian, float64."""
    precision = np.asarray(candidates.information, np.float64) + np.diag(1.0 / np.asarray(prior.spreads(), float) ** 2)
    scale = 1.0 / np.sqrt(np.diagonal(precision, axis1=1, axis2=2))
    scaled = precision * scale[:, None] * scale[:, :, None]
    values, vectors = np.linalg.eigh(scaled)
    inverse = (vectors / np.maximum(values, 1e-7)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return inverse * scale[:, None] * scale[:, :, None]


def evidence(candidates: Candidates, statistics: Statistics, prior: Prior) -> Float[np.ndarray, " n"]:
    """Laplace's approximation of each mode's log evidence (n,), up to a constant that all share."""
    _, volume = np.linalg.slogdet(covariances(candidates, prior)[:, :9, :9])  # of what is not a phase
    costs, tilts = scored(candidates, statistics, prior)
    return -costs + 0.5 * volume + np.maximum(tilts, -30.0)


def evenly_drawn(weight: Float[np.ndarray, " n"], count: int, start: float = 0.5) -> Int[np.ndarray, "{count}"]:
    """``count`` rows, each as often as its weight says: systematic resampling, whose error is small.

    Args:
        weight: of n rows, up to a factor.
        count: how many rows.
        start: of the marks, in their spacing; uniform between 0 and 1 where the draw is to be without bias.
    """
    reached = np.cumsum(np.asarray(weight, np.float64))
    marks = (np.arange(count) + start) / count
    return np.minimum(np.searchsorted(reached, marks * reached[-1]), len(reached) - 1)


def shared_out(score: Float[np.ndarray, " n"], craft: Int[np.ndarray, " n"], most: int) -> Int[np.ndarray, " n"]:
    """Rows by score, lowest first, but that the first ``most`` hold ``most``/2C of each of C craft, if there are.

    What an echo of little power says cannot be told from the best residuals alone: a craft may explain it a little
    worse in many more ways.
    """
    order = np.argsort(score, kind="stable")
    names = np.unique(craft)
    rank = np.empty(len(order), np.int64)  # within the own craft
    for name in names:
        own = order[craft[order] == name]
        rank[own] = np.arange(len(own))
    first = rank < most // (2 * len(names))
    return np.concatenate([order[first[order]], order[~first[order]]])


def distinct(candidates: Candidates, score: Float[np.ndarray, " n"], prior: Prior, most: int) -> Int[np.ndarray, " m"]:
    """Rows of the best candidates that differ, best first: in craft, or by 1 degree or 0.12 m and two deviations; no
    craft takes more than its share of ``most`` while others have any."""
    rotation, position = np.asarray(candidates.rotation), np.asarray(candidates.position)
    craft, inverse = np.asarray(candidates.craft), np.linalg.inv(covariances(candidates, prior)[:, :6, :6])
    kept: list[int] = []
    for row in shared_out(np.asarray(score), craft, most):
        moved = position[row] - position[kept]
        turn = rotation[row] @ np.swapaxes(rotation[kept], 1, 2)
        trace = np.trace(turn, axis1=1, axis2=2)
        near = (trace > 1.0 + 2.0 * np.cos(np.radians(1.0))) & (np.linalg.norm(moved, axis=1) < 0.12)
        around = 0.5 * (turn - np.swapaxes(turn, 1, 2))[:, [2, 0, 1], [1, 2, 0]]
        step = np.concatenate([moved, around], axis=1)
        apart = np.einsum("ni,nij,nj->n", step, inverse[kept], step)
        near |= (trace > 1.0 + 2.0 * np.cos(np.radians(20.0))) & (apart < 4.0)
        if not np.any(near & (craft[kept] == craft[row])):
            kept.append(int(row))
        if len(kept) == most:
            break
    return np.asarray(sorted(kept, key=lambda row: float(score[row])))


def nearest(
    modes: Candidates | Hypotheses,
    craft: Int[Array, " n"],
    rotation: Float[Array, "n 3 3"],
    position: Float[Array, "n 3"],
) -> Int[np.ndarray, " n"]:
    """The mode of the same craft that is nearest to each of n poses (n,); -1 where its craft has none."""
    trace = np.einsum("nij,mij->nm", np.asarray(rotation), np.asarray(modes.rotation))
    turn = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    moved = np.linalg.norm(np.asarray(position)[:, None] - np.asarray(modes.position), axis=-1)
    apart = (turn / _APART_RAD) ** 2 + (moved / _APART_M) ** 2
    apart = np.where(np.asarray(craft)[:, None] == np.asarray(modes.craft), apart, np.inf)
    return np.where(np.isfinite(apart.min(axis=1)), apart.argmin(axis=1), -1)
