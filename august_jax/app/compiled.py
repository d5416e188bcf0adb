"""What XLA compiled, kept on the disk: a command's later runs spare half a minute of compiling the search.

JAX keeps compiled programs in a folder that it is told; here that folder lies beside the factored bodies and is named
after the machine, because a program for one processor may end the process on another that shares the home folder. A
folder that the user names (``JAX_COMPILATION_CACHE_DIR``) is left as it is; ``JAX_ENABLE_COMPILATION_CACHE=false``
keeps nothing.
"""

from __future__ import annotations

import os
import sys
import zlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from august_jax.app.machine import processor_mark
from august_jax.files import cache_folder

__all__ = ["YES", "keep_compiled"]

_LEAST_S = 0.1
"""What compiles faster is not kept: reading it back takes as long."""
_MOST_BYTES = 1 << 30
_PART = 0.8
_STAMP = "looked-at"
_ZSTD = b"\x28\xb5\x2f\xfd"
"""How what JAX packs by zstandard begins, which only newer versions of Python unpack; else it packs by zlib."""
YES = ("y", "yes", "t", "true", "on", "1")
"""What JAX takes for yes."""


def keep_compiled() -> Path | None:
    """Let JAX keep what takes long to compile, and read it back in later processes.

    JAX is told by its variables, which it reads when it is imported: a command that refuses its input answers without.

    Returns:
        The folder; None where JAX is left as it is: it is imported already, the user has said where, or that nothing is
        to be kept, the folder cannot be written, or programs read back are known to end the process (macOS before
        jaxlib 0.10).
    """
    wanted = os.environ.get("JAX_ENABLE_COMPILATION_CACHE", "true").lower() in YES
    if "jax" in sys.modules or os.environ.get("JAX_COMPILATION_CACHE_DIR") or not wanted:
        return None
    try:
        release = version("jaxlib")
    except PackageNotFoundError:  # importing JAX says so better
        return None
    if sys.platform == "darwin" and tuple(map(int, release.split(".")[:2])) < (0, 10):
        return None
    folder = cache_folder() / "compiled" / f"{release}-{processor_mark()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _make_room(folder)
        _drop_torn(folder)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_LEAST_S))
    return folder


def _make_room(folder: Path) -> None:
    """Of too many programs the oldest go; another process that looks for one compiles it again."""
    kept = []
    for path in folder.iterdir():
        try:
            about = path.stat()
        except FileNotFoundError:  # another process makes room
            continue
        kept.append((about.st_mtime, about.st_size, path))
    total = sum(size for _, size, _ in kept)
    if total <= _MOST_BYTES:
        return
    for _, size, path in sorted(kept):
        path.unlink(missing_ok=True)
        total -= size
        if total <= _PART * _MOST_BYTES:
            return


def _drop_torn(folder: Path) -> None:
    """Of the programs written since the last look, those that a killed process left half-written go.

    JAX writes in place, warns of what it cannot read in every later process, and does not write it anew.
    """
    stamp = folder / _STAMP
    since = stamp.stat().st_mtime_ns if stamp.exists() else 0
    stamp.touch()  # what is written from now on is looked at the next time
    for path in folder.glob("*-cache"):
        try:
            if path.stat().st_mtime_ns < since:
                continue
            content = path.read_bytes()
            if not content.startswith(_ZSTD):
                zlib.decompress(content)
        except zlib.error:
            path.unlink(missing_ok=True)
        except FileNotFoundError:  # another process makes room
            continue
