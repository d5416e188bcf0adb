"""A flight followed by its hypotheses (:mod:`august_jax.inference.follow`), in a closed loop with the base station.

The first slots are listened to where a detection puts the craft, as in :mod:`august_jax.tracking.loop`, the others
where the hypotheses expect it. In each, the estimate is the posterior mean, and the cloud the surface of the most
probable hypothesis about it, one rigid craft of one material.
"""

from __future__ import annotations

import time
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex

from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.inference import Library
from august_jax.inference.follow import DETECTED_SLOTS, Follower, Step
from august_jax.progress import Progress, silent
from august_jax.scene import Scenario
from august_jax.scene.cloud import WorldCloud
from august_jax.signal.station import observe_for
from august_jax.tracking import Track

SHORTEST = DETECTED_SLOTS + 1
"""Slots of the shortest flight that can be followed: before, a detection says where to listen."""
SHOWN = 5
"""Clouds of at most so many hypotheses are made of a slot."""
_WORTH_SHOWING = 1e-3


class Flown(NamedTuple):
    """A flight that was followed.

    Attributes:
        track: what was true and what was found, the cloud being that of the most probable hypothesis.
        steps: what was known after each slot.
        clouds: surfaces of the most probable hypotheses of each slot, in their order.
        names: of the known craft (C).
        craft: which of them flies; None where it is none of them.
    """

    track: Track
    steps: tuple[Step, ...]
    clouds: tuple[tuple[WorldCloud, ...], ...]
    names: tuple[str, ...]
    craft: int | None


def check_slots(slots: int) -> None:
    """Refuse a flight that is too short.

    Raises:
        ValueError: fewer than SHORTEST slots.
    """
    if slots < SHORTEST:
        raise ValueError(
            f"slots: {slots} is too short a flight to follow; a detection says where to listen in the first "
            f"{DETECTED_SLOTS}, so give {SHORTEST} or more"
        )


@streams.pin
def follow_flight(
    library: Library,
    config: Config,
    scenario: Scenario,
    channels: Complex[Array, "slots tones antennas antennas"],
    *,
    seed: int,
    snr_db: float,
    progress: Progress = silent,
) -> Flown:
    """Follow a flight through its true channels.

    Args:
        library: of known craft; the one that flies need not be among them.
        config: of station, regions and flights.
        scenario: what flies.
        channels: H in each of its slots (T, F, N_b, N_b).
        seed: of detections, pilots, noise, points, and of what the search draws.
        snr_db: to which the power is set in each slot [dB].
        progress: told of every slot, with the time that is left.

    Raises:
        ValueError: a flight of fewer than SHORTEST slots.
    """
    slots = scenario.slots
    check_slots(slots)
    craft = next((row for row, each in enumerate(library.airframes) if each.digest == scenario.airframe.digest), None)
    follower = Follower(library, config, seed=seed, progress=progress)
    half = config.region.threshold_m
    detected = scenario.positions + np.asarray(
        jax.random.uniform(streams.key(seed, "follow.detection"), scenario.positions.shape, minval=-half, maxval=half)
    )
    steps: list[Step] = []
    snrs = []
    began = time.monotonic()
    for slot in range(slots):
        place = follower.place(detected[slot])
        key = streams.key(seed, "follow.echo", slot)
        statistics, snr = _observed(config, key, jnp.asarray(channels[slot]), jnp.asarray(place), snr_db)
        steps.append(follower.hear(statistics))
        snrs.append(float(snr))
        progress(
            f"slot {slot + 1} of {slots}: {_told(steps[-1], library)}{_left(steps, slots, time.monotonic() - began)}"
        )
    points = config.target.points
    clouds = tuple(
        _clouds(streams.key(seed, "sense.resampling", slot), step, library, points) for slot, step in enumerate(steps)
    )
    first = [each[0] for each in clouds]
    track = Track(
        time_s=np.asarray(scenario.time_s),
        position=scenario.positions,
        rotation=scenario.rotations,
        permittivity=scenario.permittivity,
        conductivity=scenario.conductivity,
        truth=scenario.surface(streams.key(seed, "sense.label"), points),
        resampled=scenario.surface(streams.key(seed, "sense.resampling"), points),
        predicted=np.stack([step.predicted for step in steps]),
        snr_db=np.array(snrs),
        points=np.stack([np.asarray(each.points, float) for each in first]),
        point_permittivity=np.stack([np.asarray(each.permittivity, float) for each in first]),
        point_conductivity=np.stack([np.asarray(each.conductivity, float) for each in first]),
        normal_estimate=np.stack([step.mean_normal for step in steps]),
        detected=np.array([step.detected for step in steps]),
        lost=np.array([step.lost for step in steps]),
    )
    return Flown(track, tuple(steps), clouds, library.names, craft)


@partial(jax.jit, static_argnums=0)
def _observed(config, key, channel, place, snr_db):
    seen = observe_for(config, key, channel, place, snr_db=snr_db)
    return seen.statistics, seen.snr_db


def _clouds(key: jax.Array, step: Step, library: Library, points: int) -> tuple[WorldCloud, ...]:
    """Surfaces of the most probable hypotheses, the first about the mean position of all."""
    shown = max(int(np.sum(step.weight[:SHOWN] >= _WORTH_SHOWING)), 1)
    found = []
    for row in range(shown):
        body = np.asarray(library.airframes[int(step.craft[row])].sample_surface(key, points), np.float64)
        body -= body.mean(axis=0)  # the cloud's mean is the estimate, to the digit
        place = step.position[row] if row else step.mean_position
        material = [np.full(points, each[row], np.float32) for each in (step.permittivity, step.conductivity)]
        found.append(WorldCloud(body @ step.rotation[row].T + place, *material))
    return tuple(found)


def _told(step: Step, library: Library) -> str:
    if step.lost:
        return "lost: no known craft explains the echo"
    craft = int(np.argmax(step.craft_probability))
    return (
        f"{library.names[craft]} ({100.0 * step.craft_probability[craft]:.0f} %), "
        f"to about {100.0 * step.expected_error_m:.1f} cm"
    )


def _left(steps: list[Step], slots: int, spent: float) -> str:
    """The time left, of the slots that compiled nothing; silent for the first ones."""
    if len(steps) <= DETECTED_SLOTS or len(steps) == slots:
        return ""
    each = float(np.median([step.seconds for step in steps[DETECTED_SLOTS:]]))
    return f", about {max(each * (slots - len(steps)), 1.0):.0f} s left"
