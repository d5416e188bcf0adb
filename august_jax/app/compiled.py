"""What XLA compiled, kept on the disk: a command's later runs spare half a minute of compiling the search.

JAX keeps compiled programs in a folder that it is told; here that folder lies beside the factored bodies and is named
after the machine, because a program for one processor may end the process on another that shares the home folder. A
folder that the user names (``JAX_COMPILATION_CACHE_DIR``) is left as it is; ``JAX_ENABLE_COMPILATION_CACHE=false``
keeps nothing.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from pathlib import Path
from typing import Any

from august_jax.physics import cache_folder

__all__ = ["compiled_folder", "keep_compiled"]

_LEAST_S = 0.1
"""What compiles faster is not kept: reading it back takes as long."""
_MOST_BYTES = 1 << 30
_PART = 0.8


def compiled_folder() -> Path:
    """Where this machine's compiled programs are kept: a folder of its own in :func:`cache_folder`, by processor and
    release of jaxlib."""
    import jaxlib

    return cache_folder() / "compiled" / f"{jaxlib.__version__}-{hashlib.sha256(_processor()).hexdigest()[:12]}"


def _processor() -> bytes:
    """What tells processors apart that run different instructions; where nothing does, the machine's own name."""
    told = f"{platform.system()} {platform.machine()} "
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return (told + platform.processor() + platform.node()).encode()
    wanted = ("model name", "flags", "Features", "CPU part")
    return (told + "\n".join(sorted({line for line in lines if line.startswith(wanted)}))).encode()


def keep_compiled() -> Path | None:
    """Let JAX keep what takes long to compile, and read it back in later processes.

    Returns:
        The folder; None where JAX is left as it is: the user has said where, or that nothing is to be kept, the folder
        cannot be written, or programs read back are known to end the process (macOS before jaxlib 0.10).
    """
    import jax

    settings: Any = jax.config  # its attributes come to be when JAX is imported
    if settings.jax_compilation_cache_dir or not settings.jax_enable_compilation_cache:
        return None
    import jaxlib

    if sys.platform == "darwin" and tuple(map(int, jaxlib.__version__.split(".")[:2])) < (0, 10):
        return None
    folder = compiled_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _make_room(folder)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST_S)
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
