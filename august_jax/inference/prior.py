"""What is known before an echo: where the craft may be, how it may be turned, what it may be made of, and the gain.

The posterior's prior is uniform over the cube of the prediction, headings and materials; thrust axes have the density
that a configuration's flights have, by tilt. A search moves in eight numbers and a complex gain; for it the same is a
Gaussian with the prior's spreads, about the middle of what is uniform, which bounds steps where the echo says nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.scene.pose import tilt
from august_jax.scene.trajectory import fly_many

TILT_BINS = 64
"""Of equal width in the cosine, from level to the largest tilt."""
_TURN_RAD = 0.5  # of a step's or a mode's attitude, where the echo says less
_FLIGHTS = 512
_EDGE_RAD, _EDGES = np.radians(0.5), 6.0  # of the tilt's density beyond the largest
_LEAST_OF, _LEAST_S_M = 1e-3, 1e-6  # of the ranges of material: relative, and of a conductivity that is zero
GAIN_DB = 1.0
"""Standard deviation to which the level of the gain is calibrated [dB], where nothing else is said."""


def _widened(low: float, high: float, least: float) -> tuple[float, float]:
    """The range, at least so wide."""
    more = 0.5 * max(least - (high - low), 0.0)
    return max(low - more, 0.0), high + more + max(more - low, 0.0)


class Prior(NamedTuple):
    """A prior over a craft's pose, material and gain; a pytree.

    Attributes:
        half_m: half the edge of the cube about q_pre in which the position is uniform [m].
        tilt_density: density of thrust axes per steradian, in bins of equal width in cos(tilt) (TILT_BINS,), the most
            level first; adds up to one over the sphere.
        tilt_rad: largest tilt [rad].
        permittivity, conductivity: ends of the uniform ranges (2,), [1] and [S/m].
        log_gain: standard deviation of the logarithm of the gain's modulus.
        phase_rad: standard deviation of the gain's phase [rad]; large where it is not known.
    """

    half_m: Float[Array, ""]
    tilt_density: Float[Array, " bins"]
    tilt_rad: Float[Array, ""]
    permittivity: Float[Array, "2"]
    conductivity: Float[Array, "2"]
    log_gain: Float[Array, ""]
    phase_rad: Float[Array, ""]

    @classmethod
    def from_config(cls, config: Config, *, gain_db: float = GAIN_DB, phase_deg: float | None = None) -> Prior:
        """The prior of a configuration's slots. A material that is one number is known to a thousandth of it: a range
        without width has no density.

        Args:
            config: region, flights and materials.
            gain_db: standard deviation to which the level of the gain is known [dB].
            phase_deg: of its phase [deg]; None where nothing is known of it.

        Raises:
            ValueError: a level that is not positive.
        """
        if not gain_db > 0.0:
            raise ValueError(f"gain_db: {gain_db:g} dB leaves no room; give a positive standard deviation, such as 1")
        flights = fly_many(streams.members(streams.key(0, "inference.tilt"), np.arange(_FLIGHTS)), config.flight)
        cosines = np.cos(np.asarray(tilt(flights.rotations), np.float64)).ravel()
        largest = float(np.radians(config.flight.tilt_deg))
        lowest = np.cos(largest)
        edges = np.linspace(1.0, lowest, TILT_BINS + 1)
        counts = np.histogram(np.clip(cosines, lowest, 1.0), edges[::-1])[0][::-1] + 0.5
        density = counts / counts.sum() / (2.0 * np.pi * (1.0 - lowest) / TILT_BINS)
        permittivity, conductivity = config.target.permittivity, config.target.conductivity_s_m
        numbers = (
            max(config.region.threshold_m, 1e-3),
            density,
            largest,
            _widened(*permittivity, _LEAST_OF * permittivity[1]),
            _widened(*conductivity, max(_LEAST_OF * conductivity[1], _LEAST_S_M)),
            gain_db * np.log(10.0) / 20.0,
            1e3 if phase_deg is None else np.radians(phase_deg),
        )
        return cls(*(jnp.asarray(number, jnp.float32) for number in numbers))

    def check(self) -> None:
        """Refuse a prior that leaves nothing to look at.

        Raises:
            ValueError: a width or a density that is not positive and finite, or a range that has no width; names it.
        """
        for name, wanted in (
            ("half_m", "give half the edge of a cube [m]"),
            ("tilt_density", "give every bin some, and let tilt_rad bound the tilt"),
            ("tilt_rad", "give the largest tilt [rad]"),
            ("log_gain", "give a standard deviation"),
            ("phase_rad", "give a standard deviation [rad], a large one where the phase is not known"),
        ):
            values = np.asarray(getattr(self, name), np.float64)
            good = np.isfinite(values) & (values > 0.0)
            if not good.all():
                raise ValueError(
                    f"prior: {name} is {values[~good].flat[0]:g}, which leaves nothing to look at; {wanted}"
                )
        for name in ("permittivity", "conductivity"):
            low, high = np.asarray(getattr(self, name), np.float64)
            if not (np.isfinite([low, high]).all() and low < high):
                raise ValueError(
                    f"prior: {name} from {low:g} to {high:g} leaves nothing to look at; give two finite numbers, the "
                    "smaller first (for one that is known a range of a thousandth of it)"
                )

    def log_tilt(self, rotation: Float[Array, "*n 3 3"]) -> Float[jax.Array, "*n"]:
        """Log density of thrust axes per steradian: linear between the bins' middles; beyond the largest tilt it falls
        off like a Gaussian of half a degree, and beyond three degrees there is none.

        Flights turn by just the largest tilt for an eighth of their time. Where the density ended there, half of what
        an echo allows about such an attitude would be cut off, and the best explanation with it.
        """
        bins = self.tilt_density.shape[0]
        lowest = jnp.cos(self.tilt_rad)
        place = (1.0 - rotation[..., 2, 2]) / (1.0 - lowest) * bins - 0.5
        values = jnp.interp(place, jnp.arange(bins), jnp.log(self.tilt_density))
        beyond = jnp.maximum(jnp.arccos(jnp.clip(rotation[..., 2, 2], -1.0, 1.0)) - self.tilt_rad, 0.0)
        return jnp.where(beyond < _EDGES * _EDGE_RAD, values - 0.5 * (beyond / _EDGE_RAD) ** 2, -jnp.inf)

    def middle(self) -> tuple[jax.Array, jax.Array]:
        """Middle of the ranges of permittivity and of conductivity [S/m]."""
        return jnp.mean(self.permittivity), jnp.mean(self.conductivity)

    def spreads(self) -> Float[jax.Array, "10"]:
        """Standard deviations of theta (:data:`august_jax.physics.parameters.PARAMETERS`) for a search's Gaussian; a
        turn's is about the attitude at hand."""

        def uniform(ends):
            return jnp.maximum((ends[1] - ends[0]) / np.sqrt(12.0), 1e-6)

        return jnp.stack(
            [
                *[self.half_m / np.sqrt(3.0)] * 3,
                *[jnp.float32(_TURN_RAD)] * 3,
                uniform(self.permittivity),
                uniform(self.conductivity),
                self.log_gain,
                self.phase_rad,
            ]
        )
