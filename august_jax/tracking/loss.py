"""Whether a craft that is followed is lost: what the echo says, and what was found against what was expected.

Three tests of one slot, each false in at most the share LEVEL of slots in which nothing is wrong, and a bound:

- **Silence.** Under noise alone, twice the energy of the statistics is a chi-square of as many degrees of freedom as
  they have real numbers. Below its (1 - LEVEL) point there is no echo to speak of.
- **From elsewhere.** The echo's bearing (:func:`august_jax.signal.towards`) is a ray; the craft is not in the region
  where that ray misses the cube of half edge s about q_pre by more than noise explains. A direction cosine is told to

    sigma_u = B / (k a sqrt(2 E)),   a^2 = mean x_n^2 of the antennas along the axis, E the echo's energy above noise;

  the square of the miss over that is a chi-square of two at most. B = 2, because a mean phase step tells less than
  the whole aperture.
- **A surprise.** With the innovation covariance S that the predictor states, e = q_est - q_pre has e^T S^-1 e as a
  chi-square of three; and whatever S, nothing outside of the cube can be believed.
- **Out of bounds.** Flights stay in the box of the configuration; a prediction or an estimate that is farther out than
  s is of none.

What is left: a miss along the line of sight, of an echo that hardly tells the range, by a scheme that does not tell it
either. Such a track stays silent until it leaves the box.

The predictor's S rests on the errors that it expects of estimates. Where these are larger, so are innovations: S is
scaled by how much they have been so far (:class:`Spread`).
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import Config
from august_jax.signal.roi import Coefficients, Subspace, project, towards
from august_jax.signal.station import Observation, RegionObservation, Statistics

LEVEL = 1e-3
"""How often each test may call a craft lost that is not."""
_STEPS_TELL = 2.0
"""B."""
_WEIGHT = 8.0
"""Slots that what is known of a predictor beforehand counts as much as."""


class Spread(NamedTuple):
    """How large squared innovations are in units of the stated covariance, an axis.

    Attributes:
        total: their sum, a predictor's own spread counted _WEIGHT times ().
        count: how many there are, those included ().
    """

    total: Float[Array, ""]
    count: Float[Array, ""]

    @classmethod
    def of(cls, spread: float) -> Spread:
        """Before the first innovation: what is known of the predictor."""
        return cls(jnp.float32(_WEIGHT * spread), jnp.float32(_WEIGHT))

    def factor(self, spread: float) -> Float[jax.Array, ""]:
        """By what the stated covariance is multiplied (): never less than what is known of the predictor."""
        return jnp.maximum(self.total / self.count, spread)

    def heard(self, square: ArrayLike, factor: ArrayLike, counts: ArrayLike) -> Spread:
        """After an innovation of e^T S^-1 e = ``square``, S as stated. One beyond the gate counts as one at it, so that
        a loss does not excuse the next; where ``counts`` is false nothing changes."""
        kept = jnp.where(counts, jnp.minimum(square, gate(3) * factor) / 3.0, 0.0)
        return Spread(self.total + kept, self.count + jnp.where(counts, 1.0, 0.0))


@cache
def gate(degrees: int) -> float:
    """What a chi-square of so many degrees of freedom exceeds with the probability LEVEL."""
    from scipy.stats import chi2

    return float(chi2.isf(LEVEL, degrees))


def silent(statistics: Statistics) -> Bool[jax.Array, ""]:
    """Whether noise alone would leave as much in more than LEVEL of slots (); what is no number was not heard."""
    heard = 2.0 * jnp.sum(jnp.abs(statistics.received) ** 2) >= gate(2 * statistics.received.size)
    return ~heard


def from_elsewhere(seen: Observation | RegionObservation, predicted: Float[Array, "3"], config: Config) -> jax.Array:
    """Whether the echo's bearing misses the region about q_pre (3,) [m]; ()."""
    subspace = Subspace.from_config(config.array)
    heard = seen.heard if isinstance(seen.heard, Coefficients) else project(seen.heard, predicted, subspace)
    direction = towards(heard, subspace)
    distance = jnp.linalg.norm(predicted)
    direction = direction / distance
    energy = jnp.sum(jnp.abs(seen.statistics.received) ** 2) - seen.statistics.received.size
    aperture = np.std(subspace.positions, axis=0)[::2]
    told = float(np.mean(subspace.wavenumbers)) * aperture[aperture > 0.0].min(initial=np.inf)
    error_m = _STEPS_TELL * distance / (told * jnp.sqrt(2.0 * jnp.maximum(energy, 1.0)))
    half = config.region.scale_m + np.sqrt(gate(2)) * error_m
    # between which of its points the ray is within the cube along each axis
    along = jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    ends = jnp.stack([(predicted - half) / along, (predicted + half) / along])
    return jnp.max(jnp.min(ends, axis=0)) > jnp.min(jnp.max(ends, axis=0))


def out_of_bounds(place: Float[Array, "3"], config: Config) -> Bool[jax.Array, ""]:
    """Whether a place (3,) [m] is farther outside of the flight box than the region reaches ()."""
    low, high = np.asarray(config.flight.box_m, np.float32).T
    reach = config.region.scale_m
    return jnp.any((place < low - reach) | (place > high + reach))


def surprise(
    innovation: Float[Array, "3"], covariance: Float[Array, "3 3"], scale_m: float
) -> tuple[Float[jax.Array, ""], Bool[jax.Array, ""]]:
    """e^T S^-1 e () of an innovation e (3,) [m] under the stated S (3, 3) [m^2], and whether e leaves the cube of half
    edge ``scale_m`` [m]."""
    return innovation @ jnp.linalg.solve(covariance, innovation), jnp.any(jnp.abs(innovation) > scale_m)
