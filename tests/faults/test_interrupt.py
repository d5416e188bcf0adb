"""Ctrl-C at any time of a command: status 130 at once, no traceback, and folders that the next run goes on with."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time

import pytest

COMMANDS = {
    "simulate": "simulate --preset smoke data.count=60 data.shard_rows=20 --out data",
    "train": "train --preset smoke train.source=stream data.solver=table --out run",
    "demo": "demo --slots 4 --search 0 --out demo",
}
AT_ONCE_S = 3.0
"""For a machine at work on other things; alone it takes a tenth of a second."""


@contextlib.contextmanager
def begun(words, folder):
    """A command whose line is there: Python's own start, before it, is left alone."""
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "AUGUST_CHECK_TYPES": "0"}
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "import august_jax.app.cli as cli; print('here', file=sys.stderr, flush=True); sys.exit(cli.main())"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, *words.split()], cwd=folder, env=environment, stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL, text=True,
    ) as process:  # fmt: skip
        assert process.stderr.readline() == "here\n"
        yield process


def interrupted(words, folder, seconds):
    """Status, stderr, and how long the end took, of a command that is interrupted after so long."""
    with begun(words, folder) as process:
        time.sleep(seconds)
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()
        status = process.wait(600)
        return status, told, time.monotonic() - began


def check(name, folder, seconds):
    status, told, took = interrupted(COMMANDS[name], folder, seconds)
    if status in (0, -signal.SIGINT):  # it had ended, or Python was on its way out and no longer asks the command
        return False
    assert status == 130, f"{name} after {seconds:.1f} s: status {status}\n{told}"
    assert told.splitlines()[-1] == "august: interrupted; finished files are kept, nothing is half-written"
    assert "Traceback" not in told
    assert took < AT_ONCE_S, f"{name} after {seconds:.1f} s took {took:.1f} s to end"
    assert not [path for path in folder.rglob(".*") if path.name != ".cache"]
    return True


@pytest.mark.parametrize("seconds", [0.3, 2.5])
def test_an_interrupt_ends_a_command_at_once(tmp_path, seconds):
    # a quick machine may have ended by then: it is interrupted earlier
    folders = [tmp_path / str(part) for part in (1, 2, 4)]
    for folder in folders:
        folder.mkdir()
    assert any(check("simulate", folder, seconds / int(folder.name)) for folder in folders)


def length(name, folder):
    """Seconds that a command takes by itself on this machine."""
    with begun(COMMANDS[name], folder) as process:
        began = time.monotonic()
        told = process.stderr.read()
        assert process.wait(600) == 0, told
        return time.monotonic() - began


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_an_interrupt_at_any_time_ends_a_command_at_once(tmp_path, name):
    chance, rounds = random.Random(name), 17
    folders = [tmp_path / str(part) for part in range(rounds + 2)]
    for folder in folders:
        folder.mkdir()
    length(name, folders[0])  # compiles what the others find in the cache
    whole, hit, used = length(name, folders[1]), 0, 2
    for _ in range(rounds):
        caught = check(name, folders[used], chance.uniform(0.1, whole))
        hit += caught
        used += not caught  # what has ended once ends at once: it begins anew in a folder of its own
    assert hit >= 8
