"""Following one craft from slot to slot: what explained the last echo says where and how turned the next comes from.

Hypotheses are Gaussians over states (:mod:`august_jax.inference.motion`), each of one craft, with a weight. In a slot
each is moved as flights move; candidates about it climb the echo's likelihood times that prediction, first at noise
taken for greater than it is, then on the factored body. With a mode's misfit r, slope g and information L of the
numbers that an echo tells of, the phase of the gain integrated out, and its distance e from a prediction of
covariance P,

    d = P (I + L P)^-1 (L e + g),    P+ = P - P L (I + P L)^-1 P,
    log evidence = -r - d^T P^-1 d / 2 - (d - e)^T L (d - e) / 2 + g^T (d - e) - log det(I + L P) / 2,

are the step from the prediction, its covariance, and what the hypothesis' weight is multiplied by: a Gaussian sum
filter of iterated updates. What stays (craft, material, level of the gain) is learned over slots: where the level is,
the power of an echo tells the range, which one echo hardly does.

The whole search (:func:`august_jax.inference.find_craft`) is made at the start and wherever the best hypothesis
leaves more of an echo than noise would, or moved as flights hardly do. Where that explains nothing either, the craft is
lost: the slot says so, craft, material and gain are kept, and the next slots are listened to where a detection puts
it, as the first ones are.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.inference.climb import Expectation, begun_at, climbed, polished_about, turning, worth_about
from august_jax.inference.echo import bearing, chance, degrees_left, echo_snr_db
from august_jax.inference.find import LEVEL, find_craft
from august_jax.inference.hypotheses import distinct, evenly_drawn, shared_out
from august_jax.inference.library import Library
from august_jax.inference.motion import AXIS, HEADING, PLACE, SEEN, SIZE, Motion
from august_jax.inference.prior import Prior
from august_jax.inference.refine import Candidates, in_pieces
from august_jax.progress import Progress, silent
from august_jax.scene.pose import rotation_from_axis_yaw
from august_jax.signal.station import Statistics

DETECTED_SLOTS = 3
"""Slots after a start or a loss that are listened to where a detection puts the craft: a speed takes as many."""
SEARCHED = 1e-3
"""Where noise leaves as much as the best explanation about a prediction less often than this, everything is searched;
and where a flight moves as far from its prediction less often than a hundredth of this."""
LOST = 1e-4
"""Where noise leaves as much as the best explanation less often than this, a craft that was followed is lost."""
_PARENTS = 12
_KEPT = 8
_LEAST = 1e-5  # of a hypothesis' weight
_BORN = 1e-3  # chance that a whole search meets another craft than the one that was followed
_STAYED = 0.9  # chance that a craft that was lost is the one that comes back
_LOOKED = 512
_STAGES = (
    (128, 2, 16.0),
    (48, 3, 24.0),
    (24, 8, 60.0),
)  # candidates kept, steps, SNR [dB] of which the noise is at least
_POLISHED = 4
_POLISH = 6
_WORSE = 15.0  # what is this much less likely than the best, by its logarithm, is not polished
_SAMPLES = 2000


class Belief(NamedTuple):
    """A hypothesis: one craft in one state, and how surely.

    Attributes:
        craft: which of the library's.
        log_weight: logarithm of its probability.
        mean, covariance: of the state (16,) and (16, 16), in the order of :data:`august_jax.inference.motion.STATE`.
    """

    craft: int
    log_weight: float
    mean: Float[np.ndarray, "16"]
    covariance: Float[np.ndarray, "16 16"]


@dataclass(frozen=True)
class Step:
    """What is known after a slot; NumPy arrays.

    Attributes:
        slot: its number.
        predicted: where it was listened (3,) [m].
        detected: whether a detection said so, and not the past.
        searched: whether the whole search was made.
        lost: whether the craft was lost: nothing that is known explains the echo.
        craft: of n hypotheses, most probable first (n,).
        rotation, position: their poses (n, 3, 3), (n, 3) [m].
        permittivity, conductivity: their materials (n,), [1] and [S/m].
        weight: their probabilities (n,).
        samples: positions of the posterior (m, 3) [m].
        mean_position, mean_normal: posterior means (3,) [m] and (3,), a unit vector.
        expected_error_m: what the mean position is expected to err by [m].
        expected_mde: expectation of 1 - cos between the normal and its mean.
        craft_probability: of each craft of the library (C,).
        probability: that noise alone leaves as much as the best hypothesis.
        level: below which it counts as unexplained.
        seconds: that the slot took [s].
    """

    slot: int
    predicted: Float[np.ndarray, "3"]
    detected: bool
    searched: bool
    lost: bool
    craft: Int[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]
    position: Float[np.ndarray, "n 3"]
    permittivity: Float[np.ndarray, " n"]
    conductivity: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    samples: Float[np.ndarray, "m 3"]
    mean_position: Float[np.ndarray, "3"]
    mean_normal: Float[np.ndarray, "3"]
    expected_error_m: float
    expected_mde: float
    craft_probability: Float[np.ndarray, " craft"]
    probability: float
    level: float
    seconds: float

    @property
    def explained(self) -> bool:
        """Whether the best hypothesis leaves no more than noise would."""
        return self.probability >= self.level


class Follower:
    """Follows one craft. In every slot ask :meth:`place` where to listen, and tell :meth:`hear` what was heard there.

    Args:
        library: the known craft.
        config: of the flights, regions and materials; by default the library's.
        seed: of what is drawn.
        level: below which the best residual's probability under noise counts as unexplained.
        progress: told of whole searches.
    """

    @streams.pin
    def __init__(
        self,
        library: Library,
        config: Config | None = None,
        *,
        seed: int = 0,
        level: float = LEVEL,
        progress: Progress = silent,
    ):
        self.library, self.config = library, library.config if config is None else config
        self.prior = Prior.from_config(self.config)
        self.motion = Motion.of_flights(self.config.flight)
        self._seed, self._level, self._progress = seed, level, progress
        self._slot, self._sure, self._lost = 0, 0, True
        self._known: list[Belief] = []  # after the last slot
        self._expected: list[Belief] = []  # before the echo of this one
        self._place: np.ndarray | None = None

    @streams.pin
    def place(self, detection: Float[Array, "3"]) -> Float[np.ndarray, "3"]:
        """Where the next slot is to be listened to (3,) [m].

        Args:
            detection: where a detection puts the craft (3,) [m]; taken for the first slots and after a loss alone.

        Raises:
            ValueError: a detection that is needed and not finite.
        """
        self._expected = [] if self._lost else self._moved()
        if self._lost or self._sure < DETECTED_SLOTS:
            place = np.asarray(detection, np.float64)
            if place.shape != (3,) or not np.all(np.isfinite(place)):
                raise ValueError(f"detection: {detection} is no place; give (x, y, z) in metres")
        else:
            place = max(self._expected, key=lambda each: each.log_weight).mean[PLACE]
        self._place = np.asarray(place, np.float32)
        return self._place

    @streams.pin
    def hear(self, statistics: Statistics) -> Step:
        """Take a slot's echo, heard about :meth:`place`.

        Raises:
            ValueError: it was heard elsewhere, or is not finite, or of other tones or another array than the library's.
        """
        began = time.perf_counter()
        if self._place is None or not np.max(np.abs(np.asarray(statistics.centre) - self._place)) <= 1e-4:
            raise ValueError(
                f"statistics: heard about {np.asarray(statistics.centre)}; listen at place(...), and then hear"
            )
        tones, orders = len(self.library.table.frequencies_hz), self.library.subspace.orders
        for name, value in (("received", statistics.received), ("pilots", statistics.pilots)):
            if np.shape(value) != (tones, orders, orders):
                raise ValueError(
                    f"statistics: {name} has shape {np.shape(value)}; the library's {tones} tone(s) and {orders} "
                    f"functions want {(tones, orders, orders)}; give one slot, of the library's tones and array"
                )
            if not np.all(np.isfinite(np.asarray(value))):
                raise ValueError(f"statistics: {name} holds numbers that are not finite; leave that slot out")
        statistics = jax.tree.map(jnp.asarray, statistics)
        detected, searched = self._lost or self._sure < DETECTED_SLOTS, False
        if self._lost:  # or never found yet
            found: list[_Child] = []
            parents = [self._born(each.craft, _STAYED * np.exp(each.log_weight), each) for each in self._known]
        else:
            parents = [self._detected(each) for each in self._expected] if detected else self._expected
            parents = _heaviest(parents, _PARENTS)
            found = self._locally(statistics, parents)
        probability = self._probability(statistics, found)
        if probability < SEARCHED or self._far_off(found):
            self._progress(f"slot {self._slot + 1}: searching for the craft among all attitudes of all that are known")
            found, searched = found + self._everywhere(statistics, parents), True
            probability = self._probability(statistics, found)
        kept = _merged(found)
        lost = probability < (
            self._level if self._lost else LOST
        )  # what is met anew has nothing else that speaks for it
        if lost:
            self._sure = 0
            told = self._nowhere(kept)
        else:
            self._known, self._sure = kept, self._sure + 1
            told = kept
        self._lost = lost
        step = self._told(told, detected, searched, lost, probability, time.perf_counter() - began)
        self._slot, self._place = self._slot + 1, None
        return step

    def _moved(self) -> list[Belief]:
        """Hypotheses a slot later, one for each law of motion."""
        moved = []
        for each in self._known:
            for law, share in enumerate(self.motion.share):
                ahead = self.motion.ahead(each.mean, each.covariance, law)
                moved.append(Belief(each.craft, each.log_weight + float(np.log(share)), *ahead))
        return moved

    def _born(self, craft: int, chance: float, kept: Belief | None = None) -> Belief:
        """A craft of which nothing is known but that it is about the place; of a lost one, material and gain."""
        prior = self.prior
        mean, covariance = self.motion.birth()
        spreads = np.asarray(prior.spreads(), float)
        assert self._place is not None
        mean[PLACE] = self._place
        mean[6:8] = [float(part) for part in prior.middle()]
        covariance[PLACE, PLACE] = np.eye(3) * spreads[0] ** 2
        covariance[6:9, 6:9] = np.diag(spreads[6:9] ** 2)
        if kept is not None:
            mean[6:9], covariance[6:9, 6:9] = kept.mean[6:9], kept.covariance[6:9, 6:9]
        return Belief(craft, float(np.log(chance)), mean, covariance)

    def _nowhere(self, guessed: Sequence[Belief]) -> list[Belief]:
        """What is known of a craft that is lost: it was expected about the place, and what it is, if it was known."""
        known = []
        for each in self._known or guessed:
            born = self._born(each.craft, float(np.exp(each.log_weight)), each if self._known else None)
            if self._expected:  # it may be as far as it was thought to be, and farther
                born.covariance[PLACE, PLACE] += self._expected[0].covariance[PLACE, PLACE]
            known.append(born)
        return known

    def _detected(self, each: Belief) -> Belief:
        """A prediction with what a detection says: the craft is in the cube about the place."""
        error = (float(self.prior.half_m) ** 2 / 3.0) * np.eye(3)
        gain = np.linalg.solve(each.covariance[PLACE, PLACE] + error, each.covariance[PLACE]).T
        mean = each.mean + gain @ (self._place - each.mean[PLACE])
        return each._replace(mean=mean, covariance=each.covariance - gain @ each.covariance[PLACE])

    def _locally(self, statistics: Statistics, parents: Sequence[Belief]) -> list[_Child]:
        """What candidates about predictions lead to."""
        library, expected = self.library, _expectations(parents)
        ranges = jnp.stack([self.prior.permittivity, self.prior.conductivity])
        shared = (library.table, library.subspace, statistics)
        rng = np.random.default_rng([self._seed, self._slot])
        weights = np.array([each.log_weight for each in parents])
        seeds, which = _seeds(rng, parents, _LOOKED, self._bearing(statistics), library, np.asarray(ranges))
        found = in_pieces(lambda piece: begun_at(*shared, *piece), seeds)

        def climb(heat, steps, piece):
            return climbed(*shared, expected, ranges, *piece, heat, steps)

        snr_db = echo_snr_db(statistics, library.subspace)
        for kept, steps, noise_db in _STAGES:
            heat = jnp.float32(max(1.0, 10.0 ** ((snr_db - noise_db) / 10.0)))
            found, which = in_pieces(partial(climb, heat, steps), (found, which))
            worth = worth_about(found, expected, which, heat) - weights[which] / float(heat)
            rows = shared_out(worth, which, kept)[:kept]
            found, which = found.at(rows), which[rows]
        worth = worth_about(found, expected, which, 1.0) - weights[which]
        best = [
            row
            for parent in np.unique(which)
            for own in [np.flatnonzero(which == parent)]
            for row in own[distinct(found.at(own), worth[own], self.prior, _POLISHED)]
        ]
        best = sorted(best, key=lambda row: float(worth[row]))
        best = [row for row in best if worth[row] < worth[best[0]] + _WORSE][:_PARENTS]
        return self._polished(statistics, parents, found.at(np.array(best)), which[best])

    def _polished(self, statistics, parents, found: Candidates, which, steps: int = _POLISH) -> list[_Child]:
        """Children of the candidates, on the factored bodies."""
        library, expected = self.library, _expectations(parents)
        ranges = jnp.stack([self.prior.permittivity, self.prior.conductivity])
        children = []
        for craft in np.unique(found.craft):
            rows = np.flatnonzero(found.craft == craft)
            for piece in np.array_split(rows, -(-len(rows) // 2)):
                padded = np.resize(piece, 2)
                better = polished_about(
                    library.body(int(craft)),
                    library.table,
                    library.subspace,
                    statistics,
                    expected,
                    ranges,
                    jax.tree.map(lambda leaf, rows=padded: jnp.asarray(leaf[rows]), found),
                    jnp.asarray(which[padded]),
                    steps,
                )
                better = jax.tree.map(np.asarray, better)
                for row, original in enumerate(piece):
                    parent = int(which[original])
                    mode = jax.tree.map(lambda leaf, row=row: leaf[row], better)
                    children.append(_updated(parents[parent], parent, mode, np.asarray(ranges)))
        return children

    def _everywhere(self, statistics: Statistics, predicted: Sequence[Belief]) -> list[_Child]:
        """What the whole search leads to, by predictions or by a craft of which nothing was known."""
        library, crafts = self.library, len(self.library.targets)
        key = streams.key(self._seed, "follow.search", self._slot)
        posterior = find_craft(library, statistics, self.prior, key=key, level=self._level)
        these = posterior.hypotheses
        rows = np.flatnonzero(these.weight > 1e-3)[:_PARENTS]
        share = 1.0 if not self._known else 1.0 - _STAYED if self._lost else _BORN
        # predictions first: they keep the numbers that the local search knows them by
        parents = [*predicted, *(self._born(craft, share / crafts) for craft in range(crafts))]
        pairs = [
            (row, number)
            for row in rows
            for number, parent in enumerate(parents)
            if parent.craft == int(these.craft[row]) and (number >= len(predicted) or _may_be(parent, these, row))
        ]
        each, which = np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs], np.int32)
        start = (
            np.asarray(these.craft[each], np.int32),
            *(
                np.asarray(part, np.float32)
                for part in (
                    these.rotation[each],
                    these.position[each],
                    these.permittivity[each],
                    these.conductivity[each],
                    np.array([parents[number].mean[8] for number in which]),
                )
            ),
        )
        shared = (library.table, library.subspace, statistics)
        begun = in_pieces(lambda piece: begun_at(*shared, *piece), start)
        return self._polished(statistics, parents, begun, which, 2 * _POLISH)  # the gain is not known yet

    @staticmethod
    def _probability(statistics: Statistics, found: Sequence[_Child]) -> float:
        if not found:
            return 0.0
        best = max(found, key=lambda child: child.belief.log_weight)
        return chance(best.residual, degrees_left(statistics))

    @staticmethod
    def _far_off(found: Sequence[_Child]) -> bool:
        """Whether even the best moved as flights hardly do: so does a hypothesis that only seems to fit."""
        from scipy.stats import chi2

        best = max(found, key=lambda child: child.belief.log_weight)
        return bool(chi2.sf(best.apart, SEEN) < 1e-2 * SEARCHED)

    def _bearing(self, statistics: Statistics) -> np.ndarray:
        """The unit vector (3,) towards which the echo comes from."""
        place = np.asarray(bearing(statistics, self.library.subspace, self.config.region.scale_m), float)
        return place / np.linalg.norm(place)

    def _told(self, kept, detected, searched, lost, probability, seconds) -> Step:
        weight = np.exp([each.log_weight for each in kept])
        rng = np.random.default_rng([self._seed, self._slot, 1])
        drawn = evenly_drawn(weight, _SAMPLES)
        states = np.concatenate(
            [
                rng.multivariate_normal(each.mean, each.covariance, int(np.sum(drawn == row)), method="eigh")
                for row, each in enumerate(kept)
            ]
        )
        places = states[:, PLACE]
        flat = states[:, AXIS]
        flat = flat * np.minimum(1.0, 0.95 / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9))
        normals = np.concatenate([flat, np.sqrt(1.0 - np.sum(flat**2, axis=1, keepdims=True))], axis=1)
        mean = np.einsum("n,ni->i", weight / weight.sum(), np.array([each.mean[PLACE] for each in kept]))
        normal = normals.mean(axis=0)
        normal /= np.linalg.norm(normal)
        means = np.array([each.mean for each in kept])
        crafts = np.array([each.craft for each in kept])
        assert self._place is not None
        return Step(
            self._slot, np.asarray(self._place, float), detected, searched, lost,
            crafts, rotations_of(means), means[:, PLACE], means[:, 6], means[:, 7], weight / weight.sum(),
            places, mean, normal,
            float(np.mean(np.linalg.norm(places - mean, axis=1))), float(np.mean(1.0 - normals @ normal)),
            np.bincount(crafts, weight / weight.sum(), len(self.library.targets)), probability, self._level, seconds,
        )  # fmt: skip


class _Child(NamedTuple):
    """A hypothesis after an echo, the number of what it came from, the misfit of its mode, and how far it is from what
    was expected: the square, in standard deviations."""

    belief: Belief
    parent: int
    residual: float
    apart: float


def rotations_of(states: Float[np.ndarray, "n 16"]) -> Float[np.ndarray, "n 3 3"]:
    """Attitudes (n, 3, 3), body to world, of states (n, 16)."""
    flat = states[:, AXIS]
    flat = flat * np.minimum(1.0, 0.95 / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9))
    axis = np.concatenate([flat, np.sqrt(1.0 - np.sum(flat**2, axis=1, keepdims=True))], axis=1)
    return np.asarray(rotation_from_axis_yaw(jnp.asarray(axis), jnp.asarray(states[:, HEADING])), np.float64)


def _heaviest(parents, most):
    top = max(each.log_weight for each in parents)
    likely = [each for each in parents if each.log_weight > top + np.log(_LEAST)]
    return sorted(likely, key=lambda each: -each.log_weight)[:most]


def _expectations(parents) -> Expectation:
    size = 2 * _PARENTS * -(-len(parents) // (2 * _PARENTS))  # one shape, one compilation
    rows = np.minimum(np.arange(size), len(parents) - 1)
    precision = [np.linalg.inv(each.covariance[:SEEN, :SEEN]) for each in parents]
    return Expectation(
        jnp.asarray(np.array([parents[row].mean[:SEEN] for row in rows]), jnp.float32),
        jnp.asarray(np.array([precision[row] for row in rows]), jnp.float32),
    )


def _may_be(parent, these, row) -> bool:
    """Whether a mode lies within what a prediction thinks possible: five deviations in place and attitude."""
    rotation = these.rotation[row]
    seen = np.concatenate([these.position[row], rotation[:2, 2], [np.arctan2(rotation[1, 0], rotation[0, 0])]])
    apart = seen - parent.mean[:6]
    apart[5] = (apart[5] + np.pi) % (2.0 * np.pi) - np.pi
    spread = parent.covariance[:6, :6] + np.diag([0.1**2] * 3 + [0.03**2] * 3)
    return float(apart @ np.linalg.solve(spread, apart)) < 36.0


def _seeds(rng, parents, count, sight, library, ranges):
    """States to begin with, drawn about predictions, and which of these each is about."""
    share = max(count // len(parents), 48)
    states, which = [], []
    for number, each in enumerate(parents):
        spread = each.covariance[:SEEN, :SEEN]
        pose = np.r_[3:6]
        factor = np.linalg.cholesky(spread[np.ix_(pose, pose)] + 1e-10 * np.eye(3))
        drawn = 1.2 * rng.standard_normal((share, 3)) @ factor.T
        drawn[0] = 0.0
        follow = np.linalg.solve(spread[np.ix_(pose, pose)] + 1e-10 * np.eye(3), spread[pose]).T
        state = each.mean[:SEEN] + drawn @ follow.T
        wide = np.sqrt(np.linalg.eigvalsh(spread[PLACE, PLACE])[-1])
        if wide > 0.15:  # the echo's bearing knows better
            distance = np.linalg.norm(state[:, PLACE], axis=1, keepdims=True)
            state[:, PLACE] = distance * sight + 0.08 * rng.standard_normal((share, 3))
        states.append(state)
        which.append(np.full(share, number, np.int32))
    state, numbers = np.concatenate(states), np.concatenate(which)
    limit = np.sin(np.radians(library.config.flight.tilt_deg + 1.0))
    length = np.linalg.norm(state[:, AXIS], axis=1, keepdims=True)
    state[:, AXIS] *= np.minimum(1.0, limit / np.maximum(length, 1e-9))
    state[:, 6:8] = np.clip(state[:, 6:8], ranges[:, 0], ranges[:, 1])
    craft = np.array([each.craft for each in parents], np.int32)[numbers]
    full = np.concatenate([state, np.zeros((len(state), SIZE - SEEN))], axis=1)
    parts = (rotations_of(full), state[:, PLACE], state[:, 6], state[:, 7], state[:, 8])
    return (craft, *(np.asarray(part, np.float32) for part in parts)), numbers


def _updated(parent: Belief, number: int, mode: Candidates, ranges) -> _Child:
    """A prediction after an echo, by one mode of it: the Gaussian and the evidence of the top of this page."""
    information, slope = np.asarray(mode.information, np.float64), np.asarray(mode.slope, np.float64)
    row, size = information[:SEEN, 9], max(information[9, 9], 1e-9)
    residual = float(mode.residual) - 0.5 * slope[9] ** 2 / size
    known = information[:SEEN, :SEEN] - np.outer(row, row) / size
    push = slope[:SEEN] - row * slope[9] / size
    seen, turned = _seen_of(mode)
    back = np.eye(SEEN)
    back[3:6, 3:6] = np.linalg.inv(turned)  # of a turn, in axis and heading
    known, push = back.T @ known @ back, back.T @ push
    prior = parent.covariance[:SEEN, :SEEN]
    apart = seen - parent.mean[:SEEN]
    apart[HEADING] = (apart[HEADING] + np.pi) % (2.0 * np.pi) - np.pi
    inner = np.eye(SEEN) + known @ prior
    pull = np.linalg.solve(inner, known @ apart + push)
    step = prior @ pull
    gain = parent.covariance[:, :SEEN] @ np.linalg.solve(inner, known)
    covariance = parent.covariance - gain @ parent.covariance[:SEEN]
    mean = parent.mean + parent.covariance[:, :SEEN] @ pull
    mean[6:8] = np.clip(mean[6:8], ranges[:, 0], ranges[:, 1])
    mean[HEADING] = (mean[HEADING] + np.pi) % (2.0 * np.pi) - np.pi
    off = step - apart
    score = residual + 0.5 * step @ pull + 0.5 * off @ known @ off - push @ off
    score += 0.5 * np.linalg.slogdet(inner)[1] + 0.5 * np.log(size)
    covariance = 0.5 * (covariance + covariance.T)
    return _Child(
        Belief(parent.craft, parent.log_weight - score, mean, covariance),
        number,
        float(mode.residual),
        float(step @ pull),
    )


def _seen_of(mode):
    """The seen numbers (9,) of one candidate and d(axis, heading)/d(turn) (3, 3), NumPy."""
    rotation = np.asarray(mode.rotation, np.float64)
    rest = [float(mode.permittivity), float(mode.conductivity), float(mode.log_gain)]
    heading = np.arctan2(rotation[1, 0], rotation[0, 0])
    seen = np.concatenate([np.asarray(mode.position, np.float64), rotation[:2, 2], [heading], rest])
    return seen, np.asarray(turning(jnp.asarray(rotation)), np.float64)


def _merged(found: Sequence[_Child]) -> list[Belief]:
    """The heaviest that differ, weights adding up to one: a mode that is found twice counts once for each prediction
    that it is found from."""
    order = sorted(found, key=lambda child: -child.belief.log_weight)
    kept: list[tuple[Belief, set[int]]] = []
    for hypothesis, parent, *_ in order:
        for row, (other, parents) in enumerate(kept):
            apart = hypothesis.mean[:6] - other.mean[:6]
            apart[5] = (apart[5] + np.pi) % (2.0 * np.pi) - np.pi
            close = np.linalg.norm(apart[:3]) < 0.05 and np.linalg.norm(apart[3:]) < 0.02
            spread = other.covariance[:6, :6] + 1e-8 * np.eye(6)
            if other.craft == hypothesis.craft and (close or apart @ np.linalg.solve(spread, apart) < 9.0):
                if parent not in parents:
                    total = float(np.logaddexp(other.log_weight, hypothesis.log_weight))
                    kept[row] = other._replace(log_weight=total), parents | {parent}
                break
        else:
            kept.append((hypothesis, {parent}))
    top = kept[0][0].log_weight
    these = [each for each, _ in kept if each.log_weight > top + np.log(_LEAST)][:_KEPT]
    these = sorted(these, key=lambda each: -each.log_weight)
    total = float(np.logaddexp.reduce([each.log_weight for each in these]))
    return [each._replace(log_weight=each.log_weight - total) for each in these]
