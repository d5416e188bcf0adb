"""What a scheme is asked and what it answers.

A scheme is prepared once for a :class:`Setting` and then answers slots: from what is heard of them, or without. One is
added by one file that makes a :class:`Scheme` and one line in the registry (:mod:`august_jax.schemes`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
from jaxtyping import Bool, Float, Int

from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.inference import Library
from august_jax.models import Networks
from august_jax.scene.airframes import Airframe
from august_jax.scene.cloud import WorldCloud
from august_jax.signal.roi import Coefficients
from august_jax.signal.station import Statistics


class Truth(NamedTuple):
    """What was true in B slots. Lengths count from any one origin a slot, the same for all that is compared.

    Attributes:
        position: surface centroids (B, 3) [m].
        normal: unit normals of the rotor plane (B, 3).
        cloud: points of the true surface (B, M, 3) [m].
        resampled: the surface sampled a second time (B, M, 3) [m].
        craft: which of the known craft it is (B,); None where it need not be one of them.
    """

    position: Float[Array, "batch 3"]
    normal: Float[Array, "batch 3"]
    cloud: Float[Array, "batch points 3"]
    resampled: Float[Array, "batch points 3"]
    craft: Int[Array, " batch"] | None = None


class Slots(NamedTuple):
    """What a scheme is asked about, B slots at a time.

    Attributes:
        predicted: q_pre (B, 3) [m].
        snr_db: the SNR as the receiver estimates it (B,) [dB].
        heard: estimated channels or coefficients; None where only schemes without ears are asked.
        truth: what they are measured against; only ``resampling``, the floor, answers from it. None where nothing is
            measured.
        statistics: all that the echoes say, for who compares them with what craft would send back; None where only
            schemes are asked that do not.
    """

    predicted: Float[Array, "batch 3"]
    snr_db: Float[Array, " batch"] | None
    heard: Array | Coefficients | None
    truth: Truth | None
    statistics: Statistics | None = None

    @property
    def slots(self) -> int:
        """Number of slots B."""
        return len(self.predicted)

    def at(self, rows: Any) -> Slots:
        """The slots at ``rows``: whatever indexes an array's first axis and keeps it."""
        return jax.tree.map(lambda value: value[rows], self)


class Answer(NamedTuple):
    """What a scheme says of B slots; None where it has no opinion, and no metric is worked out there.

    Attributes:
        position: (B, 3) [m].
        normal: upward unit normals of the rotor plane (B, 3).
        triple_normal: the same by the paper's method, the mean of random triples (B, 3).
        cloud: points (B, M, 3) [m] and their materials (B, M).
        centre: where a cloud lies that comes without a position of its own (B, 3) [m].
        samples: positions that are equally probable by what is known (B, n, 3) [m]; NaN in slots of which none is said.
        expected_error_m: mean distance of ``position`` from where the craft may be, by what the answer itself knows
            (B,) [m]; NaN in slots of which none is said.
        expected_normal_error: mean of 1 - cos between ``normal`` and what it may be (B,), likewise.
        craft: which of the known craft (B,), -1 where it is none of them.
        craft_probability: of each known craft, if it is one of them (B, C).
        explained: whether there is an echo, and a known craft leaves no more of it than noise would (B,).
        seconds: that the answer took (B,) [s].
    """

    position: Float[Array, "batch 3"] | None = None
    normal: Float[Array, "batch 3"] | None = None
    triple_normal: Float[Array, "batch 3"] | None = None
    cloud: WorldCloud | None = None
    centre: Float[Array, "batch 3"] | None = None
    samples: Float[Array, "batch samples 3"] | None = None
    expected_error_m: Float[Array, " batch"] | None = None
    expected_normal_error: Float[Array, " batch"] | None = None
    craft: Int[Array, " batch"] | None = None
    craft_probability: Float[Array, "batch crafts"] | None = None
    explained: Bool[Array, " batch"] | None = None
    seconds: Float[Array, " batch"] | None = None


class Setting(NamedTuple):
    """What a scheme may prepare from.

    Attributes:
        config: of the networks, possibly with another sampler.
        networks: trained; None where only schemes without networks are asked.
        airframes: those that the configuration knows; None where they cannot be had.
        key: of what is drawn once.
        library: of known craft, to search among; None where there is none.
    """

    config: Config
    networks: Networks | None
    airframes: Sequence[Airframe] | None
    key: jax.Array
    library: Library | None = None


Ask = Callable[[jax.Array, Slots], Answer]
"""(key, slots) -> answer, for up to some fifty slots at a time. Nobody compiles it from outside, so that NumPy serves
as well; one that networks or physics make slow compiles itself."""


@dataclass(frozen=True)
class Scheme:
    """A way to answer slots.

    Attributes:
        name: in the registry, in rows and in files.
        label: what it is, in a few words, for people.
        prepare: a setting -> what answers; None where the setting lacks what the scheme needs.
        hears: its answer depends on what is heard; where not, one answer serves all SNRs, and it may be asked in
            silence (``heard`` None).
        slow: it takes seconds a slot, so that an evaluation asks it about ``evaluate.searched`` slots and no more.
        follows: its answer has a position that it knows without the truth, so that a flight can be followed by it.
    """

    name: str
    label: str
    prepare: Callable[[Setting], Ask | None]
    hears: bool
    slow: bool = False
    follows: bool = True
