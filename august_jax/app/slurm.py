"""What part of the work a task of a SLURM array has: read from the variables that SLURM gives each of its tasks.

``--array=0-7`` makes eight tasks whose numbers begin at 0, ``--array=1-8`` eight that begin at 1, ``--array=0-28:4``
eight in steps of 4: the part is counted from the least number, in steps. Of an array with gaps (``--array=1,3,7``)
nobody knows which parts its other tasks were meant to make; it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping

from august_jax.config import ConfigError

__all__ = ["array_part"]

_TASK = "SLURM_ARRAY_TASK_ID"
_OTHERS = ("SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_MAX")
_STEP = "SLURM_ARRAY_TASK_STEP"


def array_part(environment: Mapping[str, str]) -> tuple[int, int] | None:
    """(i, n), the i-th of n parts, i from 1; None outside of an array.

    Args:
        environment: the process's variables.

    Raises:
        ConfigError: variables that are missing, are no numbers or do not go together, or an array with gaps.
    """
    if _TASK not in environment:
        return None
    told = {name: environment.get(name, "") for name in (_TASK, *_OTHERS)} | {_STEP: environment.get(_STEP) or "1"}
    wrong = [name for name, text in told.items() if not text.isdigit()]
    if wrong:
        raise ConfigError(
            f"{wrong[0]}: {told[wrong[0]]!r} is no number, but {_TASK} is {told[_TASK]!r}, as in a SLURM array; say "
            "what part this is, --shard I/N"
        )
    task, count, low, high, step = (int(text) for text in told.values())
    known = ", ".join(f"{name}={text}" for name, text in told.items())
    if step < 1 or (high - low) // step + 1 != count:
        raise ConfigError(
            f"SLURM: an array with gaps ({known}); take consecutive numbers, such as --array=1-{max(count, 1)}, or say "
            "what part this is, --shard I/N"
        )
    if not low <= task <= high or (task - low) % step:
        raise ConfigError(f"SLURM: a task that is not in its array ({known}); say what part this is, --shard I/N")
    return (task - low) // step + 1, count
