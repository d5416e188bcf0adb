"""Kills the package's writers, again and again, and looks at what is left: a process of its own that forks them.

    python tests/faults/harness.py WORK ... [--share S | --most N | --times N] [--power] [--plain] [--seed SEED]

Each WORK of `works.py` runs once to its end, which gives the points (`killing.py`) and the right result. Then, for a
share of the points, a child is killed there, in an empty folder. `--times` kills as often at random times in place of
that: between the points lies what libraries do in C++. After each kill three fresh processes

1. look: all files there are whole, and each is one that an uninterrupted run leaves at some time,
2. run again, to the end, in spite of whatever the killed one left,
3. compare: the same names, the same hashes, nothing left behind, and no work done twice but a shard or what lies
   between two checkpoints.

`--plain` puts a writer that opens, writes and closes in the place of the atomic one: the harness must then find faults.
The outcome goes to stdout as JSON, one object a kill; `fault` is null or says what was wrong.
"""

import argparse
import collections
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from contextlib import contextmanager
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

from killing import Points
from works import WORKS, hashes

from august_jax import files


class Child:
    """A forked process at a task; its value comes back as JSON."""

    def __init__(self, task):
        self._reading, writing = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(self._reading)
            quiet = os.open(os.devnull, os.O_WRONLY)
            for number in (1, 2):
                os.dup2(quiet, number)
            try:
                answer, status = {"value": task()}, 0
            except BaseException as error:
                told = f"{type(error).__name__}: {error}".splitlines()
                answer, status = {"error": " ".join(told)[:300], "where": traceback.format_exc()[-900:]}, 1
            with os.fdopen(writing, "w") as out:
                out.write(json.dumps(answer))
            os._exit(status)
        os.close(writing)

    def wait(self) -> tuple[int, dict]:
        """How it ended, negative for a signal, and what it said."""
        with os.fdopen(self._reading) as answer:
            said = answer.read()
        _, status = os.waitpid(self.pid, 0)
        return os.waitstatus_to_exitcode(status), json.loads(said) if said else {}


def forked(task):
    """The value of a task in a process of its own; raises what it raised, as a RuntimeError."""
    _, answer = Child(task).wait()
    if "value" not in answer:
        raise RuntimeError(answer.get("error", "ended without a word"))
    return answer["value"]


@contextmanager
def plain(path):
    """What `files.replacing` would be without care."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    yield Path(path)


@contextmanager
def plain_folder(path):
    Path(path).mkdir(parents=True, exist_ok=True)
    yield Path(path)


def careless() -> None:
    """Put the plain writers in the place of the atomic ones, wherever these were imported."""
    for own, other in ((files.replacing, plain), (files.replacing_folder, plain_folder)):
        for module in list(sys.modules.values()):
            for name, value in list(getattr(module, "__dict__", {}).items()):
                if value is own:
                    setattr(module, name, other)


class Trial:
    """A work, its points and its right result."""

    def __init__(self, name: str, place: Path, plainly: bool, power: bool):
        self.name, self.work, self.plainly, self.power = name, WORKS[name], plainly, power
        self._place = place
        self.place("first").mkdir()
        began = time.monotonic()
        first = forked(lambda: self._run("first", careful=True))
        self.seconds = time.monotonic() - began
        self.result = forked(lambda: self.work.result(self.place("first")))
        self.points = forked(lambda: self._counted()) if plainly else first["seen"]
        self.legal = collections.defaultdict(set)
        for path, content in [*first["replaced"], *hashes(self.place("first")).items()]:
            self.legal[path].add(content)

    def place(self, name) -> Path:
        return self._place / f"{self.name}-{name}"

    def _ledger(self, name):
        number = os.open(str(self.place(name)) + ".ledger", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        return lambda entry: os.write(number, f"{entry}\n".encode())

    def _run(self, name, last=None, careful=False):
        if self.plainly and not careful:
            careless()
        ledger = self._ledger(name)
        points = Points(self.place(name), last, self.power)
        points.install()
        self.work.run(self.place(name), ledger)
        return {"seen": points.seen, "replaced": points.replaced}

    def _counted(self):
        self.place("counted").mkdir()
        return self._run("counted")["seen"]

    def kill(self, number: int) -> dict:
        """Kill at a point and look."""
        self.place(number).mkdir()
        status, _ = Child(lambda: self._run(number, number)).wait()
        told = {"work": self.name, "at": self.points[number], "killed": status == -signal.SIGKILL, "power": self.power}
        return told | {"fault": self._fault(number)}

    def kill_after(self, name: str, seconds: float) -> dict:
        """Kill after a time and look."""
        self.place(name).mkdir()
        child = Child(lambda: self._run(name))
        time.sleep(seconds)
        os.kill(child.pid, signal.SIGKILL)
        status, _ = child.wait()
        told = {"work": self.name, "at": f"{seconds:.3f} s", "killed": status == -signal.SIGKILL, "power": False}
        return told | {"fault": self._fault(name)}

    def half_written(self, folder) -> str | None:
        """A file that is none of those that whole work leaves on its way."""
        for path, content in hashes(folder).items():
            hidden = any(part.startswith(".") for part in Path(path).parts)
            if not hidden and self.work.whole(path) and content not in self.legal[path]:
                return f"{path} is half-written"
        return None

    def _fault(self, name) -> str | None:
        folder = self.place(name)
        try:
            if half := self.half_written(folder):
                return half
            forked(lambda: self.work.look(folder))
            forked(lambda: self.work.run(folder, self._ledger(name)))
            # the file of a lock that nobody holds stays until somebody works there again
            left = [
                path
                for path in map(str, folder.rglob("*"))
                if ("/." in path and not Path(path).name.startswith(".lock")) or "-tmp" in path
            ]
            if left:
                return f"left behind: {left[0]}"
            result = forked(lambda: self.work.result(folder))
            if result != self.result:
                other = {path for path in {*result, *self.result} if result.get(path) != self.result.get(path)}
                return f"other after another run: {', '.join(sorted(other))}"
            entries = collections.Counter(Path(str(folder) + ".ledger").read_text().split("\n")[:-1])
            again = sum(entries.values()) - len(entries)
            if again > self.work.once_more or max(entries.values()) > 2:
                return f"done again: {dict(entries)}"
        except RuntimeError as error:
            return str(error)
        finally:
            for path in folder.parent.glob(f"{folder.name}*"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        return None


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("works", nargs="+", choices=[*WORKS])
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--most", type=int)
    parser.add_argument("--times", type=int, default=0)
    parser.add_argument("--power", action="store_true")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    chance = random.Random(args.seed)
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        for name in args.works:
            trial = Trial(name, Path(place), args.plain, args.power)
            if args.times:
                for number in range(args.times):
                    told = trial.kill_after(f"t{number}", chance.uniform(0.0, trial.seconds))
                    print(json.dumps(told), flush=True)
                continue
            count = min(max(1, round(args.share * len(trial.points))), args.most or len(trial.points))
            for number in sorted(chance.sample(range(len(trial.points)), count)):
                print(json.dumps(trial.kill(number)), flush=True)


if __name__ == "__main__":
    main()
