"""Damages what the commands wrote, file by file, and fills their disk: what do those say who use it next?

    python tests/faults/damage.py WORK ... [--most N] [--full] [--read-only] [--seed SEED]

Each WORK of `works.py` runs to its end. Then, again and again, one of its files has a bit flipped, is cut, emptied,
overwritten or removed. A fresh process uses what is there. Either it gets the right result, or an error of at most six
lines, nothing else said, that names the file or its folder; after what the message advises, the result is right.

With `--full` the work runs on a disk that is full after so many bytes, and with `--read-only` on one that becomes
read-only: the same, and all files there are whole. That takes a file system of its own, and so the right to mount one.
The outcome goes to stdout as JSON, one object a damage; `fault` is null or says what was wrong.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from harness import Child, Trial, forked
from works import CONFIG, TRAINED, hashes, restored, samples, trained

from august_jax import data
from august_jax.app.cli import export
from august_jax.app.cli.messages import hush, told
from august_jax.data import shards
from august_jax.files import read_npz
from august_jax.models.weights import read_weights

MOST_LINES = 6
KINDS = ("flip", "flip", "flip", "cut", "empty", "junk", "gone")
CHANGED_UNSEEN = (".png", ".pdf", ".jsonl", ".html", ".ply", "metrics.json")
"""For people to look at: nothing reads them again."""


def spoken(task, log: Path) -> tuple[dict, list[str]]:
    """What a task in a process of its own gives, and all lines that a user would have seen."""

    def talking():
        number = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(number, stream)
        hush()
        try:
            return {"value": task()}
        except Exception as error:
            os.write(number, told(error).encode() + b"\n")
            return {"error": " ".join(str(error).split())}

    status, answer = Child(talking).wait()
    lines = log.read_text(errors="replace").splitlines()
    return answer.get("value", {"error": f"ended with status {status}"}), lines


def use_data(folder: Path) -> None:
    rows = np.arange(CONFIG.data.count)
    dataset = data.Dataset(folder)
    for name, value in samples(rows, CONFIG).columns().items():
        np.testing.assert_array_equal(dataset.read(rows).columns()[name], value)
    assert dataset.config == CONFIG


def mend_data(folder: Path) -> None:
    shards.generate = lambda config, rows, targets, **_: samples(rows, config)
    shards.prepare_targets = lambda config, progress: []
    data.simulate(CONFIG, folder, verify=True)


def use_run(folder: Path) -> None:
    read_weights(folder / "weights.npz")
    train_on(folder)


def train_on(folder: Path) -> None:
    trained(TRAINED, folder, lambda entry: None)


def use_flight(folder: Path) -> None:
    _, record, _ = export._source(folder, -1)
    np.testing.assert_array_equal(record["points"], np.random.default_rng(2).normal(size=(3, 2, 6, 3))[2][-1])


class Damaged:
    """A work that has ended, and how its results are used and made again."""

    def __init__(self, name: str, place: Path):
        self.name, self.place = name, place
        self.trial = Trial(name, place, False, False)
        self.first = self.trial.place("first")
        run = self.trial.work.run
        self.use, self.mend = {
            "simulate": (use_data, mend_data),
            "train": (use_run, train_on),
            "track": (use_flight, lambda folder: run(folder, lambda entry: None)),
        }.get(name, (lambda folder: run(folder, lambda entry: None),) * 2)

    def files(self) -> list[str]:
        """Those that something reads again."""
        found = [path for path in hashes(self.first) if not path.endswith(CHANGED_UNSEEN)]
        # of a run's own configuration nothing is kept from which it could be made again
        return [path for path in found if not (path.endswith("config.yaml") and self.name != "simulate")]

    def damage(self, path: str, kind: str, chance: random.Random) -> dict:
        """Damage one file of a copy and look."""
        folder = self.place / "damaged"
        shutil.copytree(self.first, folder)
        file = folder / path
        content = bytearray(file.read_bytes())
        if kind == "flip" and content:
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        whole = {"flip": content, "cut": content[: len(content) // 2], "empty": b"", "junk": b"junk" * 50}
        file.unlink() if kind == "gone" else file.write_bytes(whole[kind])
        fault, noticed = self._outcome(folder)
        shutil.rmtree(folder)
        return {"work": self.name, "file": path, "kind": kind, "noticed": noticed, "fault": fault}

    def _outcome(self, folder: Path) -> tuple[str | None, bool]:
        answer, lines = spoken(lambda: self.use(folder), self.place / "log")
        error = answer.get("error")
        if error is not None:
            if len(lines) > MOST_LINES or "Traceback" in "".join(lines):
                return f"{len(lines)} lines: {lines[0]}", True
            named = re.search(re.escape(str(folder)) + r"[^\s:,;']*", error)
            if named is None:
                return f"no file named: {error}", True
            if re.search(r"remove (it|that folder)", error):
                gone = Path(named[0])
                shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
            answer, lines = spoken(lambda: self.mend(folder), self.place / "log")
            if "error" in answer:
                return f"after what the message advised ({error}): {answer['error']}", True
            answer, lines = spoken(lambda: self.use(folder), self.place / "log")
        if "error" in answer:
            return f"after what the message advised ({error}): {answer['error']}", True
        if lines:
            return f"said beside the result: {lines[0]}", error is not None
        if self.name == "cache":
            whole = forked(lambda: {path.name: len(read_npz(path)) for path in folder.glob("body-*.npz")})
            return (None if len(whole) == 3 else f"{len(whole)} of 3 are kept"), error is not None
        if self.name == "train" and forked(lambda: list(restored(folder))) != forked(
            lambda: list(restored(self.first))
        ):
            return "another checkpoint", error is not None
        return None, error is not None


class Disk:
    """A file system of a given size; the place is where it is mounted."""

    def __init__(self, place: Path, kib: int):
        self.place = place
        place.mkdir()
        _mounted("-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(place))

    def change(self, option: str) -> None:
        _mounted("-o", f"remount,{option}", str(self.place))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        subprocess.run(["umount", str(self.place)], check=True)
        self.place.rmdir()


def _mounted(*words: str) -> None:
    done = subprocess.run(["mount", *words], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"no file system of its own: {done.stderr.strip()}")


def fill(trial: Trial, kib: int, place: Path) -> dict:
    """Run a work where the disk is full after so much, make room, and run again."""

    def run(folder):
        # what is checked before the work is tried elsewhere; here the disk fills amid it
        free = shutil._ntuple_diskusage(1 << 40, 0, 1 << 40)  # type: ignore[attr-defined]
        shutil.disk_usage = lambda path: free
        return trial.work.run(folder, lambda entry: None)

    with Disk(place / "disk", kib) as disk:
        folder = disk.place / "work"
        answer, lines = spoken(lambda: run(folder), place / "log")
        fault = _refused(trial, folder, answer, lines, ("No space left", "room"))
        disk.change("size=64m")
        return _again(trial, folder, answer, fault) | {"kind": f"full after {kib} KiB"}


def lock(trial: Trial, place: Path) -> dict:
    """Run a work where nothing can be written, allow it, and run again."""
    with Disk(place / "disk", 1 << 16) as disk:
        disk.change("ro")
        folder = disk.place / "work"
        answer, lines = spoken(lambda: trial.work.run(folder, lambda entry: None), place / "log")
        fault = _refused(trial, folder, answer, lines, ("Read-only", "read-only"))
        disk.change("rw")
        return _again(trial, folder, answer, fault) | {"kind": "read-only"}


def _refused(trial, folder, answer, lines, words) -> str | None:
    error, text = answer.get("error"), " ".join(lines)
    if error is None:
        return None
    if len(lines) > MOST_LINES or "Traceback" in text:
        return f"{len(lines)} lines: {lines[0]}"
    if not any(word in text for word in words) or str(folder.parent) not in text:
        return f"not told: {text}"
    return trial.half_written(folder)


def _again(trial, folder, answer, fault) -> dict:
    with contextlib.suppress(OSError):
        folder.mkdir()
    if fault is None:
        forked(lambda: trial.work.run(folder, lambda entry: None))
        if forked(lambda: trial.work.result(folder)) != trial.result:
            fault = "another result once there was room"
    return {"work": trial.name, "file": "", "noticed": "error" in answer, "fault": fault}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("works", nargs="+")
    parser.add_argument("--most", type=int, default=10_000)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--read-only", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    chance = random.Random(args.seed)
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        for name in args.works:
            if args.full or args.read_only:
                trial = Trial(name, Path(place), False, False)
                size = sum(path.stat().st_size for path in trial.place("first").rglob("*") if path.is_file()) // 1024
                least, most = 4, size + 60
                sizes = sorted({least + (most - least) * part // max(args.most - 1, 1) for part in range(args.most)})
                for kib in sizes if args.full else ():
                    print(json.dumps(fill(trial, kib // 4 * 4, Path(place))), flush=True)
                if args.read_only:
                    print(json.dumps(lock(trial, Path(place))), flush=True)
                continue
            damaged = Damaged(name, Path(place))
            wanted = [(path, kind) for path in damaged.files() for kind in KINDS]
            for path, kind in sorted(chance.sample(wanted, min(args.most, len(wanted)))):
                print(json.dumps(damaged.damage(path, kind, chance)), flush=True)


if __name__ == "__main__":
    main()
