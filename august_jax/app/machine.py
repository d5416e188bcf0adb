"""What computes: its name for people, a mark that tells it from machines that run other programs, and its memory."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path
from typing import NamedTuple

__all__ = ["Memory", "memory", "processor", "processor_mark"]

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


class Memory(NamedTuple):
    """Of the machine [bytes]: all that there is, and what a new process may have."""

    total: int
    free: int


def memory() -> Memory | None:
    """The machine's memory, or what its container may have; None where the system does not tell."""
    try:
        told = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        total, free = (1024 * int(told[name].split()[0]) for name in ("MemTotal", "MemAvailable"))
    except (OSError, KeyError, ValueError):
        try:
            page = os.sysconf("SC_PAGE_SIZE")
            return Memory(page * os.sysconf("SC_PHYS_PAGES"), page * os.sysconf("SC_AVPHYS_PAGES"))
        except (AttributeError, OSError, ValueError):
            return None
    try:
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text())
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
    except (OSError, ValueError):  # no container, or none that is limited
        return Memory(total, free)
    return Memory(min(total, limit), max(min(free, limit - used), 0))


def _listed() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []
