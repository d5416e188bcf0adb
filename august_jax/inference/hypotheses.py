"""From explanations to a posterior: modes, their Laplace weights, and weighted samples that correct them.

Modes (refined candidates) give a mixture of Student distributions, each about its mode with the covariance of its
information. Samples theta of it are weighed by posterior over mixture, the complex gain integrated out
(:func:`log_mean_likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from august_jax.arrays import Array, ArrayLike
from august_jax.inference.prior import Prior
from august_jax.inference.refine import Candidates, cost
from august_jax.physics.body.local import local_coefficients
from august_jax.physics.body.table import Table
from august_jax.physics.parameters import rotation_from_vector
from august_jax.signal.roi import Subspace, change_of_centre
from august_jax.signal.station import Statistics

_DEGREES = 5.0  # of freedom of the mixture's parts: their tails are wider than a posterior's
_WIDER = 1.15
_TOGETHER = 64
_SIZE = 7  # displacement, turn, permittivity; conductivity is drawn from its prior


class Hypotheses(NamedTuple):
    """n explanations of one echo, most probable first; NumPy.

    Attributes:
        craft: which of the library's (n,).
        rotation: body to world (n, 3, 3).
        position: (n, 3) [m].
        permittivity, conductivity: (n,), [1] and [S/m].
        weight: posterior probability of each (n,); they add up to one.
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


class Mixture(NamedTuple):
    """Student distributions about n modes.

    Attributes:
        craft, rotation, position, permittivity: the modes.
        factor: Cholesky factors of their covariances in displacement, turn and permittivity (n, 7, 7).
        log_share: of the mixture (n,).
        correction: what is added to a mode's tabulated coefficients (n, F, K, K).
    """

    craft: Int[Array, " n"]
    rotation: Float[Array, "n 3 3"]
    position: Float[Array, "n 3"]
    permittivity: Float[Array, " n"]
    factor: Float[Array, "n 7 7"]
    log_share: Float[Array, " n"]
    correction: Complex[Array, "n tones orders orders"]


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
    inverse = covariances(candidates, prior)[:, :9, :9]  # of what is not a phase
    _, volume = np.linalg.slogdet(inverse)
    costs = np.asarray(cost(candidates, statistics, prior), np.float64)
    tilts = np.asarray(prior.log_tilt(candidates.rotation), np.float64)
    return -costs + 0.5 * volume + np.maximum(tilts, -30.0)


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


@partial(jax.jit, static_argnames=("subspace", "count"))
def sampled(
    key: jax.Array, table: Table, subspace: Subspace, statistics: Statistics, prior: Prior, mixture: Mixture, count: int
) -> tuple[jax.Array, ...]:
    """``count`` samples of a mixture: craft, rotation, position, permittivity, conductivity, log weight, part."""
    parts, shapes, chi, losses = jax.random.split(key, 4)
    # shares are met to the sample: fewer samples are wasted on chance
    places = (jnp.arange(count) + jax.random.uniform(parts)) / count
    part = jnp.minimum(jnp.searchsorted(jnp.cumsum(jnp.exp(mixture.log_share)), places), mixture.log_share.shape[0] - 1)
    normal = jax.random.normal(shapes, (count, _SIZE))
    stretch = jnp.sqrt(_DEGREES / (2.0 * jax.random.gamma(chi, 0.5 * _DEGREES, (count,))))
    step = _WIDER * stretch[:, None] * jnp.einsum("nij,nj->ni", mixture.factor[part], normal)
    craft = mixture.craft[part]
    rotation = jax.vmap(rotation_from_vector)(step[:, 3:6]) @ mixture.rotation[part]
    position = mixture.position[part] + step[:, :3]
    permittivity = mixture.permittivity[part] + step[:, 6]
    low, high = prior.conductivity
    conductivity = low + (high - low) * jax.random.uniform(losses, (count,))
    proposed = _density(mixture, craft, rotation, position, permittivity)

    def one(each):
        craft, rotation, position, permittivity, conductivity, part = each
        found = local_coefficients(
            table,
            subspace.array,
            subspace.basis,
            craft,
            rotation,
            position,
            jnp.clip(permittivity, *prior.permittivity),
            conductivity,
            derivatives=False,
        )
        change = change_of_centre(statistics.centre, position, subspace)
        pilots = jnp.swapaxes(change, -1, -2) @ statistics.pilots
        heard = change @ ((found.values + mixture.correction[part]) @ pilots)
        energy, overlap = jnp.sum(jnp.abs(heard) ** 2), jnp.abs(jnp.sum(heard.conj() * statistics.received))
        return log_mean_likelihood(energy, overlap, prior.log_gain)

    likelihood = jax.lax.map(one, (craft, rotation, position, permittivity, conductivity, part), batch_size=_TOGETHER)
    inside = jnp.all(jnp.abs(position - statistics.centre) <= prior.half_m, axis=1)
    inside &= (permittivity >= prior.permittivity[0]) & (permittivity <= prior.permittivity[1])
    log_prior = jnp.where(inside, prior.log_tilt(rotation), -jnp.inf)
    return craft, rotation, position, permittivity, conductivity, likelihood + log_prior - proposed, part


def log_mean_likelihood(energy: ArrayLike, overlap: ArrayLike, log_gain: ArrayLike) -> Float[jax.Array, ""]:
    """Log likelihood of a model of unit gain, averaged over the gain: phase uniform, modulus log-normal about one.

    Relative to an echo without a craft, log of the mean of I0(2 g b) exp(-g^2 a): on a grid of g where the echo is
    weak, and by its leading order, Laplace's in log g, where it is strong and a grid would have to be fine.

    Args:
        energy: a, ||m||^2 of the model at a gain of one, in units of the noise.
        overlap: b, |<m, Z>|.
        log_gain: s, standard deviation of log g.
    """
    levels = jnp.linspace(-4.0, 4.0, 49)
    gains = jnp.exp(levels * log_gain)
    wave = 2.0 * gains * overlap
    parts = jnp.log(jax.scipy.special.i0e(wave)) + wave - gains**2 * energy - 0.5 * levels**2
    coarse = jax.scipy.special.logsumexp(parts) + jnp.log(8.0 / 48.0 / np.sqrt(2.0 * np.pi))
    match = jnp.maximum(overlap**2 / energy, 1e-3)
    level = jnp.log(jnp.maximum(overlap, 1e-20) / energy)
    # I0 falls as 1/sqrt(4 pi match); log g has a variance of 1/(2 match) about the level, and the prior's about zero
    width = 1.0 / (2.0 * match)
    joint = width + log_gain**2
    fine = match - 0.5 * jnp.log(4.0 * np.pi * match) + 0.5 * jnp.log(width / joint) - 0.5 * level**2 / joint
    return jnp.where(width < (0.25 * log_gain) ** 2, fine, coarse)


def _density(mixture, craft, rotation, position, permittivity):
    """Log density (m,) of a mixture at samples."""
    log_volume = -jnp.sum(jnp.log(jnp.diagonal(mixture.factor, axis1=1, axis2=2)), axis=1)

    def part(each):
        which, turned, place, material, factor, volume, share = each
        turn = _turn_of(rotation @ turned.T)
        apart = jnp.concatenate([position - place, turn, (permittivity - material)[:, None]], axis=1)
        whitened = jax.scipy.linalg.solve_triangular(factor, apart.T, lower=True) / _WIDER
        square = jnp.sum(whitened**2, axis=0)
        density = share + volume - 0.5 * (_DEGREES + _SIZE) * jnp.log1p(square / _DEGREES)
        return jnp.where(craft == which, density, -jnp.inf)

    parts = jax.lax.map(
        part,
        (
            mixture.craft,
            mixture.rotation,
            mixture.position,
            mixture.permittivity,
            mixture.factor,
            log_volume,
            mixture.log_share,
        ),
    )
    return jax.scipy.special.logsumexp(parts, axis=0)


def _turn_of(rotation):
    """Rotation vectors (m, 3) of rotations (m, 3, 3)."""
    axis = jnp.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    sine = 0.5 * jnp.sqrt(jnp.sum(axis**2, axis=1) + 1e-20)
    cosine = 0.5 * (jnp.trace(rotation, axis1=1, axis2=2) - 1.0)
    angle = jnp.arctan2(sine, cosine)
    return axis * (0.5 * angle / sine)[:, None]
