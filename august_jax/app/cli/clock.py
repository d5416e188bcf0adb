"""How long it takes: while a command is silent, a line says how long it has been at what it is at, and what is left.

What is left is known from the last time that the same command was run to its end on this machine: how long it stayed at
each of its lines of progress is kept beside the factored bodies. Before, the command says in words what to expect. Work
that tells its own time left (training, data sets, evaluations) is not silent for long, and so is not spoken for.
"""

from __future__ import annotations

import json
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

_SILENT_S = 5.0
_AGAIN_S = {True: 1.0, False: 30.0}
"""A terminal's last line is written anew each second; elsewhere a line more is added, now and then."""
_FILE = "durations.json"
_MOST = 200

Stage = tuple[str, float]
"""A line of progress without its numbers, and how long the command stayed at it [s]."""


class Clock:
    """Of one command.

    Args:
        usual: its stages when it last ran to its end.
        now: [s], of a clock that only goes forward.
        first: how long it takes where it never ran before, in words.
    """

    def __init__(self, usual: Sequence[Stage] = (), now: float | None = None, first: str = ""):
        self._usual, self._first = list(usual), first
        self._at, self._line = time.monotonic() if now is None else now, ""
        self._begun = self._at
        self._passed: list[Stage] = []
        self._matched = 0
        self.shown = False

    def heard(self, line: str, now: float | None = None) -> None:
        """A line of progress was written."""
        now = time.monotonic() if now is None else now
        self._passed.append((self._line, now - self._at))
        self._at, self._line = now, stage(line)
        later = [row for row, (name, _) in enumerate(self._usual) if name == self._line and row >= self._matched]
        self._matched = later[0] if later else self._matched

    def silent_s(self, now: float | None = None) -> float:
        """Since the last line [s]."""
        return (time.monotonic() if now is None else now) - self._at

    def left_s(self, now: float | None = None) -> float | None:
        """What is left by the last time [s]; None where nothing is known."""
        if not self._usual or self._usual[self._matched][0] != self._line:
            return None
        stay = self._usual[self._matched][1] - self.silent_s(now)
        return max(stay, 0.0) + sum(seconds for _, seconds in self._usual[self._matched + 1 :])

    def said(self, now: float | None = None) -> str:
        """The line for a reader."""
        now = time.monotonic() if now is None else now
        left = self.left_s(now)
        so_far = f"{told_s(now - self._begun)} so far"
        if left is not None:
            return f"{so_far}, about {told_s(left)} left by the last time"
        return f"{so_far}; for the first time it takes {self._first}" if self._first and not self._usual else so_far

    def stages(self, now: float | None = None) -> list[Stage]:
        """All stages, the present one among them."""
        return [*self._passed, (self._line, self.silent_s(now))]


def stage(line: str) -> str:
    """A line without what changes from one run to the next."""
    return re.sub(r"\S*[\d/]\S*", "#", line)[:80]


def told_s(seconds: float) -> str:
    """``40 s``, ``3:05 min``."""
    whole = round(seconds)
    return f"{whole} s" if whole < 100 else f"{whole // 60}:{whole % 60:02d} min"


_running: Clock | None = None


def wipe() -> None:
    """Take the line that a terminal shows of the clock away, before another one is written."""
    if _running is not None and _running.shown:
        _running.shown = False
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def heard(line: str) -> None:
    """A line of progress was written; told to the clock that runs, if one does."""
    if _running is not None:
        _running.heard(line)


@contextmanager
def watched(name: str, first: str = "") -> Iterator[None]:
    """Speak while the block is silent, and remember how long it took.

    Args:
        name: of what is alike in how long it takes: the command and what it was asked, without places.
        first: how long it takes where it never ran before, in words.
    """
    global _running
    kept = _kept()
    clock, done = Clock(kept.get(name, ()), first=first), threading.Event()
    _running = clock
    live = sys.stderr.isatty()

    def speak() -> None:
        spoken = time.monotonic()
        while not done.wait(0.5):
            now = time.monotonic()
            if clock.silent_s(now) > (_SILENT_S if live else _AGAIN_S[False]) and now - spoken >= _AGAIN_S[live]:
                spoken = now
                text = f"  ... {clock.said(now)}"
                clock.shown = live
                print(f"\r{text}\x1b[K" if live else text, end="" if live else "\n", file=sys.stderr, flush=True)

    threading.Thread(target=speak, daemon=True).start()
    try:
        yield
        done.set()
        if sum(seconds for _, seconds in clock.stages()) > _SILENT_S:
            _keep({**{each: kept[each] for each in list(kept)[-_MOST:] if each != name}, name: clock.stages()})
    finally:
        done.set()
        wipe()
        _running = None


def _place() -> Path:
    from august_jax.files import cache_folder

    return cache_folder() / _FILE


def _kept() -> Mapping[str, Sequence[Stage]]:
    """What is remembered; a file that cannot be read is as good as none."""
    try:
        stored = json.loads(_place().read_text(encoding="utf-8"))
        return {str(name): [(str(line), float(seconds)) for line, seconds in stages] for name, stages in stored.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _keep(kept: Mapping[str, Sequence[Stage]]) -> None:
    from august_jax.files import write_text

    try:
        write_text(_place(), json.dumps(kept))
    except OSError:  # nothing depends on it
        pass
