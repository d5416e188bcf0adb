"""Factored bodies on the disk, under a hash of all that they depend on; what is damaged is made again.

Tables are large and hold numbers that are right to a few thousandths: three bytes a number keep 16 binary digits.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float, UInt8

from august_jax.files import DamagedFile, cache_folder, read_npz, replacing

Factors = dict[str, np.ndarray]
_FORMAT = "body-7"


def cached(key: Iterable[np.ndarray | float | None], names: tuple[str, ...], make: Callable[[], Factors]) -> Factors:
    """What ``make`` gives, from the disk where it is there and whole.

    Args:
        key: all that the result depends on.
        names: what it holds.
        make: the computation.

    Warns where the result cannot be kept: half a minute's work is not to be thrown away for it.
    """
    digest = hashlib.sha256(_FORMAT.encode())
    for part in key:
        digest.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
    path = cache_folder() / f"{_FORMAT}-{digest.hexdigest()[:24]}.npz"
    if path.exists():
        try:
            stored = read_npz(path)
            return {name: stored[name] for name in names}
        except (OSError, DamagedFile, KeyError):
            pass  # it is made again
    factors = make()
    try:
        with replacing(path) as aside:
            np.savez(aside, **factors)
    except OSError as error:
        warnings.warn(
            f"a factored body could not be kept in {path.parent} ({error.strerror}); set AUGUST_CACHE to "
            "a folder that can be written",
            stacklevel=2,
        )
    return factors


def shortened(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Single-precision numbers by their upper three bytes, rounded: right to 2^-16, finite ones below 3.3e38."""
    bits = np.ascontiguousarray(values, "<f4").view("<u4")
    return ((bits + np.uint32(0x80)) >> 8).view(np.uint8).reshape(*values.shape, 4)[..., :3]


def lengthened(stored: UInt8[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Single-precision numbers of :func:`shortened` ones."""
    filled = np.zeros((*stored.shape[:-1], 4), np.uint8)
    filled[..., 1:] = stored
    return filled.view("<f4")[..., 0]
