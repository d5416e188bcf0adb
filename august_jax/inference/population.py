"""From explanations to samples of the posterior: a population that finds its own proposal.

A mixture of the prior and of Student distributions about explanations proposes craft, pose and material theta. Its
samples weigh

    w(theta) = p(theta) p(Z | theta) / q(theta),

the complex gain integrated out (:func:`log_mean_likelihood`). The next mixture has its parts about samples that weigh
much, each as wide as the echo's information there leaves it, and so on; at the end all samples are weighed together, q
being the mean of all rounds' mixtures, so that what one round met by luck another round's parts account for (the
balance heuristic of Veach and Guibas, 1995; adaptive multiple importance sampling, Cornuet et al., 2012). A later
mixture is not independent of the earlier samples, its parts lie about them: the part about a sample is left out of that
sample's own q, without which the evidence of an echo of 0 dB came out too small by a quarter to a half. Parts about its
descendants stay, which costs 2 % of the evidence in two rounds and 11 % in six.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from august_jax.arrays import Array, ArrayLike
from august_jax.inference.hypotheses import covariances, evenly_drawn
from august_jax.inference.prior import Prior
from august_jax.inference.refine import Candidates, begin, in_pieces
from august_jax.physics.body.local import local_coefficients
from august_jax.physics.body.table import Table
from august_jax.physics.parameters import rotation_from_vector
from august_jax.scene.pose import rotation_from_axis_yaw
from august_jax.signal.roi import Subspace, change_of_centre
from august_jax.signal.station import Statistics

PARTS = 384
"""Of a mixture, at most."""
_SAMPLES = 4096  # of each round
_ROUNDS = 6  # at most
_ENOUGH = 400.0  # samples that count, with which later rounds are spared
_SIZE = 8  # displacement, turn, permittivity, conductivity
_BLIND = 0.1  # of the samples are the prior's: an echo that says little is explained where no part lies
_DEGREES = 5.0  # of freedom of the parts: their tails are wider than a posterior's
_WIDER = 1.15
_NARROWER = 0.6  # than a mode: many parts share what one mode fills
_TEMPER = 0.4  # one sample may weigh more than all others
_TOGETHER = 64


class Poses(NamedTuple):
    """m craft, poses and materials: (m,), (m, 3, 3), (m, 3) [m], (m,) and (m,) [S/m]."""

    craft: Int[Array, " m"]
    rotation: Float[Array, "m 3 3"]
    position: Float[Array, "m 3"]
    permittivity: Float[Array, " m"]
    conductivity: Float[Array, " m"]


class Mixture(NamedTuple):
    """Student distributions about n poses; those beyond the real ones have no share.

    Attributes:
        middle: the poses (n, ...).
        factor: Cholesky factors of their covariances in displacement [m], turn [rad], permittivity and conductivity
            [S/m] (n, 8, 8).
        log_share: of the mixture (n,).
        origin: which correction of the tabulated coefficients holds about each (n,).
    """

    middle: Poses
    factor: Float[Array, "n 8 8"]
    log_share: Float[Array, " n"]
    origin: Int[Array, " n"]


def mixture(
    candidates: Candidates,
    share: Float[np.ndarray, " n"],
    origin: Int[np.ndarray, " n"],
    prior: Prior,
    narrower: float = 1.0,
) -> Mixture:
    """Parts about candidates, as wide as their information says.

    Args:
        candidates: n of them, at most :data:`PARTS`.
        share: of the mixture (n,), up to a factor.
        origin: which correction holds about each (n,).
        prior: that bounds their widths.
        narrower: by what the parts' standard deviations are multiplied.
    """
    inverse = covariances(candidates, prior)[:, :_SIZE, :_SIZE]
    scale = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
    correlation = inverse / scale[:, :, None] / scale[:, None]
    factor = narrower * scale[:, :, None] * np.linalg.cholesky(correlation + 1e-6 * np.eye(_SIZE))
    rows = np.pad(np.arange(len(share)), (0, PARTS - len(share)), mode="edge")  # one shape, one compilation
    log_share = np.where(np.arange(PARTS) < len(share), np.log(share[rows] / share.sum() + 1e-30), -1e9)
    middle = Poses(*(getattr(candidates, name) for name in Poses._fields))
    return Mixture(
        jax.tree.map(lambda leaf: np.asarray(leaf)[rows], middle),
        factor[rows].astype(np.float32),
        log_share.astype(np.float32),
        np.asarray(origin, np.int32)[rows],
    )


def populate(
    key: jax.Array,
    table: Table,
    subspace: Subspace,
    statistics: Statistics,
    prior: Prior,
    first: Mixture,
    corrections: Complex[Array, "c tones orders orders"],
) -> tuple[Poses, Float[np.ndarray, " m"]]:
    """Samples of the posterior and their log weights (m,), up to a constant; NumPy.

    Args:
        key: of the samples.
        table: of the known craft, stacked.
        subspace: of the station.
        statistics: of one slot.
        prior: over pose, material and gain.
        first: the mixture to begin with.
        corrections: what is added to the tabulated coefficients about each origin (c, F, K, K).
    """
    corrections, keys = jnp.asarray(corrections), jax.random.split(key, _ROUNDS)
    crafts = table.directions.shape[0]

    def density(of: Mixture, at: Poses) -> np.ndarray:
        return _log_density(of, at, crafts, statistics.centre, prior)

    def met(round_key: jax.Array, now: Mixture) -> tuple[Poses, np.ndarray, np.ndarray]:
        """Samples of a mixture, their origins and their log posterior."""
        poses, part = jax.tree.map(np.asarray, _proposed(round_key, now, crafts, statistics.centre, prior, _SAMPLES))
        origin = np.asarray(now.origin)[part]
        likely = in_pieces(
            lambda piece: _log_posterior(table, subspace, statistics, prior, corrections, *piece), (poses, origin)
        )
        return poses, origin, likely.astype(np.float64)

    mixtures = [first]
    poses, origin, likely = met(keys[0], first)
    proposed = density(first, poses)[None]  # of every mixture, at every sample
    log_weight = likely - proposed[0]
    for round_key in keys[1:]:
        if np.all(np.isneginf(log_weight)):
            break
        weight = np.exp(_TEMPER * (log_weight - log_weight.max()))
        rows, times = np.unique(evenly_drawn(weight, PARTS), return_counts=True)
        parts = begin(table, subspace, statistics, *jax.tree.map(lambda leaf, rows=rows: leaf[rows], poses))
        mixtures.append(mixture(parts, times.astype(float), origin[rows], prior, _NARROWER))
        proposed = np.concatenate([proposed, density(mixtures[-1], poses)[None]])
        new = met(round_key, mixtures[-1])
        proposed = np.concatenate([proposed, np.stack([density(each, new[0]) for each in mixtures])], axis=1)
        poses, origin, likely = jax.tree.map(lambda one, two: np.concatenate([one, two]), (poses, origin, likely), new)
        log_weight = likely - np.logaddexp.reduce(proposed, axis=0)
        weight = np.exp(log_weight - log_weight.max())
        if weight.sum() ** 2 / np.sum(weight**2) > _ENOUGH:
            break
    return poses, log_weight


@partial(jax.jit, static_argnames=("crafts", "count"))
def _proposed(key, mixture, crafts, centre, prior, count):
    """``count`` samples of a mixture, and the part of each; those of the prior have the last part's."""
    parts, shapes, chi, blind = jax.random.split(key, 4)
    known = count - round(_BLIND * count)
    # shares are met to the sample: fewer samples are wasted on chance
    places = (jnp.arange(known) + jax.random.uniform(parts)) / known
    last = mixture.log_share.shape[0] - 1
    part = jnp.minimum(jnp.searchsorted(jnp.cumsum(jnp.exp(mixture.log_share)), places), last)
    normal = jax.random.normal(shapes, (known, _SIZE))
    stretch = jnp.sqrt(_DEGREES / (2.0 * jax.random.gamma(chi, 0.5 * _DEGREES, (known,))))
    step = _WIDER * stretch[:, None] * jnp.einsum("nij,nj->ni", jnp.asarray(mixture.factor)[part], normal)
    about = jax.tree.map(lambda leaf: jnp.asarray(leaf)[part], mixture.middle)
    poses = Poses(
        about.craft,
        jax.vmap(rotation_from_vector)(step[:, 3:6]) @ about.rotation,
        about.position + step[:, :3],
        about.permittivity + step[:, 6],
        about.conductivity + step[:, 7],
    )
    poses = jax.tree.map(
        lambda one, two: jnp.concatenate([one, two]), poses, _blind(blind, crafts, centre, prior, count - known)
    )
    return poses, jnp.concatenate([part, jnp.full(count - known, last)])


def _blind(key, crafts, centre, prior, count):
    """Samples of the prior, the density of the tilt constant in each of its bins."""
    which, bin_key, within, heading, place, material = jax.random.split(key, 6)
    bins = prior.tilt_density.shape[0]
    row = jax.random.categorical(bin_key, jnp.log(prior.tilt_density), shape=(count,))
    cosine = 1.0 - (1.0 - jnp.cos(prior.tilt_rad)) * (row + jax.random.uniform(within, (count,))) / bins
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine**2, 0.0))
    azimuth, turn = jnp.pi * jax.random.uniform(heading, (2, count), minval=-1.0)
    axis = jnp.stack([sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine], axis=1)
    low, high = jnp.stack([prior.permittivity, prior.conductivity], axis=1)
    drawn = low + (high - low) * jax.random.uniform(material, (count, 2))
    return Poses(
        jax.random.randint(which, (count,), 0, crafts, jnp.int32),
        jax.vmap(rotation_from_axis_yaw)(axis, turn),
        centre + prior.half_m * jax.random.uniform(place, (count, 3), minval=-1.0),
        drawn[:, 0],
        drawn[:, 1],
    )


@partial(jax.jit, static_argnames="subspace")
def _log_posterior(table, subspace, statistics, prior, corrections, poses, origin):
    """Log of prior times likelihood (m,), up to a constant; none outside of the prior."""
    low, high = jnp.stack([prior.permittivity, prior.conductivity], axis=1)

    def one(each):
        pose, origin = each
        material = jnp.clip(jnp.stack([pose.permittivity, pose.conductivity]), low, high)
        found = local_coefficients(
            table,
            subspace.array,
            subspace.basis,
            pose.craft,
            pose.rotation,
            pose.position,
            material[0],
            material[1],
            derivatives=False,
        )
        change = change_of_centre(statistics.centre, pose.position, subspace)
        pilots = jnp.swapaxes(change, -1, -2) @ statistics.pilots
        heard = change @ ((found.values + corrections[origin]) @ pilots)
        energy, overlap = jnp.sum(jnp.abs(heard) ** 2), jnp.abs(jnp.sum(heard.conj() * statistics.received))
        return log_mean_likelihood(energy, overlap, prior.log_gain)

    likelihood = jax.lax.map(one, (poses, origin), batch_size=_TOGETHER)
    total = likelihood + prior.log_tilt(poses.rotation)
    return jnp.where(_inside(prior, statistics.centre, poses) & jnp.isfinite(total), total, -jnp.inf)


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


def _log_density(mixture: Mixture, poses: Poses, crafts: int, centre, prior: Prior) -> Float[np.ndarray, " m"]:
    """Of a mixture at poses (m,): per m^3, rad^3 of turn, permittivity and S/m; float64."""
    inverse = np.linalg.inv(np.asarray(mixture.factor, np.float64)) / _WIDER
    height = np.asarray(mixture.log_share) + np.sum(np.log(np.diagonal(inverse, axis1=1, axis2=2)), axis=1)
    height += math.lgamma(0.5 * (_DEGREES + _SIZE)) - math.lgamma(0.5 * _DEGREES)
    height -= 0.5 * _SIZE * np.log(_DEGREES * np.pi)
    shape = (mixture.middle, inverse.astype(np.float32), (height + np.log1p(-_BLIND)).astype(np.float32))
    return in_pieces(lambda piece: _log_densities(*shape, crafts, centre, prior, piece), poses).astype(np.float64)


@jax.jit
def _log_densities(middle, inverse, height, crafts, centre, prior, poses):
    turn = jnp.einsum("mij,nkj->mnik", poses.rotation, middle.rotation)
    apart = jnp.concatenate(
        [
            poses.position[:, None] - middle.position,
            _turn_of(turn),
            (poses.permittivity[:, None] - middle.permittivity)[..., None],
            (poses.conductivity[:, None] - middle.conductivity)[..., None],
        ],
        axis=-1,
    )
    square = jnp.sum(jnp.einsum("nij,mnj->mni", inverse, apart) ** 2, axis=-1)
    # A sample is no measure of the part that was laid about it: it sits at that part's peak, which would take from its
    # weight what nobody else gains, most of all where few samples lie.
    own = jnp.all(poses.position[:, None] == middle.position, axis=-1)
    density = height - 0.5 * (_DEGREES + _SIZE) * jnp.log1p(square / _DEGREES)
    density = jnp.where((poses.craft[:, None] == middle.craft) & ~own, density, -1e9)
    bins, lowest = prior.tilt_density.shape[0], jnp.cos(prior.tilt_rad)
    row = jnp.floor((1.0 - poses.rotation[:, 2, 2]) / (1.0 - lowest) * bins).astype(jnp.int32)
    widths = jnp.stack([prior.permittivity[1] - prior.permittivity[0], prior.conductivity[1] - prior.conductivity[0]])
    volume = 2.0 * jnp.pi * crafts * (2.0 * prior.half_m) ** 3 * jnp.prod(widths)  # 2 pi: headings
    blind = jnp.log(_BLIND) + jnp.log(prior.tilt_density)[jnp.clip(row, 0, bins - 1)] - jnp.log(volume)
    inside = _inside(prior, centre, poses) & (row < bins)
    return jnp.logaddexp(jax.scipy.special.logsumexp(density, axis=1), jnp.where(inside, blind, -jnp.inf))


def _inside(prior: Prior, centre: Float[Array, "3"], poses: Poses) -> Bool[jax.Array, " m"]:
    """Which poses lie in the ranges of a prior of position and material (m,)."""
    ranges = jnp.stack([prior.permittivity, prior.conductivity])
    material = jnp.stack([jnp.asarray(poses.permittivity), jnp.asarray(poses.conductivity)], axis=1)
    inside = jnp.all(jnp.abs(poses.position - centre) <= prior.half_m, axis=1)
    return inside & jnp.all((material >= ranges[:, 0]) & (material <= ranges[:, 1]), axis=1)


def _turn_of(rotation):
    """Rotation vectors (..., 3) of rotations (..., 3, 3)."""
    axis = jnp.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        axis=-1,
    )
    sine = 0.5 * jnp.sqrt(jnp.sum(axis**2, axis=-1) + 1e-20)
    cosine = 0.5 * (jnp.trace(rotation, axis1=-2, axis2=-1) - 1.0)
    angle = jnp.arctan2(sine, cosine)
    return axis * (0.5 * angle / sine)[..., None]
