"""The commands themselves, killed at random and started again: the same data, the same networks, hash for hash."""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from august_jax.data.shards import read_meta
from august_jax.files import read_npz

pytestmark = pytest.mark.slow
CLOCK = ("samples_per_s", "seconds_left")
KILLS = 4
"""Of each command."""


def start(words: list[str], folder: Path) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "august_jax.app.cli", *words],
        cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def to_the_end(words: list[str], folder: Path) -> float:
    began = time.monotonic()
    process = start(words, folder)
    _, told = process.communicate()
    assert process.returncode == 0, told
    return time.monotonic() - began


def killed(words: list[str], folder: Path, seconds: float) -> bool:
    process = start(words, folder)
    try:
        process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    return process.returncode == -signal.SIGKILL


def content(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def trained(folder: Path) -> tuple[list, dict]:
    """What a run leaves, but for what the clock says and the pictures and names in which it goes."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    logged = [{name: value for name, value in line.items() if name not in CLOCK} for line in lines]
    return logged, {name: value.tobytes() for name, value in read_npz(folder / "weights.npz").items()}


def test_commands_killed_at_any_time_end_in_the_same_files(tmp_path):
    chance = random.Random(0)
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    simulate = "simulate --preset smoke data.count=160 data.shard_rows=20 --out".split()
    train = "train --preset smoke --data data train.steps=60 train.save_every=10 train.log_every=5 --out".split()
    for folder in (whole, stopped):
        folder.mkdir()
    for words, out in ((simulate, "data"), (train, "run")):
        to_the_end([*words, out], whole)  # once, so that bodies and programs are kept
        took = to_the_end([*words, f"{out}_again"], whole)
        ended = tries = 0
        while ended < KILLS:
            tries += 1
            assert tries <= 10 * KILLS, f"{ended} of {tries} moments fell into the command"
            before = {shard.name: read_meta(shard) for shard in (stopped / "data").glob("shard-*")}
            if killed([*words, out], stopped, chance.uniform(0.3, 1.0) * took):
                ended += 1
                for name, meta in before.items():  # what was whole is not touched again
                    assert meta is not None and read_meta(stopped / "data" / name) == meta
            else:  # it was done before, as what goes on is: from the beginning
                shutil.rmtree(stopped / out)
        to_the_end([*words, out], stopped)
    assert content(whole / "data") == content(whole / "data_again")
    assert content(stopped / "data") == content(whole / "data")
    logged, weights = trained(stopped / "run")
    wanted, arrays = trained(whole / "run")
    assert [line["step"] for line in logged] == [line["step"] for line in wanted]
    assert logged == wanted
    assert weights == arrays
    assert not [path for path in stopped.rglob(".*") if path.is_file()]
    assert np.all([os.path.getsize(path) for path in stopped.rglob("*.npy")])
