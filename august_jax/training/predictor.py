"""Training the network that corrects a predictor (:mod:`august_jax.tracking.predictors.lstm`) on flights made for it.

Flights of all three styles, in the configuration's box and in one five times as wide about its middle: walls that are
near turn flights back, and a network that has met nothing else expects them everywhere. Half the flights are seen
in either. Each step takes histories anew: a flight, a standard deviation of the estimates between 3 and 30 cm
(log-uniform) and their errors, Gaussian and independent, and a slot to predict. The filter runs over the estimates
from the first on, and the network's answer is compared with what it would have had to be,

    L = mean of |d - (q - q_kin) / s|,

in units of the innovation that the filter expects, so that no style outweighs the others. The mean distance,
rather than its square, leaves few turns of style `jump` from outweighing all else.

Flights of the validation are others; their errors are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Float, Int, Key

from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import Config, Style, bounds
from august_jax.models import State
from august_jax.progress import Progress, silent
from august_jax.scene.trajectory import fly_many
from august_jax.tracking.predictors.kalman import Kalman
from august_jax.tracking.predictors.lstm import WEIGHTS, WINDOW, Course, begin_course, create_motion, expect, go_on
from august_jax.training.loop import Draw, Validate, train
from august_jax.training.step import ParameterLayout, TrainState, laid_out

STYLES: tuple[Style, ...] = get_args(Style)
SLOTS = 32
"""Of a flight; the filter has settled after some ten."""
NOISE_M = (0.03, 0.3)
"""Standard deviations of the estimates along each axis."""
WIDER = 5.0
_FLIGHTS = 2048
"""Of each style in each box, to train on."""
_HELD_OUT = 8
"""One for so many is for validation."""
_VALIDATED = 3072
"""Histories."""
_SOFT = 1e-2
"""Distances count as sqrt(d^2 + _SOFT^2): a gradient at none."""


class Histories(NamedTuple):
    """What a step learns from.

    Attributes:
        windows: what the network hears (B, K, 9).
        wanted: its best answer (B, 3), in units of ``scale``.
        scale: s (B,) [m].
    """

    windows: Float[Array, "batch slots features"]
    wanted: Float[Array, "batch 3"]
    scale: Float[Array, " batch"]


@dataclass(frozen=True)
class PredictorLayout(ParameterLayout):
    """Where in a vector of parameters each of the network's arrays lies."""

    def loss(
        self, params: Float[Array, " parameters"], key: Key[Array, ""], batch: Any
    ) -> tuple[Float[jax.Array, ""], dict[str, Float[jax.Array, ""]]]:
        """The mean distance of :class:`Histories`, and beside it the filter's own, both in units of s."""
        network = nnx.merge(self.graphdef, self.arrays(params))
        distance = _distance(network(batch.windows) - batch.wanted)
        return jnp.mean(distance), {"kalman": jnp.mean(_distance(batch.wanted))}


def _distance(apart: Float[Array, "*batch 3"]) -> Float[jax.Array, "*batch"]:
    return jnp.sqrt(jnp.sum(jnp.square(apart), axis=-1) + _SOFT**2)


def begin_predictor(config: Config) -> tuple[PredictorLayout, TrainState]:
    """The network's form and the state before the first step, from ``config.train.seed``."""
    return laid_out(PredictorLayout, config.train, *create_motion(config.train.seed))


@streams.pin
def split_flights(
    config: Config,
) -> tuple[Float[np.ndarray, "styles flights slots 3"], Float[np.ndarray, "styles others slots 3"]]:
    """True positions of flights of every style [m], half of them in the configuration's box and half in a wider one:
    those to train on and those to validate on, no more than histories are drawn.

    Args:
        config: whose ``flight`` says the box, the slots' length and the largest tilt.

    Raises:
        ValueError: ``flight.box_m`` is so small that flights do not stay inside.
    """
    count = min(_FLIGHTS, config.train.steps * config.train.batch)
    held_out = max(1, count // _HELD_OUT)
    most = bounds("flight.box_m")
    box = np.array(config.flight.box_m)
    middle = box.mean(axis=1, keepdims=True)
    wide = np.clip(middle + WIDER * (box - middle), most.low, most.high)
    flown = []
    for number, style in enumerate(STYLES):
        for place, room in enumerate((box, wide)):
            x, y, z = ((float(low), float(high)) for low, high in room)
            flight = replace(config.flight, style=style, slots=SLOTS, box_m=(x, y, z))
            keys = streams.members(
                streams.key(config.train.seed, "predictor.flight", number, place), np.arange(count + held_out)
            )
            flown.append(np.asarray(fly_many(keys, flight).positions))
    positions = np.stack(flown).reshape(len(STYLES), 2, count + held_out, SLOTS, 3)
    known, others = positions[:, :, :count], positions[:, :, count:]
    return known.reshape(len(STYLES), -1, SLOTS, 3), others.reshape(len(STYLES), -1, SLOTS, 3)


class PredictorBatches:
    """Histories by step: step n always gives the same ones.

    Args:
        config: of the training.
        positions: true ones, as :func:`split_flights` gives them.
        stream: that flights, noise and slots are drawn from.
        count: of histories a step; None takes ``train.batch``.
    """

    def __init__(
        self,
        config: Config,
        positions: Float[np.ndarray, "styles flights slots 3"],
        stream: str = "predictor.history",
        count: int | None = None,
    ):
        count = config.train.batch if count is None else count
        self._filters = tuple(Kalman.for_flight(replace(config.flight, style=style)) for style in STYLES)
        self._counts = tuple(len(part) for part in np.array_split(np.arange(count), len(STYLES)))
        self._positions = jnp.asarray(positions, jnp.float32)
        self._key = streams.key(config.train.seed, stream)

    @streams.pin
    def __call__(self, step: int) -> Histories:
        """The histories of a step, an equal share of each style, in the order of ``STYLES``."""
        return _drawn(self._filters, self._counts, jax.random.fold_in(self._key, step), self._positions)


@partial(jax.jit, static_argnums=(0, 1))
def _drawn(
    filters: tuple[Kalman, ...],
    counts: tuple[int, ...],
    key: Key[Array, ""],
    positions: Float[Array, "styles flights slots 3"],
) -> Histories:
    parts = []
    for number, (kalman, count) in enumerate(zip(filters, counts)):
        which, noise, errors, when = jax.random.split(jax.random.fold_in(key, number), 4)
        true = positions[number, jax.random.randint(which, (count,), 0, positions.shape[1])]
        spread = jnp.exp(jax.random.uniform(noise, (count, 1, 1), minval=np.log(NOISE_M[0]), maxval=np.log(NOISE_M[1])))
        estimates = true + spread * jax.random.normal(errors, true.shape)
        slots = jax.random.randint(when, (count,), WINDOW, positions.shape[2])
        parts.append(jax.vmap(partial(_history, kalman))(estimates, true, slots))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _history(
    kalman: Kalman, estimates: Float[Array, "slots 3"], true: Float[Array, "slots 3"], when: Int[Array, ""]
) -> Histories:
    """What the network hears before slot ``when`` of a flight, and what it should say; a single one."""

    def slot(course: Course, estimate: Any) -> tuple[Course, Any]:
        course, expected, window, scale = expect(kalman, course)
        return go_on(kalman, course, estimate), (window, expected.position, scale)

    _, (windows, expected, scales) = jax.lax.scan(slot, begin_course(kalman, estimates[0]), estimates[1:])
    window, place, scale = (each[when - 1] for each in (windows, expected, scales))
    return Histories(window, (true[when] - place) / scale, scale)


def validator(config: Config, positions: Float[np.ndarray, "styles flights slots 3"]) -> Validate:
    """Mean errors [m] on flights of their own, by style: ``STYLE`` and, of the filter alone, ``STYLE_kalman``."""
    count = min(_VALIDATED, config.train.steps * config.train.batch)
    seen = PredictorBatches(config, positions, "predictor.validation", count)(0)
    answered = jax.jit(lambda graphdef, arrays: nnx.merge(graphdef, arrays)(seen.windows), static_argnums=0)

    def validate(graphdef: nnx.GraphDef, arrays: State, done: int) -> dict[str, float | int]:
        numbers: dict[str, float | int] = {}
        wanted, scale = np.asarray(seen.wanted), np.asarray(seen.scale)
        for name, answer in (("", np.asarray(answered(graphdef, arrays))), ("_kalman", 0.0 * wanted)):
            metres = scale * np.linalg.norm(answer - wanted, axis=-1)
            for style, part in zip(STYLES, np.array_split(metres, len(STYLES))):
                numbers[style + name] = float(np.mean(part))
        return numbers

    return validate


def train_predictor(
    config: Config,
    out_dir: str | Path,
    *,
    draw: Draw | None = None,
    weights: str | Path | None = None,
    mesh: Mesh | None = None,
    progress: Progress = silent,
) -> TrainState:
    """Train a predictor to ``config.train.steps`` and return the last state; see :func:`~august_jax.training.train`.

    The folder holds what a run of networks holds, ``predictor.npz`` in the place of ``weights.npz``:
    ``KalmanLSTM.for_flight(config.flight, out_dir)`` predicts with it.

    Args:
        config: its ``flight`` (but for style and slots), ``train.steps``, ``batch``, ``learning_rate``, ``ema``,
            ``seed``, ``log_every`` and ``save_every`` count.
        out_dir: made if missing.
        draw: of the metrics.
        weights: another predictor's, to start from.
        mesh: the devices; None takes all that JAX sees.
        progress: takes lines of progress.

    Raises:
        FileNotFoundError, ValueError, FloatingPointError: as ``train``; and of a ``flight.box_m`` that is too small.
    """
    progress(f"flying for it: flights of {SLOTS} slots of {', '.join(STYLES)}, in two boxes")
    known, others = split_flights(config)
    progress(f"{known.shape[1]} flights of each style to train on, {others.shape[1]} to validate on")
    return train(
        config,
        PredictorBatches(config, known),
        out_dir,
        validate=validator(config, others),
        draw=draw,
        weights=weights,
        begin=begin_predictor,
        weights_file=WEIGHTS,
        mesh=mesh,
        progress=progress,
    )
