"""What memory there is: of the machine, or what its container may have, and of the devices that compute."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import jax
from jax.sharding import Mesh

_CONTAINER = Path("/sys/fs/cgroup")


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
        limit = int((_CONTAINER / "memory.max").read_text())
        used = int((_CONTAINER / "memory.current").read_text())
    except (OSError, ValueError):  # no container, or none that is limited
        return Memory(total, free)
    return Memory(min(total, limit), max(min(free, limit - used + _given_back()), 0))


def _given_back() -> int:
    """Bytes of files that were read and that the system drops when programs want the room; they count as used."""
    try:
        told = dict(line.split() for line in (_CONTAINER / "memory.stat").read_text().splitlines())
        return int(told["inactive_file"])
    except (OSError, KeyError, ValueError):
        return 0


def for_a_program(mesh: Mesh) -> int | None:
    """Bytes that a compiled program may have on each device of a mesh; None where nobody tells.

    A GPU tells its limit and what is in use. Devices of a CPU share the machine's memory.
    """
    own = [device for device in mesh.devices.flat if device.process_index == jax.process_index()]
    told = [device.memory_stats() for device in own]
    limits = [each["bytes_limit"] - each.get("bytes_in_use", 0) for each in told if each and "bytes_limit" in each]
    if limits:
        return int(min(limits))
    found = memory()
    return found.free // len(own) if found else None
