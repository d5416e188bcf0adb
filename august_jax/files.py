"""What happens to files: they appear whole or not at all, damaged ones are told as such, and one process at a time
works in a folder.

A file is written aside, flushed to the disk and renamed, and the folder is flushed after it: whatever ends the process,
or the machine, leaves the old file or the new one. What a killed process left aside, its next writer removes. A folder
is held by a lock of the system's own (flock), which ends with the process however that ends: no lock is ever stale.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # not on Windows, where nothing is held
    fcntl = None  # type: ignore[assignment]

_SUM = "sum"
"""The key of a JSON file under which it holds its own check sum."""
_PATIENCE_S = 0.2
"""After which a lock counts as held: who only looks whether it is, holds it for an instant."""
_UNFINISHED: set[Path] = set()
"""What this process has aside at the moment."""


class DamagedFile(ValueError):
    """A file is there but cannot be read as what it should be."""


class Occupied(ValueError):
    """Another process works in a folder."""


def cache_folder() -> Path:
    """Where bodies, tables and programs are kept: ``$AUGUST_CACHE``, else ``august_jax`` in the user's cache folder."""
    named = os.environ.get("AUGUST_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "august_jax"


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Errors of writing within, of which Python names no file or one aside, name this one: a full disk is somebody's to
    clear."""
    path = Path(path)
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            named = Path(os.fsdecode(error.filename))
            if named.parent != path.parent or not named.name.startswith(f".{path.name}."):
                raise
        # NumPy's own error, of fewer bytes written than asked, has no number
        raise OSError(error.errno or errno.ENOSPC, error.strerror or str(error), str(path)) from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well, and vanishes otherwise."""
    path = Path(path)
    make_folder(path.parent)
    _sweep(path)
    with naming(path):
        aside, held = _begin(path)
    _UNFINISHED.add(aside)
    try:
        with naming(path):
            yield aside
            with aside.open("rb+") as file:
                os.fsync(file.fileno())
        rename(aside, path)
    finally:
        aside.unlink(missing_ok=True)
        _UNFINISHED.discard(aside)
        os.close(held)


@contextmanager
def replacing_together(folder: str | Path, names: Sequence[str]) -> Iterator[dict[str, Path]]:
    """Name -> temporary path, for the files of one result, which take their places when the block ends well.

    The folder is held meanwhile. All are written before any takes its place, and the first of the names comes last:
    where it is missing, the process was stopped between the files of two results.
    """
    folder = Path(folder)
    with occupying(folder, wait=True), ExitStack() as whole:
        yield {name: whole.enter_context(replacing(folder / name)) for name in names}
        (folder / names[0]).unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """The same for a folder of files, each of which the block flushes; who calls holds the folder above.

    What is in the place of ``path`` is removed first: it must be worth nothing.
    """
    path = Path(path)
    aside = path.with_name(f".{path.name}.part")
    shutil.rmtree(aside, ignore_errors=True)
    make_folder(aside)
    _UNFINISHED.add(aside)
    try:
        yield aside
        _flush_folder(aside)
        if path.exists():
            shutil.rmtree(path)
        rename(aside, path)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        _UNFINISHED.discard(aside)


def discard_unfinished() -> None:
    """Remove what this process has aside, before it ends without unwinding."""
    for path in list(_UNFINISHED):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()


def rename(source: Path, target: Path) -> None:
    """Put ``source`` in the place of ``target``; the new name is on the disk when this returns."""
    os.replace(source, target)
    _flush_folder(target.parent)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it that are missing; their names are on the disk when this returns."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for each in reversed(missing):
        _flush_folder(each.parent)


def flush_tree(folder: Path) -> None:
    """Bring a folder that somebody else wrote, all that is in it, and its name to the disk."""
    for path in folder.rglob("*"):
        if path.is_dir():
            _flush_folder(path)
        else:
            with path.open("rb+") as file:
                os.fsync(file.fileno())
    _flush_folder(folder)
    _flush_folder(folder.parent)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text."""
    with replacing(path) as aside:
        aside.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object with a check sum of its own, which :func:`read_json` looks at."""
    write_text(path, json.dumps({**content, _SUM: _sum_of(content)}, indent=1, allow_nan=False))


def read_json(path: str | Path) -> dict[str, Any]:
    """The object that :func:`write_json` wrote; one without a check sum is taken as it is.

    Raises:
        FileNotFoundError: no such file.
        DamagedFile: it is no JSON object, or another one than was written.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:  # of JSON and of UTF-8
        content = None
    if not isinstance(content, dict) or content.pop(_SUM, None) not in (None, _sum_of(content)):
        raise DamagedFile(f"{path}: is damaged")
    return content


def write_array(path: Path, value: np.ndarray) -> str:
    """Write a bare ``.npy`` file into a folder that is aside, flushed; returns its SHA-256 in hexadecimal."""
    with naming(path), path.open("wb") as file:
        np.save(file, value, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())
    return sha256_of(path)


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of a ``.npz`` file by name; what is in it is data alone, never executed.

    Raises:
        FileNotFoundError: no such file.
        DamagedFile: it is damaged, or no ``.npz``; the message names it and says what is wrong.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            if file.read(6) == b"\x93NUMPY":
                raise ValueError("it holds one bare array")
            arrays = {}
            with zipfile.ZipFile(file) as stored:
                for name in stored.namelist():
                    with stored.open(name) as member:
                        arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
                        # the check sum is compared at a member's end, which a damaged header may place elsewhere
                        if member.read(1):
                            raise ValueError(f"{name} is longer than it says")
            return arrays
    except (FileNotFoundError, MemoryError):
        raise
    except (
        OSError, ValueError, EOFError, KeyError, TypeError, SyntaxError, OverflowError, NotImplementedError,
        RuntimeError, TokenError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip  # whatever a flipped byte makes of a header
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedFile(f"{path}: is damaged, or no .npz file ({reason})") from None


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def occupying(
    folder: str | Path, name: str = ".lock", *, wait: bool = False, check: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Hold ``folder`` against other processes while the block runs.

    Where the system or the file system has no locks nothing is held. A folder that was made for it and is left empty
    vanishes again.

    Args:
        folder: made if missing.
        name: of the lock's file in it, which is there while it is held.
        wait: for the process that holds it, in place of refusing.
        check: called with the lock held, before the block.

    Raises:
        Occupied: another process holds it; names its number.
    """
    folder = Path(folder)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    make_folder(folder)
    lock = folder / name
    try:
        held = _lock(lock, wait)
        _UNFINISHED.add(lock)
        try:
            check()
            yield
        finally:
            lock.unlink(missing_ok=True)
            _UNFINISHED.discard(lock)
            os.close(held)
    finally:
        for each in made:
            try:
                each.rmdir()
            except OSError:  # it holds something now
                break


def occupant(lock: Path) -> str | None:
    """Which process holds a lock, in words; None where none does."""
    try:
        number = os.open(lock, os.O_RDWR)
    except OSError:
        return None
    try:
        fcntl.flock(number, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _written_in(number)
    except (OSError, AttributeError):
        pass
    finally:
        os.close(number)
    return None


def occupied(folder: Path, who: str) -> Occupied:
    """What to say where another process works."""
    return Occupied(f"folder: {folder} is being written by {who}; wait until it ends, or choose another folder")


def _lock(lock: Path, wait: bool) -> int:
    """A descriptor with the lock on the file that is in that place."""
    refused = time.monotonic() + _PATIENCE_S
    while True:
        number = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = _written_in(number)
            os.close(number)
            if time.monotonic() > refused and not wait:
                raise occupied(lock.parent, who) from None
            time.sleep(0.01)
            continue
        except (OSError, AttributeError):  # no locks on this system, or on this file system
            return number
        if _is_at(number, lock):
            with suppress(OSError):  # of a full disk: the lock holds all the same
                os.ftruncate(number, 0)
                os.pwrite(number, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
            return number
        os.close(number)  # who held it has removed the file since


def _written_in(number: int) -> str:
    return os.pread(number, 300, 0).decode("utf-8", "replace").strip() or "another process"


def _is_at(number: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(number), path.stat())
    except OSError:
        return False


def _begin(path: Path) -> tuple[Path, int]:
    """A new empty file beside ``path``, and a descriptor that holds it: it is not what a killed process left."""
    while True:
        aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part{path.suffix}")
        number = os.open(aside, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
        if fcntl is None:
            return aside, number
        try:
            fcntl.flock(number, fcntl.LOCK_EX)
        except OSError:
            return aside, number
        if _is_at(number, aside):
            return aside, number
        os.close(number)  # swept before it was held


def _sweep(path: Path) -> None:
    """Remove what killed processes left of ``path``: what is aside and nobody holds."""
    if fcntl is None:
        return
    # also what was aside of what was aside
    left = re.compile(rf"\.+{re.escape(path.name)}(\.[0-9a-f]{{8}}\.part{re.escape(path.suffix)})+")
    for name in os.listdir(path.parent):
        if not left.fullmatch(name):
            continue
        with suppress(OSError):  # somebody else's, or gone
            number = os.open(path.with_name(name), os.O_RDWR)
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.with_name(name).unlink()
            finally:
                os.close(number)


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":  # elsewhere folders cannot be opened
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that flush no folders
            raise
    finally:
        os.close(number)


def _sum_of(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
