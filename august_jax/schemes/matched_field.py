"""A search through the simulator: the echo is compared with what every known craft would send back.

The posterior over craft, pose and material (:mod:`august_jax.inference`) answers. Its mean is the position, the mean of
its thrust axes the normal; the cloud is the surface of its most probable hypothesis, one rigid craft of one material.

Where even the best hypothesis leaves more of the echo than noise would, what flies is not one of the known craft, and
where the echo is no louder than noise, none is there: the answer says so, and the networks, if there are any, give
position, normal and cloud in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from august_jax import streams
from august_jax.config import Config
from august_jax.inference import Library, Posterior, Prior, find_craft
from august_jax.inference.hypotheses import evenly_drawn
from august_jax.progress import Progress, silent
from august_jax.scene.cloud import WorldCloud
from august_jax.scene.pose import transform
from august_jax.schemes.answer import Answer, Ask, Scheme, Setting, Slots
from august_jax.schemes.networks import AUGUST
from august_jax.signal.station import Statistics
from august_jax.tracking import Track

SAMPLES = 2000
"""Positions by which an answer says how sure it is."""
UNKNOWN = -1
"""The craft of an answer where none of the known ones explains the echo."""
_WORTH_SHOWING = 1e-3


def _prepare(setting: Setting) -> Ask | None:
    library, points = setting.library, setting.config.target.points
    if library is None:
        return None
    prior, networks = Prior.from_config(setting.config), AUGUST.prepare(setting)

    def one(key: jax.Array, slot: Slots) -> Answer:
        """The answer to a single slot, arrays with a leading 1."""
        search_key, said_key, network_key = jax.random.split(key, 3)
        posterior = find_craft(library, jax.tree.map(lambda leaf: leaf[0], slot.statistics), prior, key=search_key)
        found = said(said_key, posterior, library, points)
        return found if posterior.found or networks is None else _left_to(networks(network_key, slot), found)

    def ask(key: jax.Array, slots: Slots) -> Answer:
        if slots.statistics is None:
            raise ValueError(
                "slots: statistics are None; the scheme 'matched_field' compares them with the known craft, give what "
                "observed_anew(..., statistics=True) says"
            )
        answers = [
            one(jax.random.fold_in(key, row), slots.at(slice(row, row + 1))) for row in range(slots.slots)
        ]  # slot after slot: how much is searched depends on what is heard
        return jax.tree.map(lambda *parts: np.concatenate([np.asarray(part) for part in parts]), *answers)

    return ask


def said(key: jax.Array, posterior: Posterior, library: Library, points: int) -> Answer:
    """What a posterior says of its slot: an answer of one slot, NumPy arrays with a leading 1.

    Args:
        key: of the cloud's points and of the samples.
        posterior: of :func:`august_jax.inference.find_craft`.
        library: what was searched.
        points: of the cloud.
    """
    cloud_key, sample_key = jax.random.split(key)
    chosen = evenly_drawn(posterior.weights, SAMPLES, float(jax.random.uniform(sample_key)))
    error_m, normal_error = expected_errors(posterior)
    answer = Answer(
        position=posterior.mean_position,
        normal=posterior.mean_normal,
        cloud=hypothesis_cloud(cloud_key, posterior, library, 0, points),
        samples=posterior.position[chosen],
        expected_error_m=np.asarray(error_m),
        expected_normal_error=np.asarray(normal_error),
        craft=np.asarray(np.argmax(posterior.craft_probability) if posterior.found else UNKNOWN, np.int32),
        craft_probability=posterior.craft_probability,
        explained=np.asarray(posterior.found),
        seconds=np.asarray(sum(posterior.seconds.values())),
    )

    def row(leaf: np.ndarray) -> np.ndarray:
        leaf = np.asarray(leaf)[None]
        return leaf.astype(np.float32) if leaf.dtype.kind == "f" else leaf

    return jax.tree.map(row, answer)


def expected_errors(posterior: Posterior) -> tuple[float, float]:
    """By how much a posterior expects its own means to err: E|q - q_mean| [m] and E(1 - n.n_mean) = 1 - |E n|.

    Over slots that are drawn from what the posterior assumes, the mean of each is the mean error itself (MPE, MDE).
    """
    weights = np.asarray(posterior.weights, np.float64)
    apart = np.linalg.norm(posterior.position - posterior.mean_position, axis=1)
    aside = 1.0 - posterior.rotation[:, :, 2] @ posterior.mean_normal
    return float(weights @ apart), float(np.maximum(weights @ aside, 0.0))


def hypothesis_cloud(key: jax.Array, posterior: Posterior, library: Library, number: int, points: int) -> WorldCloud:
    """The surface of one hypothesis, the first being the most probable: M points (M, 3) [m] of one material."""
    these = posterior.hypotheses
    airframe = library.airframes[int(these.craft[number])]
    surface = np.asarray(airframe.sample_surface(key, points))
    return WorldCloud(
        np.asarray(transform(surface, these.rotation[number], these.position[number])),
        np.full(points, these.permittivity[number], np.float32),
        np.full(points, these.conductivity[number], np.float32),
    )


def _left_to(networks: Answer, found: Answer) -> Answer:
    """The networks' answer in the place of what a search found, where that explains nothing."""
    assert found.samples is not None
    assert found.expected_error_m is not None and found.expected_normal_error is not None
    return found._replace(
        position=networks.position,
        normal=networks.normal,
        cloud=networks.cloud,
        # networks do not say how sure they are
        samples=np.full_like(found.samples, np.nan),
        expected_error_m=np.full_like(found.expected_error_m, np.nan),
        expected_normal_error=np.full_like(found.expected_normal_error, np.nan),
    )


class Found(NamedTuple):
    """What a search finds in one slot of a track.

    Attributes:
        slot: its number.
        posterior: what the echo says.
        answer: of the scheme, arrays with a leading 1.
        clouds: surfaces of the most probable hypotheses, in their order.
    """

    slot: int
    posterior: Posterior
    answer: Answer
    clouds: tuple[WorldCloud, ...]


class Search(NamedTuple):
    """A search of slots of a track.

    Attributes:
        names: of the known craft (C).
        craft: which of them flies; None where it is none of them.
        found: in the slots that were searched, in their order.
    """

    names: tuple[str, ...]
    craft: int | None
    found: tuple[Found, ...]


def search_track(
    track: Track,
    library: Library,
    config: Config,
    *,
    seed: int,
    slots: Sequence[int],
    craft: int | None = None,
    hypotheses: int = 5,
    progress: Progress = silent,
) -> Search:
    """Search slots of a track among known craft, each by its echo alone, about its predicted position.

    Args:
        track: with what its echoes say; where nothing known explains an echo, its reconstruction is the answer.
        library: of known craft.
        config: that the track was sensed with.
        seed: of the posteriors' samples.
        slots: which of them.
        craft: which of the library's flies, where that is known; kept with what is found.
        hypotheses: clouds of at most so many are made, and of the first and those above a probability of 0.001 alone.
        progress: told of every slot.

    Raises:
        ValueError: a track that did not keep what its echoes say.
    """
    if track.received is None or track.pilots is None:
        raise ValueError("track: it does not hold what its echoes say (received, pilots); sense it again")
    prior, points, found = Prior.from_config(config), track.points.shape[1], []
    for done, slot in enumerate(slots):
        keys = jax.random.split(streams.key(seed, "inference.samples", slot), 3)
        statistics = Statistics(track.received[slot], track.pilots[slot], track.predicted[slot].astype(np.float32))
        progress(f"searching slot {slot + 1} ({done + 1} of {len(slots)}){', which is compiled first' * (done == 0)}")
        posterior = find_craft(library, statistics, prior, key=keys[0])
        answer = said(keys[1], posterior, library, points)
        if not posterior.found:
            cloud = WorldCloud(track.points[slot], track.point_permittivity[slot], track.point_conductivity[slot])
            own = Answer(position=track.estimated_position[slot], normal=track.normal_estimate[slot], cloud=cloud)
            answer = _left_to(jax.tree.map(lambda leaf: leaf[None], own), answer)
        shown = range(max(int(np.sum(posterior.hypotheses.weight[:hypotheses] >= _WORTH_SHOWING)), 1))
        clouds = tuple(hypothesis_cloud(keys[2], posterior, library, number, points) for number in shown)
        found.append(Found(slot, posterior, answer, clouds))
    return Search(library.names, craft, tuple(found))


MATCHED_FIELD = Scheme("matched_field", "a search through the simulator", _prepare, hears=True, slow=True)
