"""Where the target will be in the next slot, from the positions estimated so far (paper, Section III).

* ``finite_difference`` is the paper's kinematic prediction: velocity and acceleration by backward differences,
  q + v dt + a dt^2 / 2 = 2.5 q_1 - 2 q_2 + 0.5 q_3 with q_1 the latest. It multiplies the error of an estimate by 3.2.
* ``kalman`` holds position, velocity and acceleration, with white noise of spectral density J [m^2/s^5] as the jerk:

      x+ = F x,   F = [[1, t, t^2/2], [0, 1, t], [0, 0, 1]],
      Q = J [[t^5/20, t^4/8, t^3/6], [t^4/8, t^3/3, t^2/2], [t^3/6, t^2/2, t]],

  each for three axes that the estimator's covariance may couple (range is measured worse than direction). An
  acceleration that forgets with time constant T at standard deviation s has the density J = 2 s^2/T at its fast end.

The filter is a pytree and three functions, fit for ``jax.lax.scan`` over slots.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

GAINS = (2.5, -2.0, 0.5)
"""Weights of the latest, last but one and last but two positions."""


class KalmanState(NamedTuple):
    """Belief about the motion.

    Attributes:
        mean: position [m], velocity [m/s] and acceleration [m/s^2] as rows (3, 3).
        covariance: of the flattened mean (9, 9).
    """

    mean: jax.Array
    covariance: jax.Array


class Prediction(NamedTuple):
    """The next position (3,) [m] and the covariance (3, 3) [m^2] of the innovation, next estimate minus prediction."""

    position: jax.Array
    covariance: jax.Array


def finite_difference(positions: jax.Array) -> jax.Array:
    """Next position (3,) [m] from the past ones (T, 3) [m], oldest first.

    The last three count. Two are continued at constant velocity, one is repeated.

    Raises:
        ValueError: no position, or a shape other than (T, 3).
    """
    _check(positions)
    if positions.shape[0] == 1:
        return positions[-1]
    if positions.shape[0] == 2:
        return 2.0 * positions[-1] - positions[-2]
    return GAINS[0] * positions[-1] + GAINS[1] * positions[-2] + GAINS[2] * positions[-3]


def kalman(
    positions: jax.Array, *, slot_s: float, noise_m: float | jax.Array = 0.05, jerk_density: float = 1.0
) -> Prediction:
    """Next position from the past estimates, by a filter over all of them.

    Args:
        positions: estimates (T, 3) [m], oldest first, T >= 1.
        slot_s: time between them [s].
        noise_m: standard deviation of an estimate [m], or its covariance (3, 3) [m^2].
        jerk_density: J [m^2/s^5]; 1 for a gently flown multirotor, some 90 for an agile one.

    Returns:
        :class:`Prediction`.

    Raises:
        ValueError: a shape other than (T, 3), or no position.
    """
    _check(positions)

    def step(state, position):
        ahead = kalman_predict(state, slot_s=slot_s, jerk_density=jerk_density)
        return kalman_update(ahead, position, noise_m=noise_m), None

    state, _ = jax.lax.scan(step, kalman_start(positions[0], noise_m=noise_m), positions[1:])
    ahead = kalman_predict(state, slot_s=slot_s, jerk_density=jerk_density)
    return Prediction(ahead.mean[0], innovation_covariance(ahead, noise_m=noise_m))


def kalman_start(
    position: jax.Array,
    *,
    noise_m: float | jax.Array = 0.05,
    velocity_m_s: float = 5.0,
    acceleration_m_s2: float = 3.0,
) -> KalmanState:
    """Belief after the first estimate: at rest, with the given standard deviations of velocity and acceleration."""
    mean = jnp.zeros((3, 3), position.dtype).at[0].set(position)
    blocks = [_noise(noise_m, position.dtype)]
    blocks += [jnp.square(jnp.asarray(spread, position.dtype)) * jnp.eye(3, dtype=position.dtype)
               for spread in (velocity_m_s, acceleration_m_s2)]
    return KalmanState(mean, jax.scipy.linalg.block_diag(*blocks))


def kalman_predict(state: KalmanState, *, slot_s: float, jerk_density: float = 1.0) -> KalmanState:
    """The belief one slot later."""
    t = slot_s
    eye = jnp.eye(3, dtype=state.mean.dtype)
    motion = jnp.array([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]], state.mean.dtype)
    drift = jerk_density * jnp.array(
        [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]], state.mean.dtype
    )
    full = jnp.kron(motion, eye)
    return KalmanState(motion @ state.mean, full @ state.covariance @ full.T + jnp.kron(drift, eye))


def innovation_covariance(state: KalmanState, *, noise_m: float | jax.Array = 0.05) -> jax.Array:
    """Covariance (3, 3) [m^2] of an estimate about the believed position."""
    return state.covariance[:3, :3] + _noise(noise_m, state.mean.dtype)


def kalman_update(state: KalmanState, position: jax.Array, *, noise_m: float | jax.Array = 0.05) -> KalmanState:
    """The belief after an estimate ``position`` (3,) [m] of standard deviation or covariance ``noise_m``."""
    noise = _noise(noise_m, state.mean.dtype)
    gain = jnp.linalg.solve(innovation_covariance(state, noise_m=noise_m), state.covariance[:3, :]).T
    # Joseph's form stays symmetric and positive in float32.
    kept = jnp.eye(9, dtype=state.mean.dtype).at[:, :3].add(-gain)
    mean = state.mean + (gain @ (position - state.mean[0])).reshape(3, 3)
    return KalmanState(mean, kept @ state.covariance @ kept.T + gain @ noise @ gain.T)


def _noise(noise_m: float | jax.Array, dtype) -> jax.Array:
    """Covariance (3, 3) from a standard deviation or from itself."""
    noise = jnp.asarray(noise_m, dtype)
    return noise if noise.ndim == 2 else jnp.square(noise) * jnp.eye(3, dtype=dtype)


def _check(positions: jax.Array) -> None:
    if positions.ndim != 2 or positions.shape[-1] != 3 or positions.shape[0] < 1:
        raise ValueError(f"positions: got shape {positions.shape}; give one past position or more, (T, 3) in metres")
