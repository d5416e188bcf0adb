"""Files that appear whole or not at all: written aside, flushed to disk, renamed; and damaged ones, told as such."""

from __future__ import annotations

import errno
import os
import threading
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np


class DamagedFile(ValueError):
    """A file is there but cannot be read as what it should be."""


def cache_folder() -> Path:
    """Where bodies, tables and programs are kept: ``$AUGUST_CACHE``, else ``august_jax`` in the user's cache folder."""
    named = os.environ.get("AUGUST_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "august_jax"


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Errors of writing within, of which Python names no file, name this one: a full disk is somebody's to clear."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        # NumPy's own error, of fewer bytes written than asked, has no number
        raise OSError(error.errno or errno.ENOSPC, error.strerror or str(error), str(path)) from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well, and vanishes otherwise."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}{path.suffix}")
    try:
        with naming(path):
            yield aside
            with aside.open("rb+") as file:
                os.fsync(file.fileno())
        rename(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def rename(source: Path, target: Path) -> None:
    """Put ``source`` in the place of ``target``; the new name is on the disk when this returns."""
    os.replace(source, target)
    if os.name == "posix":  # elsewhere folders cannot be opened
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text."""
    with replacing(path) as aside:
        aside.write_text(text, encoding="utf-8")


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of a ``.npz`` file by name; what is in it is data alone, never executed.

    Raises:
        FileNotFoundError: no such file.
        DamagedFile: it is damaged, or no ``.npz``; the message names it and says what is wrong.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            stored = np.load(file, allow_pickle=False)
            if isinstance(stored, np.ndarray):
                raise ValueError("it holds one bare array")
            with stored:
                return {name: stored[name] for name in stored.files}
    except (FileNotFoundError, MemoryError):
        raise
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedFile(f"{path}: is damaged, or no .npz file ({reason})") from None
