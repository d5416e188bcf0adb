"""Every random stream of the project, named once.

A stream is a family of keys: of a root seed, a name, and numbers such as a flight's or a row's. Its first link is
``fold_in`` of a number that belongs to the name alone and is far above any that a ``split`` or another ``fold_in`` of
the root could give: JAX derives the i-th child of a split exactly as it folds in i, so that keys made one way and the
other are not apart by themselves. Below that link, a key is either split or folded into, never both.

Samples depend on the seed alone, whatever JAX is set to: keys are threefry's, and :func:`pinned` holds what else would
change the numbers (double precision, the way threefry counts) for as long as samples are made.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

from august_jax.arrays import Array

NAMES = (
    "data.flight",  # by flight: track, and its further draws where one leaves the box
    "data.material",  # by flight
    "data.points",  # by row: the label
    "data.observation",  # by row: prediction, level, pilots and noise of a sample as it is stored
    "train.parameters",  # what the networks start from
    "train.order",  # by epoch: the order of the rows
    "train.observation",  # by step: predictions, levels, pilots and noise drawn anew
    "train.step",  # by step: noise of the diffusion, latent samples, subsets of points
    "train.validation",
    "evaluate.flight",  # as the data's, of an evaluation's own samples
    "evaluate.material",
    "evaluate.points",
    "evaluate.observation",
    "evaluate.resampling",  # the true clouds a second time
    "evaluate.answer",  # by scheme and piece: what a scheme draws
    "scenario.flight",
    "scenario.airframe",
    "scenario.material",
    "sense.detection",  # the predictions of the first slots
    "sense.slot",  # by slot: pilots, noise, sampler, attitude
    "sense.label",
    "sense.resampling",
    "sense.answer",  # what the baselines of a track draw
    "stream.flight",  # by step: a track of each sample of a streamed batch
    "stream.sample",  # by step: slot, material, label, prediction, level, pilots and noise of each
    "validation.flight",  # as the data's, of the samples that a streamed training is validated on
    "validation.material",
    "validation.points",
    "validation.observation",
    "inference.tilt",  # by flight: those that the prior of the attitude is counted from
    "inference.samples",  # by slot: what a posterior is drawn with
    "inference.motion",  # by flight: those that a tracker learns the motion from
    "follow.detection",  # where a detection puts a craft that is followed, by slot
    "follow.echo",  # by slot: pilots and noise
    "follow.search",  # by slot: what a tracker draws
    "predictor.flight",  # by style, box and flight: those that a predictor learns from
    "predictor.history",  # by step: which of them, at what noise
    "predictor.validation",  # what it is validated on
)
"""The streams. New ones go to the end: a stream's numbers depend on its place here."""
_FIRST = 1 << 24
_IMPLEMENTATION = "threefry2x32"

P = ParamSpec("P")
R = TypeVar("R")


def key(seed: int, name: str, *numbers: int | Array) -> jax.Array:
    """The key () of a stream, or of its member that the ``numbers`` name.

    Args:
        seed: from 0 to 2^32 - 1; beyond, JAX repeats.
        name: one of :data:`NAMES`.
        numbers: folded in, one after the other.

    Raises:
        ValueError: an unknown name or a seed out of range.
    """
    if name not in NAMES:
        raise ValueError(f"name: no stream is called {name!r}; choose one of {', '.join(NAMES)}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed: got {seed}; give a whole number from 0 to 2^32 - 1")
    found = jax.random.fold_in(jax.random.key(seed, impl=_IMPLEMENTATION), _FIRST + NAMES.index(name))
    for number in numbers:
        found = jax.random.fold_in(found, number)
    return found


def named(parent: jax.Array, name: str) -> jax.Array:
    """The member () of a stream that belongs to a name of any kind, whatever other names there are."""
    return jax.random.fold_in(parent, zlib.crc32(name.encode()))


def members(parent: jax.Array, numbers: Array) -> jax.Array:
    """Keys (n,) of a stream's members by their numbers (n,)."""
    return jax.vmap(jax.random.fold_in, (None, 0))(parent, numbers)


@contextmanager
def pinned() -> Iterator[None]:
    """What JAX is set to while samples are made: the same numbers come out under any setting of the user's."""
    with ExitStack() as settings:
        for setting in (
            jax.enable_x64(False),
            jax.threefry_partitionable(True),
            jax.default_prng_impl(_IMPLEMENTATION),
        ):
            settings.enter_context(setting)
        yield


def pin(function: Callable[P, R]) -> Callable[P, R]:
    """``function`` under :func:`pinned`."""

    @wraps(function)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with pinned():
            return function(*args, **kwargs)

    return inside
