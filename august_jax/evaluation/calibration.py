"""Whether a posterior means what it says, of weighted samples and the truth that each slot hides.

A posterior p(x | y) of a slot is given by samples x_i of weights w_i that add up to one. If truth and echo are drawn
from the same prior and model that the posterior assumes, then, whatever the function t of x,

    level = sum of w_i over all t(x_i) < t(truth)

is uniform from 0 to 1 over slots. Each level here takes another t:

    rank             the number itself (simulation-based calibration, Talts et al. 2018)
    position_level   Mahalanobis distance from the posterior's mean: the ellipsoid of credibility c holds the truth
                     where the level is at most c
    normal_level     angle to the mean normal: the cone of credibility c, likewise
    distance_level   distance to a point drawn without looking at the truth (TARP, Lemos et al. 2023); uniform at any
                     such point only if the posterior is the true one, where ellipsoids can cover by being wide

Samples as far as the truth count half. Levels of m effective samples are uniform to within 1/m or so. What becomes of
them over n slots is told by :func:`coverage` with its binomial error, and by :func:`uniformity` with a p-value.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy import stats

from august_jax.arrays import Array

_RIDGE = 1e-6
"""Of a covariance's largest variance, so that a cloud that is flat has a distance across, too [1]."""


def rank(values: Float[Array, " m"], weights: Float[Array, " m"], truth: float | np.floating) -> float:
    """Weight of the samples below the truth.

    Args:
        values: of m samples.
        weights: of the samples, not negative; they need not add up to one.
        truth: in the values' unit.

    Returns:
        The level, from 0 (all samples are above) to 1.

    Raises:
        ValueError: shapes that do not fit, or weights that are negative, not finite or all zero.
    """
    values, weights = np.asarray(values, np.float64), _shares(weights, values, "values", 1)
    below = float(weights @ (values < truth) + 0.5 * (weights @ (values == truth)))
    return min(below, 1.0)  # sums of many weights round


def position_level(positions: Float[Array, "m 3"], weights: Float[Array, " m"], truth: Float[Array, "3"]) -> float:
    """Credibility of the smallest ellipsoid about the posterior's mean, shaped as its covariance, that holds the truth.

    Args:
        positions: of m samples [m].
        weights: of the samples.
        truth: the true position [m].

    Returns:
        The level, from 0 (the truth is the mean) to 1 (no sample is as far out).

    Raises:
        ValueError: as :func:`rank`.
    """
    positions, weights = np.asarray(positions, np.float64), _shares(weights, positions, "positions", 2)
    about = positions - weights @ positions
    covariance = (weights[:, None] * about).T @ about
    covariance += np.eye(3) * max(_RIDGE * np.trace(covariance), np.finfo(float).tiny)
    inverse = np.linalg.inv(covariance)
    own = np.asarray(truth, np.float64) - weights @ positions
    return rank(np.einsum("ni,ij,nj->n", about, inverse, about), weights, own @ inverse @ own)


def normal_level(normals: Float[Array, "m 3"], weights: Float[Array, " m"], truth: Float[Array, "3"]) -> float:
    """Credibility of the narrowest cone about the posterior's mean direction that holds the true one.

    Args:
        normals: unit vectors of m samples.
        weights: of the samples.
        truth: the true unit vector.

    Raises:
        ValueError: as :func:`rank`.
    """
    normals, weights = np.asarray(normals, np.float64), _shares(weights, normals, "normals", 2)
    mean = weights @ normals
    # not the cosine, which is flat at zero: the chord
    chords = np.linalg.norm(normals - mean / max(np.linalg.norm(mean), np.finfo(float).tiny), axis=1)
    own = np.linalg.norm(np.asarray(truth, np.float64) - mean / max(np.linalg.norm(mean), np.finfo(float).tiny))
    return rank(chords, weights, own)


def distance_level(
    positions: Float[Array, "m 3"], weights: Float[Array, " m"], truth: Float[Array, "3"], reference: Float[Array, "3"]
) -> float:
    """Weight of the samples that are nearer to a reference point than the truth is.

    Args:
        positions: of m samples [m].
        weights: of the samples.
        truth: the true position [m].
        reference: drawn without looking at the truth, though it may look at the echo and at q_pre [m].

    Raises:
        ValueError: as :func:`rank`.
    """
    positions, reference = np.asarray(positions, np.float64), np.asarray(reference, np.float64)
    weights = _shares(weights, positions, "positions", 2)
    own = np.linalg.norm(np.asarray(truth, np.float64) - reference)
    return rank(np.linalg.norm(positions - reference, axis=1), weights, own)


def coverage(levels: Float[Array, " n"], credibility: float) -> tuple[float, float]:
    """Share of slots whose region of the given credibility holds the truth, and its standard error.

    Args:
        levels: of n slots, from any function of this module whose regions grow with the level.
        credibility: 0.9 for the region of 90 %.

    Returns:
        Share and binomial standard error, as :func:`share`.

    Raises:
        ValueError: a credibility outside 0 to 1, or no slot.
    """
    if not 0.0 <= credibility <= 1.0:
        raise ValueError(f"credibility: got {credibility:g}; give a share from 0 to 1, such as 0.9")
    return share(np.asarray(levels) <= credibility)


def share(flags: Array) -> tuple[float, float]:
    """Share of the n flags (n,) that hold, and its standard error.

    The error is binomial at (k + 1)/(n + 2) for k of n, and so is not zero where all or none hold.

    Raises:
        ValueError: no flag.
    """
    flags = np.asarray(flags, bool)
    count = flags.size
    if not count:
        raise ValueError("flags: got none; give one a slot")
    middle = (flags.sum() + 1.0) / (count + 2.0)
    return float(flags.mean()), float(np.sqrt(middle * (1.0 - middle) / count))


def histogram(levels: Float[Array, " n"], bins: int = 10) -> Float[np.ndarray, " bins"]:
    """How many levels of n slots lie in each of ``bins`` equal parts of 0 to 1."""
    return np.histogram(np.clip(levels, 0.0, 1.0), bins=bins, range=(0.0, 1.0))[0].astype(float)


def uniformity(levels: Float[Array, " n"], bins: int = 10) -> tuple[float, float]:
    """Pearson's test that levels are uniform.

    Args:
        levels: of n slots.
        bins: of the histogram; five slots a bin or more make the p-value good.

    Returns:
        chi-square of ``bins`` - 1 degrees of freedom, and the probability of one as large if levels are uniform.

    Raises:
        ValueError: fewer slots or bins than two.
    """
    if bins < 2 or np.size(levels) < 2:
        raise ValueError(f"bins, levels: got {bins} bins and {np.size(levels)} levels; give two or more of each")
    counts = histogram(levels, bins)
    expected = counts.sum() / bins
    statistic = float(np.sum((counts - expected) ** 2) / expected)
    return statistic, float(stats.chi2.sf(statistic, bins - 1))


def bootstrap_error(
    values: Float[Array, "n *shape"],
    statistic: Callable[[np.ndarray], float | np.floating] = np.mean,
    *,
    draws: int = 500,
    seed: int = 0,
) -> float:
    """Standard error of a statistic over n slots, from ``draws`` samples of n slots with replacement.

    Args:
        values: one entry a slot.
        statistic: of such an array, to a number.
        draws: how many.
        seed: of the draws.

    Raises:
        ValueError: no slot.
    """
    values = np.asarray(values)
    if not len(values):
        raise ValueError("values: got none; give one a slot")
    generator = np.random.default_rng(seed)
    found = [float(statistic(values[generator.integers(len(values), size=len(values))])) for _ in range(draws)]
    return float(np.std(found, ddof=1))


def _shares(weights: Array, samples: np.ndarray, name: str, axes: int) -> np.ndarray:
    """Weights that add up to one."""
    weights = np.asarray(weights, np.float64)
    if samples.ndim != axes or weights.shape != samples.shape[:1] or (axes == 2 and samples.shape[1] != 3):
        raise ValueError(
            f"{name}, weights: got shapes {samples.shape} and {weights.shape}; give "
            f"{'(m, 3)' if axes == 2 else '(m,)'} and (m,)"
        )
    total = weights.sum()
    if not np.all(weights >= 0.0) or not 0.0 < total < np.inf:
        raise ValueError(f"weights: got {weights.min():g} to {weights.max():g}; give weights that are not negative")
    return weights / total
