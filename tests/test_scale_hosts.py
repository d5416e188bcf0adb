"""Two hosts that train as one: two processes on 127.0.0.1, and what each says and writes."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_training import CONFIG  # noqa: F401  (the hosts import it: a fault of it shows here)
from two_hosts import RUN, STREAM, batch_of

from august_jax import hosts
from august_jax.app import cli
from august_jax.config import override
from august_jax.data import StreamedBatches, prepare_targets
from august_jax.training import train

HERE = Path(__file__).parent
PATIENCE_S = 240
"""A host that hangs is a failure, not a hang; quiet, two take fifteen seconds."""


def started(what, folder):
    """Two hosts at work."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    env = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    return [
        subprocess.Popen(
            [sys.executable, str(HERE / "two_hosts.py"), str(place), str(port), str(folder), what],
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for place in (1, 2)
    ]


def both(what, folder):
    """What two hosts printed last, as JSON."""
    hosts = started(what, folder)
    try:
        told = [host.communicate(timeout=PATIENCE_S) for host in hosts]
    finally:
        for host in hosts:
            host.kill()
    for (out, err), host in zip(told, hosts):
        assert host.returncode == 0, out[-2000:] + err[-3000:]
    return [json.loads(out.splitlines()[-1]) for out, _ in told]


def test_two_hosts_train_as_one(tmp_path):
    first, second = both("trained", tmp_path / "run")
    assert first["devices"] == second["devices"] == 2
    assert "continuing from step 4 of 8" in first["said"] and second["said"] == ["cut"]
    assert first["loss"] == second["loss"]
    logged = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    train(RUN, batch_of, tmp_path / "alone")
    alone = [json.loads(line) for line in (tmp_path / "alone" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in logged] == [line["step"] for line in alone] == list(range(1, 9))
    assert [line["loss"] for line in logged] == pytest.approx([line["loss"] for line in alone], rel=1e-5)
    assert (tmp_path / "run" / "weights.npz").exists()
    # what two left, one goes on with
    said = []
    train(RUN, batch_of, tmp_path / "run", progress=said.append)
    assert said[0] == "continuing from step 8 of 8"


def test_each_host_places_its_own_rows(tmp_path):
    assert both("own_parts", tmp_path) == [[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0]]


@pytest.mark.parametrize(
    "what, messages",
    [
        ("differs", ["config: hosts were given different ones; start the same command on every host"] * 2),
        ("occupied", ["is being written by process", "host: 1 of 2 gave up, and says why"]),
    ],
)
def test_where_one_host_cannot_begin_neither_does(what, messages, tmp_path):
    for told, message in zip(both(what, tmp_path), messages):
        assert message in told["refused"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_each_host_makes_its_own_rows_of_a_stream(tmp_path):
    whole = StreamedBatches(STREAM, prepare_targets(override(STREAM, ["data.solver=table"])))(3)
    parts = both("streamed", tmp_path)  # whose tables are in the cache now
    for name in ("cloud", "predicted"):
        rows = np.concatenate([part[name] for part in parts])
        assert [len(part[name]) for part in parts] == [4, 4]
        np.testing.assert_allclose(rows, getattr(whole, name), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_host_that_dies_ends_the_other_and_the_run_goes_on(tmp_path):
    first, second = started("dies", tmp_path / "run")
    try:
        second.communicate(timeout=PATIENCE_S)
        began = time.monotonic()
        first.communicate(timeout=PATIENCE_S)
        waited = time.monotonic() - began
    finally:
        first.kill()
        second.kill()
    assert second.returncode == 9 and first.returncode != 0 and waited < 150.0
    said = []
    train(RUN, batch_of, tmp_path / "run", progress=said.append)
    assert said[0] == "continuing from step 4 of 8"
    print(f"the other host ended after {waited:.0f} s")


@pytest.mark.parametrize(
    "coordinator, host, message",
    [
        ("10.0.0.1", (1, 2), "coordinator: got '10.0.0.1'; give ADDRESS:PORT"),
        ("10.0.0.1:http", (1, 2), "coordinator: got '10.0.0.1:http'"),
        ("10.0.0.1:70000", (1, 2), "coordinator: got '10.0.0.1:70000'"),
        ("10.0.0.1:7654", (3, 2), "host: got 3/2; give i/n with 1 <= i <= n"),
    ],
)
def test_a_place_that_is_none_is_refused(coordinator, host, message):
    with pytest.raises(ValueError, match=message):
        hosts.join(coordinator, host)


@pytest.mark.parametrize(
    "words, message",
    [
        (["--host", "1/2"], "--coordinator: is missing; several hosts need --host I/N"),
        (["--coordinator", "10.0.0.1:7654"], "--host: is missing"),
        (["--host", "1/2", "--coordinator", "here"], "--coordinator: got 'here'; give ADDRESS:PORT"),
        (["--host", "3/2", "--coordinator", "10.0.0.1:7654"], "'3/2' is not of the form i/n"),
        (["--devices", "4096"], "--devices: 4096, but JAX sees"),
        (["--dry-run", "--host", "1/2", "--coordinator", "10.0.0.1:7654"], "--host: a dry run is of one host"),
    ],
)
def test_what_the_command_line_refuses(words, message, capsys):
    assert cli.main(["train", "--preset", "smoke", *words]) == 2
    assert message in capsys.readouterr().err
