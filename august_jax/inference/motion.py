"""How a craft's state moves over a slot, learned from random flights of the style that is flown.

The state holds what a slot's echo tells of and what ties one slot to the next, SIZE numbers in this order
(:data:`STATE`): place q, the horizontal part n of the thrust axis, heading, permittivity, conductivity, log-gain;
velocity v, acceleration a, and how far the heading turned in the last slot. Craft, material and the level of the gain
stay. Tilt and acceleration are tied: the axis follows (a + g e_z)/|a + g e_z| (:mod:`august_jax.scene.trajectory`),
so that an attitude that is seen tells of the acceleration, and this of the next place. Instead of writing that down
once more, flights of the configuration are flown and each step is fitted by

    (q' - q - v t, v' - v, a', n') = W f + noise of covariance Q,
    f = (1, v, a, n, lead of the walls, horizontal part of the axis that a asks for),

a sum of two such laws where one does not do: flights of style ``jump`` go straight on, or turn at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from august_jax import streams
from august_jax.config import FlightConfig
from august_jax.constants import GRAVITY
from august_jax.scene.trajectory import fly_many

STATE = ("x", "y", "z", "axis_x", "axis_y", "heading", "permittivity", "conductivity", "log_gain",
         "v_x", "v_y", "v_z", "a_x", "a_y", "a_z", "turned")  # fmt: skip
SIZE = len(STATE)
PLACE, AXIS, HEADING, SEEN = slice(0, 3), slice(3, 5), 5, 9
"""Where place, axis and heading are in a state; the first SEEN numbers are those of which an echo tells."""
_VELOCITY, _ACCELERATION, _TURNED = slice(9, 12), slice(12, 15), 15
_FLIGHTS, _SLOTS = 512, 20
_ZONE = 0.3  # depth of the zone along a wall in which flights are led back, in parts of the box's edge
_FLOOR = np.array([1e-3] * 3 + [1e-2] * 3 + [1e-1] * 3 + [3e-3] * 2)  # of what a law leaves open [m, m/s, m/s^2, 1]
_ROUNDS = 30
_WORTH = 1.0  # nats a step by which a second law must be better
_TURN_FLOOR = np.radians(0.1)
_GAIN_DRIFT = 1e-3


@dataclass(frozen=True, eq=False)
class Motion:
    """Laws of one style of flight.

    Attributes:
        slot_s: length of a slot [s].
        box_m: ends of the flights' box along x, y and z (3, 2) [m].
        slope: tangent of the largest tilt.
        share: how often each of L laws holds (L,).
        weights: W (L, 11, features).
        noise: Q (L, 11, 11).
        heading: factor by which a turn of the heading lasts, its innovation's standard deviation, and its own [rad].
        spread: covariance of n, v and a of a flight of which nothing is known (8, 8).
    """

    slot_s: float
    box_m: Float[np.ndarray, "3 2"]
    slope: float
    share: Float[np.ndarray, " laws"]
    weights: Float[np.ndarray, "laws 11 features"]
    noise: Float[np.ndarray, "laws 11 11"]
    heading: tuple[float, float, float]
    spread: Float[np.ndarray, "8 8"]

    @classmethod
    def of_flights(cls, flight: FlightConfig) -> Motion:
        """Learn the laws from flights of a configuration's style and box."""
        keys = streams.members(streams.key(0, "inference.motion"), np.arange(_FLIGHTS))
        flown = fly_many(keys, replace(flight, slots=_SLOTS))
        place, velocity, acceleration, rotation = (np.asarray(part, np.float64) for part in flown)
        axis, heading = rotation[..., :2, 2], np.unwrap(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]), axis=1)
        box, slope = np.asarray(flight.box_m, float), float(np.tan(np.radians(flight.tilt_deg)))
        now, then = np.s_[:, :-1], np.s_[:, 1:]
        features = _features(place[now], velocity[now], acceleration[now], axis[now], box, slope)
        moved = place[then] - place[now] - flight.slot_s * velocity[now]
        outcome = np.concatenate([moved, velocity[then] - velocity[now], acceleration[then], axis[then]], axis=-1)
        turns = np.diff(heading, axis=1)
        lasts = float(np.sum(turns[:, 1:] * turns[:, :-1]) / np.sum(turns[:, :-1] ** 2))
        new = float(np.std(turns[:, 1:] - lasts * turns[:, :-1]))
        every = np.concatenate([axis, velocity, acceleration], axis=-1).reshape(-1, 8)
        share, weights, noise = _laws(features.reshape(-1, features.shape[-1]), outcome.reshape(-1, 11))
        spread = np.cov(every.T) + 1e-6 * np.eye(8)
        turning = lasts, max(new, _TURN_FLOOR), max(float(np.std(turns)), _TURN_FLOOR)
        return cls(flight.slot_s, box, slope, share, weights, noise, turning, spread)

    def birth(self) -> tuple[Float[np.ndarray, "16"], Float[np.ndarray, "16 16"]]:
        """Mean and covariance of a craft's state of which nothing is known; place, material and gain are left at zero,
        for the caller to fill in."""
        covariance = np.zeros((SIZE, SIZE))
        rows = np.r_[3:5, 9:15]
        covariance[np.ix_(rows, rows)] = self.spread
        covariance[HEADING, HEADING] = np.pi**2 / 3.0
        covariance[_TURNED, _TURNED] = self.heading[2] ** 2
        return np.zeros(SIZE), covariance

    def step(self, states: Float[np.ndarray, "n 16"], law: int) -> Float[np.ndarray, "n 16"]:
        """Means of states (n, 16) a slot later, by one of the laws."""
        velocity, acceleration, axis = states[:, _VELOCITY], states[:, _ACCELERATION], states[:, AXIS]
        features = _features(states[:, PLACE], velocity, acceleration, axis, self.box_m, self.slope)
        outcome = features @ self.weights[law].T
        later = states.copy()
        later[:, PLACE] += self.slot_s * velocity + outcome[:, :3]
        later[:, _VELOCITY] += outcome[:, 3:6]
        later[:, _ACCELERATION] = outcome[:, 6:9]
        later[:, AXIS] = _shortened(outcome[:, 9:], np.sin(np.arctan(self.slope)))
        later[:, _TURNED] *= self.heading[0]
        later[:, HEADING] += later[:, _TURNED]
        return later

    def ahead(
        self, mean: Float[np.ndarray, "16"], covariance: Float[np.ndarray, "16 16"], law: int
    ) -> tuple[Float[np.ndarray, "16"], Float[np.ndarray, "16 16"]]:
        """Mean and covariance of a state a slot later, by one of the laws, which is taken for linear about the mean."""
        steps = 1e-4 * np.diag(np.maximum(np.sqrt(np.diagonal(covariance)), 1e-6) / 1e-1)
        there, back = self.step(mean + steps, law), self.step(mean - steps, law)
        slopes = ((there - back) / (2.0 * np.diagonal(steps)[:, None])).T
        noise = np.zeros((SIZE, SIZE))
        rows = np.r_[0:3, 9:15, 3:5]
        noise[np.ix_(rows, rows)] = self.noise[law]
        noise[np.ix_([HEADING, _TURNED], [HEADING, _TURNED])] = self.heading[1] ** 2
        noise[HEADING, HEADING] += (0.1 * self.heading[1]) ** 2
        noise[8, 8] = _GAIN_DRIFT**2
        return self.step(mean[None], law)[0], slopes @ covariance @ slopes.T + noise


def _features(place, velocity, acceleration, axis, box, slope):
    """What a step is fitted by (..., features)."""
    zone = _ZONE * (box[:, 1] - box[:, 0])
    near = np.maximum(1.0 - np.stack([place - box[:, 0], box[:, 1] - place]) / zone, 0.0)
    lift = GRAVITY + np.maximum(acceleration[..., 2:], -0.5 * GRAVITY)
    asked = _shortened(acceleration[..., :2] / lift, slope)
    one = np.ones((*place.shape[:-1], 1))
    return np.concatenate([one, velocity, acceleration, axis, near[0] - near[1], asked], axis=-1)


def _shortened(vectors, longest):
    return vectors * np.minimum(1.0, longest / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))


def _laws(features, outcome):
    """Shares (L,), W (L, 11, F) and Q (L, 11, 11) of one law, or of two where they are clearly better."""
    one, every = _fitted(features, outcome, np.ones(len(features)))
    single = _log_density(features, outcome, one, every)
    # the steps that one law fits best begin the first of two
    fit, noise = one, every
    for _ in range(_ROUNDS):
        likely = _log_density(features, outcome, fit, noise)
        fit, noise = _fitted(features, outcome, (likely >= np.quantile(likely, 0.6)).astype(float))
    laws, shares = [(fit, noise), (one, every)], np.array([0.5, 0.5])
    for _ in range(_ROUNDS):
        scores = np.stack([np.log(share) + _log_density(features, outcome, *law) for share, law in zip(shares, laws)])
        top = scores.max(axis=0)
        total = top + np.log(np.exp(scores - top).sum(axis=0))
        parts = np.exp(scores - total)
        shares = np.clip(parts.mean(axis=1), 1e-3, 1.0)
        shares /= shares.sum()
        laws = [_fitted(features, outcome, part) for part in parts]
    if total.mean() - single.mean() < _WORTH:
        laws, shares = [(one, every)], np.ones(1)
    return shares, np.stack([law[0] for law in laws]), np.stack([law[1] for law in laws])


def _fitted(features, outcome, weight):
    weighed = (weight[:, None] * features).T
    weights = np.linalg.solve(
        weighed @ features + 1e-9 * len(features) * np.eye(features.shape[1]), weighed @ outcome
    ).T
    left = outcome - features @ weights.T
    return weights, (weight[:, None] * left).T @ left / max(weight.sum(), 1.0) + np.diag(_FLOOR**2)


def _log_density(features, outcome, weights, noise):
    factor = np.linalg.cholesky(noise)
    left = np.linalg.solve(factor, (outcome - features @ weights.T).T)
    return -0.5 * np.sum(left**2, axis=0) - np.log(np.diagonal(factor)).sum() - 5.5 * np.log(2.0 * np.pi)
