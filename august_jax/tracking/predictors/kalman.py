"""A Kalman filter over estimated positions: it halves the error of finite differences under noise of centimetres.

It holds position, velocity and acceleration, with white noise of spectral density J [m^2/s^5] as the jerk:

    x+ = F x,   F = [[1, t, t^2/2], [0, 1, t], [0, 0, 1]],
    Q = J [[t^5/20, t^4/8, t^3/6], [t^4/8, t^3/3, t^2/2], [t^3/6, t^2/2, t]],

each for three axes that the estimator's covariance may couple (range is measured worse than direction). An
acceleration that forgets with time constant T at standard deviation s has the density J = 2 s^2/T at its fast end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import FlightConfig
from august_jax.tracking.predictors.protocol import ESTIMATE_M, Prediction, real

_JERK_DENSITY = {"smooth": 1.0, "dynamic": 90.0, "jump": 90.0}
"""J [m^2/s^5] by style of flight: 2 sigma_a^2 / tau of the flights."""
_SPREAD = {"smooth": 1.0, "dynamic": 0.7, "jump": 9.4}
"""By style, of estimates that err as the filter takes them to: experiments/prediction.py, mean of both boxes."""


class Motion(NamedTuple):
    """Belief about the motion.

    Attributes:
        mean: position [m], velocity [m/s] and acceleration [m/s^2] as rows (3, 3).
        covariance: of the flattened mean (9, 9).
    """

    mean: Float[Array, "3 3"]
    covariance: Float[Array, "9 9"]


@dataclass(frozen=True)
class Kalman:
    """The filter.

    Attributes:
        slot_s: time between estimates [s].
        noise_m: standard deviation of an estimate along each axis [m]; :meth:`update` takes a covariance as well.
        jerk_density: J [m^2/s^5]; 1 for a gently flown multirotor, some 90 for an agile one. A filter of arrays () in
            place of numbers may be mapped over; it is not hashable.
        velocity_m_s, acceleration_m_s2: standard deviations after the first estimate, at rest.
        spread: see :class:`Predictor`.
    """

    slot_s: float
    noise_m: ArrayLike = 0.05
    jerk_density: ArrayLike = 1.0
    velocity_m_s: float = 5.0
    acceleration_m_s2: float = 3.0
    spread: float = 1.0

    @classmethod
    def for_flight(cls, flight: FlightConfig) -> Kalman:
        """For flights of a style, seen by networks that err by a decimetre."""
        style = flight.style
        return cls(flight.slot_s, noise_m=ESTIMATE_M, jerk_density=_JERK_DENSITY[style], spread=_SPREAD[style])

    def start(self, position: Float[Array, "3"]) -> Motion:
        """See :class:`Predictor`."""
        position = real(position)
        mean = jnp.zeros((3, 3), position.dtype).at[0].set(position)
        spreads = jnp.array([self.noise_m, self.velocity_m_s, self.acceleration_m_s2], position.dtype)
        return Motion(mean, jnp.diag(jnp.repeat(spreads**2, 3)))

    def predict(self, state: Motion) -> tuple[Motion, Prediction]:
        """See :class:`Predictor`."""
        t, dtype = self.slot_s, state.mean.dtype
        motion = jnp.array([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]], dtype)
        drift = self.jerk_density * jnp.array(
            [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]], dtype
        )
        eye = jnp.eye(3, dtype=dtype)
        full = jnp.kron(motion, eye)
        ahead = Motion(motion @ state.mean, full @ state.covariance @ full.T + jnp.kron(drift, eye))
        return ahead, Prediction(ahead.mean[0], ahead.covariance[:3, :3] + self._noise(self.noise_m, dtype))

    def update(self, state: Motion, position: Float[Array, "3"], noise_m: ArrayLike | None = None) -> Motion:
        """See :class:`Predictor`; ``noise_m``: of this estimate, a standard deviation [m] or a covariance (3, 3)
        [m^2]."""
        noise = self._noise(self.noise_m if noise_m is None else noise_m, state.mean.dtype)
        gain = jnp.linalg.solve(state.covariance[:3, :3] + noise, state.covariance[:3, :]).T
        # Joseph's form stays symmetric and positive in float32.
        kept = jnp.eye(9, dtype=state.mean.dtype).at[:, :3].add(-gain)
        mean = state.mean + (gain @ (position - state.mean[0])).reshape(3, 3)
        return Motion(mean, kept @ state.covariance @ kept.T + gain @ noise @ gain.T)

    @staticmethod
    def _noise(noise_m: ArrayLike, dtype: jnp.dtype) -> jax.Array:
        """Covariance (3, 3) from a standard deviation or from itself."""
        noise = jnp.asarray(noise_m, dtype)
        return noise if noise.ndim == 2 else jnp.square(noise) * jnp.eye(3, dtype=dtype)
