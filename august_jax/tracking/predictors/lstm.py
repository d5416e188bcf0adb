"""Kalman and LSTM: what a network has learned from flights corrects what the filter expects (paper, Section III),

    q_pre = q_kin + dq_LSTM.

q_kin is the Kalman filter's. The network hears the last K = 8 slots, nine numbers each:

    (z - q_kin of that slot, v t, a t^2) / s,

the innovation of the slot's estimate z, velocity v and acceleration a of the filter after it, times the length t of a
slot, so that all nine are metres and of one size; s is the standard deviation that the filter expects of its next
innovation, and dq_LSTM is the network's answer times s. The paper's positions are raw. Here they count from where the
filter expected them: the answer does not depend on where the world's origin is; small surprises are not lost beside
large coordinates; and a network cannot learn the walls of the box that it was trained in by heart. Within one box that
would pay, some 4 % on agile flights, and mislead in any other.

The cell (sigma is the logistic function, * elementwise):

    (i, f, g, o) = A (x, h) + b,   c' = sigma(f + 1) * c + sigma(i) * tanh(g),   h' = sigma(o) * tanh(c'),

over the window from c = h = 0, and dq_LSTM / s is linear in the last h. Until there are K estimates nothing is
corrected. The innovation covariance stays the filter's; how much smaller innovations are is measured (``spread``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from math import isclose
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float, Int

from august_jax import config as configuration
from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import FlightConfig
from august_jax.models.august import State
from august_jax.models.layers import dense
from august_jax.models.weights import compare, flatten, read_weights
from august_jax.tracking.predictors.kalman import Kalman, Motion
from august_jax.tracking.predictors.protocol import Prediction

WINDOW = 8
"""K, the slots that the network hears."""
FEATURES = 9
UNITS = 64
SHIPPED = Path(__file__).parents[2] / "weights" / "predictor"
"""Weights that come with the package."""
WEIGHTS = "predictor.npz"
"""Beside ``config.yaml`` in a folder of weights."""
_SPREAD = {"smooth": 0.87, "dynamic": 0.44, "jump": 3.7}
"""Of the shipped weights by style, of estimates that err by 10 cm along an axis: experiments/prediction.py, mean of its
boxes."""


class MotionLSTM(nnx.Module):
    """The network; one that was not trained answers zero."""

    def __init__(self, *, rngs: nnx.Rngs):
        self.gates = dense(FEATURES + UNITS, 4 * UNITS, rngs=rngs)
        self.answer = dense(UNITS, 3, gain=0.0, rngs=rngs)

    def __call__(self, window: Float[Array, "*batch slots features"]) -> Float[jax.Array, "*batch 3"]:
        """The correction in units of s, from the slots of a window, oldest first."""

        def slot(memory: tuple[jax.Array, jax.Array], heard: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
            cell, output = memory
            enter, keep, new, leave = jnp.split(self.gates(jnp.concatenate([heard, output], axis=-1)), 4, axis=-1)
            cell = jax.nn.sigmoid(keep + 1.0) * cell + jax.nn.sigmoid(enter) * jnp.tanh(new)
            return (cell, jax.nn.sigmoid(leave) * jnp.tanh(cell)), None

        slots = jnp.moveaxis(jnp.asarray(window), -2, 0)
        nothing = jnp.zeros((*slots.shape[1:-1], UNITS), slots.dtype)
        (_, output), _ = jax.lax.scan(slot, (nothing, nothing), slots)
        return self.answer(output)


def create_motion(seed: int) -> tuple[nnx.GraphDef, State]:
    """A network that was not trained, as (graphdef, state)."""
    return nnx.split(MotionLSTM(rngs=nnx.Rngs(streams.key(seed, "train.parameters"))))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Corrector:
    """A network with its parameters: a pytree, and hashed by identity where it stands for itself.

    Attributes:
        graphdef, state: as :func:`create_motion` gives them.
    """

    graphdef: nnx.GraphDef = field(metadata={"static": True})
    state: State

    @classmethod
    def read(cls, run: str | Path) -> Corrector:
        """The network of a folder that was trained into.

        Raises:
            ValueError: there is none, it is damaged, holds numbers that are not finite, or is no predictor's.
        """
        path = Path(run) / WEIGHTS
        if not path.is_file():
            raise ValueError(
                f"run: {path} is not there; give what august train wrote with target=predictor, or leave it out for "
                "the shipped weights"
            )
        arrays = read_weights(path)
        graphdef, state = create_motion(0)
        wanted = flatten(state)
        try:
            compare({name: leaf.shape for name, leaf in arrays.items()}, wanted, path)
        except ValueError as error:
            raise ValueError(f"run: {path} holds no predictor of {UNITS} units in {WINDOW} slots ({error})") from None
        leaves = [jnp.asarray(arrays[name]) for name in wanted]
        return cls(graphdef, jax.tree.unflatten(jax.tree.structure(state), leaves))


class Course(NamedTuple):
    """What is known of a flight.

    Attributes:
        motion: the filter's belief.
        window: innovation [m], velocity [m/s] and acceleration [m/s^2] after each of the last K estimates, as rows
            (K, 3, 3), oldest first; zeros where there were none.
        count: estimates so far ().
    """

    motion: Motion
    window: Float[Array, "slots 3 3"]
    count: Int[Array, ""]


def begin_course(kalman: Kalman, position: Float[Array, "3"]) -> Course:
    """After the first estimate (3,) [m]."""
    motion = kalman.start(position)
    return Course(motion, jnp.zeros((WINDOW, 3, 3), motion.mean.dtype), jnp.asarray(1, jnp.int32))


def expect(
    kalman: Kalman, course: Course
) -> tuple[Course, Prediction, Float[jax.Array, "slots features"], Float[jax.Array, ""]]:
    """One slot later: the course, what the filter expects, what the network hears (K, 9), and s () [m]."""
    motion, expected = kalman.predict(course.motion)
    scale = jnp.sqrt(jnp.trace(expected.covariance) / 3.0)
    units = jnp.array([1.0, kalman.slot_s, kalman.slot_s**2], scale.dtype)
    heard = (course.window * units[:, None] / scale).reshape(-1, FEATURES)
    return course._replace(motion=motion), expected, heard, scale


def go_on(kalman: Kalman, course: Course, position: Float[Array, "3"]) -> Course:
    """After the estimate (3,) [m] of the slot that was expected."""
    motion = kalman.update(course.motion, position)
    row = motion.mean.at[0].set(position - course.motion.mean[0])
    return Course(motion, jnp.concatenate([course.window[1:], row[None]]), course.count + 1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KalmanLSTM:
    """The filter and its correction. Hashable, equal where the filters are and the network is the same; and a pytree
    whose leaves are the network's parameters.

    Attributes:
        kalman: the filter.
        corrector: the network.
        spread: see :class:`Predictor`.
    """

    kalman: Kalman = field(metadata={"static": True})
    corrector: Corrector
    spread: float = field(default=1.0, metadata={"static": True})

    @classmethod
    def for_flight(cls, flight: FlightConfig, run: str | Path | None = None) -> KalmanLSTM:
        """With the filter that :class:`Kalman` takes for such flights.

        Args:
            flight: ``slot_s`` must be that of the training.
            run: a folder that was trained into; None takes the shipped weights, which have seen all styles.

        Raises:
            ValueError: no weights, damaged ones, or of another ``flight.slot_s``.
        """
        trained, corrector = _shipped() if run is None else _read(Path(run))
        if not isclose(trained, flight.slot_s, rel_tol=1e-6):
            raise ValueError(
                f"flight.slot_s: {flight.slot_s:g} s, but the predictor was trained with slots of {trained:g} s; keep "
                "these, choose another predictor, or train one: august train with target=predictor"
            )
        return cls(Kalman.for_flight(flight), corrector, _SPREAD[flight.style])

    def start(self, position: Float[Array, "3"]) -> Course:
        """See :class:`Predictor`."""
        return begin_course(self.kalman, position)

    def predict(self, state: Course) -> tuple[Course, Prediction]:
        """See :class:`Predictor`."""
        state, expected, window, scale = expect(self.kalman, state)
        answer = nnx.merge(self.corrector.graphdef, self.corrector.state)(window)
        correction = jnp.where(state.count < WINDOW, 0.0, scale * answer).astype(expected.position.dtype)
        return state, Prediction(expected.position + correction, expected.covariance)

    def update(self, state: Course, position: Float[Array, "3"]) -> Course:
        """See :class:`Predictor`."""
        return go_on(self.kalman, state, position)


@cache
def _shipped() -> tuple[float, Corrector]:
    return _read(SHIPPED)


def _read(run: Path) -> tuple[float, Corrector]:
    """Slots of the training [s], and the network."""
    corrector = Corrector.read(run)  # tells first what is missing
    return configuration.read(run / "config.yaml").flight.slot_s, corrector
