"""Lines of progress: who works long takes a callback, who calls says where the lines go; and what they tell of time
and room."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[str], None]
"""Takes one line of progress, without its end."""


def silent(line: str) -> None:
    """Say nothing."""


def told_bytes(count: int) -> str:
    """Bytes as a person reads them."""
    return f"{count / 1e9:.1f} GB" if count >= 1e8 else f"{count / 1e6:.1f} MB"


class TimeLeft:
    """What is left of some equal pieces, told as they are done.

    Args:
        pieces: how many there are; the clock starts now.
    """

    def __init__(self, pieces: int):
        self._pieces, self._done, self._began = pieces, 0, time.monotonic()

    @property
    def each_s(self) -> float:
        """What a piece has taken so far, on average [s]; 0 before the first is done."""
        return (time.monotonic() - self._began) / max(self._done, 1) if self._done else 0.0

    def after_one(self) -> str:
        """One more piece is done: how long the others take, in words."""
        self._done += 1
        left = self.each_s * (self._pieces - self._done)
        return f"{left:.0f} s left" if left < 100.0 else f"{left / 60.0:.0f} min left"
