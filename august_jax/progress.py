"""Lines of progress: who works long takes a callback, who calls says where the lines go."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str], None]
"""Takes one line of progress, without its end."""


def silent(line: str) -> None:
    """Say nothing."""
