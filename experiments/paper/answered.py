"""Schemes asked about slots of a figure's own, where an evaluation at its SNRs does not serve; rows become columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from campaign import SEED, Numbers, Rows

from august_jax import streams
from august_jax.config import Config
from august_jax.data import Batch, Sample, Target
from august_jax.evaluation.evaluate import truth_of as true_of
from august_jax.evaluation.score import score
from august_jax.inference import Library
from august_jax.models import Networks
from august_jax.progress import Progress, silent
from august_jax.schemes import SCHEMES, Answer, Setting, Slots, Truth

EXPECTED = ("expected_mpe_m", "own_bound_m", "expected_mde", "own_bound_mde")
"""What a search says of its error, and the bound on the same slots."""
_TOGETHER = 50


class Asked(NamedTuple):
    """Who answers.

    Attributes:
        line: name in rows.
        scheme: of :data:`august_jax.schemes.SCHEMES`.
        config: that it works under.
        networks: None where it has none.
        library: to search; None where nobody searches.
        known: craft that it knows of.
    """

    line: str
    scheme: str
    config: Config
    networks: Networks | None = None
    library: Library | None = None
    known: Sequence[Target] = ()


@streams.pin
def answered(who: Asked, slots: Slots, progress: Progress = silent) -> Answer:
    """The answer to all slots; a slow scheme is told of slot by slot."""
    scheme = SCHEMES[who.scheme]
    key = streams.named(streams.key(SEED, "evaluate.answer"), who.scheme)
    crafts = [target.airframe for target in who.known]
    ask = scheme.prepare(Setting(who.config, who.networks, crafts, key, who.library))
    assert ask is not None  # it has what it needs
    together = 1 if scheme.slow else _TOGETHER
    parts = []
    for start in range(0, slots.slots, together):
        rows = slice(start, min(start + together, slots.slots))
        parts.append(jax.tree.map(np.asarray, ask(jax.random.fold_in(key, start), slots.at(rows))))
        if scheme.slow:
            progress(f"{who.line}: slot {start + 1} of {slots.slots}")
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def row(who: Asked, slots: Slots, size_m: float, progress: Progress = silent) -> dict[str, Any]:
    """How well somebody answers slots: ``line``, ``count`` and the metrics of :func:`august_jax.evaluation.score`."""
    assert slots.truth is not None
    return {"line": who.line, "count": slots.slots, **score(answered(who, slots, progress), slots.truth, size_m)}


def truth_of(samples: Sample, targets: Sequence[Target]) -> Truth:
    """What was true of slots in which these craft fly, as an evaluation has it."""
    airframes = [target.airframe for target in targets]
    return true_of(streams.key(SEED, "evaluate.resampling"), samples, airframes)


def slots_of(batch: Batch, truth: Truth) -> Slots:
    """What was heard of slots, with what was true."""
    return Slots(batch.predicted, batch.snr_db, batch.heard, truth, batch.statistics)


def table(rows: Rows) -> Numbers:
    """Columns of rows; NaN where a row lacks a number or does not define it."""
    names = dict.fromkeys(name for each in rows for name in each)
    return {name: np.array([np.nan if each.get(name) is None else each[name] for each in rows]) for name in names}
