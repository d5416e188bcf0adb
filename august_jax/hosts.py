"""Several hosts that train as one: how they meet, agree and end together.

Every host runs the same command. None finds the others by itself: the address of the first, their number and its own
place are told (:func:`join`). The first host alone writes files; what it read, the others get from it
(:func:`from_first`). Whatever may fail on one host is done by :func:`together`: where one gives up, all do, and none
waits for ever.

Where there is one host, all of this does nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

MEETING_S = 300
"""How long hosts wait for one another at the start [s]."""
LATE_S = 3600
"""How long one waits for another that factors, compiles or saves [s]."""
_SILENT_S = 30
"""After so long without a sign of life [s] a host counts as gone, which ends the others."""

T = TypeVar("T")
_meetings = iter(range(1, 1 << 62))


def join(coordinator: str, host: tuple[int, int], *, wait_s: int = MEETING_S) -> None:
    """Meet the other hosts; before JAX has computed anything.

    Args:
        coordinator: ``ADDRESS:PORT`` of the first host, as the others reach it.
        host: (i, n), the i-th of n, i from 1.
        wait_s: how long to wait for the others [s].

    Raises:
        ValueError: an address without a port, a place that is none, JAX has computed already, or the others do not
            come.
    """
    index, count = host
    address, _, port = coordinator.rpartition(":")
    if not address or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"coordinator: got {coordinator!r}; give ADDRESS:PORT of the first host, e.g. 10.0.0.1:7654")
    if not 1 <= index <= count:
        raise ValueError(f"host: got {index}/{count}; give i/n with 1 <= i <= n, e.g. 1/2")
    try:
        jax.distributed.initialize(
            coordinator,
            count,
            index - 1,
            cluster_detection_method="deactivate",
            initialization_timeout=wait_s,
            heartbeat_timeout_seconds=_SILENT_S,
        )
    except RuntimeError as error:  # of the service behind it, or of what was computed before
        why = str(error).strip().splitlines()[0]
        raise ValueError(
            f"coordinator: host {index} of {count} did not meet the others at {coordinator} ({why}); start the same "
            f"command on every host within {wait_s} s, each with its own place"
        ) from error


def is_first() -> bool:
    """Whether this host writes."""
    return jax.process_index() == 0


def wait(seconds: int = LATE_S) -> None:
    """Until all hosts are here: what follows may be a computation of all, which waits less patiently."""
    if jax.process_count() > 1:
        from jax._src.distributed import global_state  # what JAX and orbax themselves wait by

        client = global_state.client
        assert client is not None
        client.wait_at_barrier(f"august-{next(_meetings)}", timeout_in_ms=1000 * seconds)


def together(work: Callable[[], T]) -> T:
    """What ``work`` gives on this host, once it is done on every one.

    Raises:
        ValueError: it failed elsewhere; here its own error.
    """
    if jax.process_count() == 1:
        return work()
    result, failed = None, None
    try:
        result = work()
    except Exception as error:
        failed = error
    wrong = np.flatnonzero(_of_all(np.int32(failed is not None)))
    if failed is not None:
        raise failed
    if wrong.size:
        named = ", ".join(str(number + 1) for number in wrong)
        raise ValueError(f"host: {named} of {jax.process_count()} gave up, and says why; nothing is trained without it")
    return result  # type: ignore[return-value]


def agreed(name: str, text: str) -> None:
    """Refuse to go on where hosts were told different things.

    Raises:
        ValueError: ``text``, called ``name``, differs between hosts.
    """
    if jax.process_count() > 1 and len(set(_of_all(np.uint32(zlib.crc32(text.encode()))).tolist())) > 1:
        raise ValueError(f"{name}: hosts were given different ones; start the same command on every host")


def from_first(tree: T) -> T:
    """Arrays and keys as the first host has them, on every host, each on its own first device."""
    if jax.process_count() == 1:
        return tree
    from jax.experimental import multihost_utils

    leaves, structure = jax.tree.flatten(tree)
    keys = [jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]
    plain = [np.asarray(jax.random.key_data(leaf) if key else leaf) for leaf, key in zip(leaves, keys)]
    wait()
    shared = [jax.numpy.asarray(np.asarray(leaf)) for leaf in multihost_utils.broadcast_one_to_all(plain)]
    found = [
        jax.random.wrap_key_data(new, impl=jax.random.key_impl(old)) if key else new
        for new, old, key in zip(shared, leaves, keys)
    ]
    return jax.tree.unflatten(structure, found)


def _of_all(number: np.ndarray | np.generic) -> np.ndarray:
    """A number of each host (hosts,)."""
    from jax.experimental import multihost_utils

    wait()
    return np.asarray(multihost_utils.process_allgather(number)).reshape(-1)
