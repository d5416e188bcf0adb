"""What computes: its name for people, and a mark that tells it from machines that run other programs."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

__all__ = ["processor", "processor_mark"]

_TELLING = ("model name", "flags", "Features", "CPU part")
"""Lines of the system's list of processors that differ where instructions do."""


def processor() -> str:
    """The processor's own name, where the system tells it."""
    named = (line.split(":")[1].strip() for line in _listed() if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def processor_mark() -> str:
    """Twelve characters that differ between processors that run different instructions; where the system does not list
    these, between machines."""
    told = sorted({line for line in _listed() if line.startswith(_TELLING)})
    parts = (platform.system(), platform.machine(), *(told or (platform.processor(), platform.node())))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _listed() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []
