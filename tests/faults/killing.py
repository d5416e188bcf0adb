"""What ends a child process at a chosen write: before it, amid it, after it.

The package has no hooks for tests. In the child the system calls by which Python code changes files are wrapped: making
a file or a folder, writing into one, flushing, renaming, removing. Each is a point before and a point after; a write is
one more, with half of it in the file. At the chosen point the process kills itself with SIGKILL.

With ``power``, what a power cut could take goes first: of every file what was not flushed, and every new name and
rename in a folder that was not flushed since. SIGKILL alone leaves what the system has taken, flushed or not.
"""

import builtins
import hashlib
import io
import os
import signal
import threading
from pathlib import Path

WRITES = set("wax+")


class Points:
    """Counts the points under a folder and kills at one of them.

    Args:
        root: what is written elsewhere does not count.
        last: number of the point to kill at; None counts alone.
        power: whether what is not on the disk goes with it.
        stop: whether to stop (SIGSTOP) in place of kill.
    """

    def __init__(self, root: Path, last: int | None = None, power: bool = False, stop: bool = False):
        self.root, self.last, self.power, self.stop = root.resolve(), last, power, stop
        self.count = 0
        self.seen: list[str] = []
        self.replaced: list[tuple[str, str]] = []
        self._flushed: dict[int, int] = {}
        """Inode -> bytes of it that are on the disk, where there are more."""
        self._names: list[tuple[Path, Path, Path | None, Path | None]] = []
        """(folder, name, where it came from, what was there) of names that may be lost."""
        self._lock = threading.RLock()
        self._kept = 0
        self._own = {name: getattr(os, name) for name in ("open", "replace", "rename", "fsync", "mkdir", "unlink",
                                                          "remove", "rmdir")}  # fmt: skip
        self._open = io.open

    def install(self) -> None:
        """Wrap the calls, in this process."""
        os.open, os.fsync, os.mkdir = self._os_open, self._fsync, self._wrapped("mkdir", self._made)
        os.replace, os.rename = self._rename("replace"), self._rename("rename")
        for name in ("unlink", "remove", "rmdir"):
            setattr(os, name, self._wrapped(name))
        io.open = builtins.open = self._io_open

    def at(self, what: str, path) -> None:
        """A point."""
        with self._lock:
            self.seen.append(f"{what} {Path(path).name}")
            self.count += 1
            if self.last is not None and self.count - 1 == self.last:
                if self.power:
                    self._cut()
                os.kill(os.getpid(), signal.SIGSTOP if self.stop else signal.SIGKILL)

    def _inside(self, path) -> bool:
        if isinstance(path, int) or path is None:
            return False
        found = Path(os.path.abspath(os.fsdecode(path)))
        return found != self.root and self.root in found.parents

    def _wrapped(self, name, then=lambda path: None):
        call = self._own[name]

        def inside(path, *args, **kwargs):
            if not self._inside(path) or kwargs.get("dir_fd") is not None:
                return call(path, *args, **kwargs)
            self.at(f"before {name}", path)
            result = call(path, *args, **kwargs)
            then(Path(os.fsdecode(path)))
            self.at(f"after {name}", path)
            return result

        return inside

    def _made(self, path: Path) -> None:
        self._names.append((path.parent, path, None, None))

    def _rename(self, name):
        call = self._own[name]

        def inside(source, target, **kwargs):
            if not self._inside(target):
                return call(source, target, **kwargs)
            self.at(f"before {name}", target)
            source, target = Path(os.fsdecode(source)), Path(os.fsdecode(target))
            kept = None
            if self.power and target.is_file():
                kept = self.root.with_name(f"{self.root.name}.kept-{self._kept}")
                self._kept += 1
                os.link(target, kept)
            call(source, target, **kwargs)
            self._names.append((target.parent, target, source, kept))
            if target.is_file():
                content = hashlib.sha256(target.read_bytes()).hexdigest()
                self.replaced.append((str(target.relative_to(self.root)), content))
            self.at(f"after {name}", target)

        return inside

    def _os_open(self, path, flags, *args, **kwargs):
        if not self._inside(path) or not flags & os.O_CREAT:
            return self._own["open"](path, flags, *args, **kwargs)
        new = not os.path.exists(path)
        self.at("before create", path)
        number = self._own["open"](path, flags, *args, **kwargs)
        if new:
            self._made(Path(os.fsdecode(path)))
        self.at("after create", path)
        return number

    def _io_open(self, path, mode="r", *args, **kwargs):
        if not (WRITES & set(mode) and self._inside(path)):
            return self._open(path, mode, *args, **kwargs)
        new = not os.path.exists(path)
        self.at("before open", path)
        raw = self._open(path, mode, *args, **kwargs)
        if new:
            self._made(Path(os.fsdecode(path)))
        found = os.fstat(raw.fileno())
        if "+" not in mode or "w" in mode:  # r+ is how a file is opened to be flushed
            self._flushed.setdefault(found.st_ino, found.st_size)
        self.at("after open", path)
        return Torn(raw, path, self)

    def _fsync(self, number):
        path = Path(os.readlink(f"/proc/self/fd/{number}"))
        if self.root != path and self.root not in path.parents:
            return self._own["fsync"](number)
        self.at("before fsync", path)
        # the disk itself is not tried here, and waiting for it is most of the time
        if path.is_dir():
            self._names = [each for each in self._names if each[0] != path]
        else:
            self._flushed.pop(os.fstat(number).st_ino, None)
        self.at("after fsync", path)

    def _cut(self) -> None:
        for path in self.root.rglob("*"):
            size = self._flushed.get(path.stat().st_ino) if path.is_file() else None
            if size is not None:
                os.truncate(path, size)
        for _, path, source, kept in reversed(self._names):
            if source is None:
                if path.is_dir():
                    continue  # an empty folder more or less
                path.exists() and self._own["unlink"](path)
            elif path.exists() and not source.exists():
                self._own["rename"](path, source)
                if kept is not None:
                    self._own["rename"](kept, path)


class Torn:
    """A file being written, each write with a point at its half."""

    def __init__(self, raw, path, points: Points):
        self._raw, self._path, self._points = raw, path, points

    def write(self, data):
        size = len(data) if isinstance(data, (str, bytes)) else memoryview(data).nbytes
        if size < 2:
            return self._raw.write(data)
        data = data if isinstance(data, str) else bytes(data)
        self._raw.write(data[: size // 2])
        self._raw.flush()
        self._points.at("amid write", self._path)
        self._raw.write(data[size // 2 :])
        return size

    def __getattr__(self, name):
        return getattr(self._raw, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._raw.close()

    def __iter__(self):
        return iter(self._raw)
