"""Why a run stops: numbers that are not finite, told with the step and with what it learned from, which is kept.

A batch is a function of its step alone, so that the one in question is made again when the numbers are looked at, some
steps later; until then it costs nothing. It is kept beside the run as ``not-finite-step-N.npz``, one array a field,
a row a sample.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from august_jax.arrays import ArrayLike, rows_not_finite
from august_jax.files import replacing
from august_jax.models.weights import flatten


def not_finite(numbers: Mapping[str, ArrayLike]) -> list[str]:
    """Names of the numbers that are NaN or infinite."""
    return [name for name, value in numbers.items() if not np.all(np.isfinite(value))]


def keep_batch(path: Path, batch: Any) -> list[str]:
    """Write a batch as .npz, one array a field, and say what in it is not finite.

    Args:
        path: of the file, which appears whole or not at all.
        batch: a pytree of named arrays, each with a row a sample.

    Returns:
        A phrase a field that holds NaN or infinity: how many, in how many rows, and the first of these.

    Raises:
        OSError: it cannot be written.
    """
    fields = {name: np.asarray(leaf) for name, leaf in flatten(batch).items()}
    with replacing(path) as aside:
        np.savez(aside, **fields)  # type: ignore[arg-type]
    told = []
    for name in not_finite(fields):
        wrong, rows = ~np.isfinite(fields[name]), rows_not_finite(fields[name])
        told.append(f"{name} {wrong.sum()} in {len(rows)} of {len(np.atleast_1d(wrong))} rows, first in row {rows[0]}")
    return told


def stopped(
    step: int, terms: Sequence[str], make: Callable[[], Any], out: Path, checkpoint: int | None
) -> FloatingPointError:
    """What to raise of a step whose ``terms`` are not finite; its batch is kept in ``out``.

    Args:
        step: 1 at first.
        terms: names of what is not finite.
        make: makes the step's batch.
        out: the run's folder.
        checkpoint: the step that the run would go on from; None where it would begin anew.
    """
    path = out / f"not-finite-step-{step}.npz"
    on_from = "the start" if checkpoint is None else f"step {checkpoint}"
    try:
        told = keep_batch(path, make())
    except OSError as error:
        return FloatingPointError(
            f"training: step {step} gave values that are not finite in {', '.join(terms)}, and its batch cannot be "
            f"kept in {path} ({error.strerror or error}); make room there and train again, which goes on from {on_from}"
        )
    if told:
        why = f"so does its batch: of {'; of '.join(told)}"
        way_out = f"correct what it was made of and train again, which goes on from {on_from}"
    else:
        why = "all of its batch is finite: what was trained diverged"
        way_out = (
            "train in another folder with a lower train.learning_rate, from these weights or anew; this one would go "
            f"on from {on_from} to the same numbers"
        )
    return FloatingPointError(
        f"training: step {step} gave values that are not finite in {', '.join(terms)}; {why}.\n"
        f"The batch is kept in {path}; {way_out}"
    )
