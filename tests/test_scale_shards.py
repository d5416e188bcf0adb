"""Parts of a data set: by how many workers it is made changes nothing, and SLURM's variables name the part."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from august_jax import data
from august_jax.app import cli
from august_jax.app.slurm import array_part
from august_jax.config import ConfigError, override, preset

SET = ["data.count=64", "data.shard_rows=8", "target.points=40", "array.nx=4"]
"""Eight shards."""


def simulated(folder, *words):
    assert cli.main(["simulate", "--preset", "smoke", "--out", str(folder), "--json", *words, *SET]) == 0


def array(task, count, low=0, step=1):
    """SLURM's variables in a task of an array."""
    return {
        "SLURM_ARRAY_TASK_ID": str(task),
        "SLURM_ARRAY_TASK_COUNT": str(count),
        "SLURM_ARRAY_TASK_MIN": str(low),
        "SLURM_ARRAY_TASK_MAX": str(low + step * (count - 1)),
        "SLURM_ARRAY_TASK_STEP": str(step),
    }


def test_one_four_and_eight_workers_make_the_same(tmp_path, monkeypatch, capsys):
    simulated(tmp_path / "one")
    whole = json.loads(capsys.readouterr().out)
    assert whole["rows"] == 64 and whole["shard"] == [1, 1]
    wanted = data.content_sum(tmp_path / "one")
    assert whole["content"] == wanted and len(wanted) == 64

    for task in (3, 1, 4, 2):  # an array whose numbers begin at 1, in one folder, in any order
        for name, value in array(task, 4, low=1).items():
            monkeypatch.setenv(name, value)
        simulated(tmp_path / "four")
        captured = capsys.readouterr()
        told = json.loads(captured.out)
        assert told["shard"] == [task, 4] and f"task {task} of a SLURM array of 4: --shard {task}/4" in captured.err
    assert told["rows"] == 64 and told["content"] == wanted

    for number in range(1, 9):  # in folders of their own; what is told by hand goes before what SLURM says
        simulated(tmp_path / f"part{number}", "--shard", f"{number}/8")
        assert json.loads(capsys.readouterr().out)["shard"] == [number, 8]
        for shard in (tmp_path / f"part{number}").glob("shard-*"):
            shutil.copytree(shard, tmp_path / "eight" / shard.name)
    for name in array(1, 4):
        monkeypatch.delenv(name)
    simulated(tmp_path / "eight", "--verify")
    merged = json.loads(capsys.readouterr().out)
    assert (merged["written"], merged["rows"], merged["content"]) == (0, 64, wanted)
    assert len({(tmp_path / name / "manifest.json").read_bytes() for name in ("one", "four", "eight")}) == 1


_FEW_FILES = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (200, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
import numpy as np
from august_jax.data import Dataset
dataset = Dataset(sys.argv[1])
print(dataset.count, len(dataset.flights), *dataset.read(np.arange(0, 64, 3)).slot)
"""


def test_more_shards_than_files_may_be_open_are_read_in_turn(tmp_path):
    """Of 200 files a process keeps 16 shards of nine columns open."""
    pytest.importorskip("resource")
    config = override(preset("smoke"), [*SET, "data.solver=born", "data.shard_rows=1"])
    data.simulate(config, tmp_path)
    run = subprocess.run(
        [sys.executable, "-c", _FEW_FILES, str(tmp_path)], capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode == 0, run.stderr
    slots = np.arange(0, 64, 3) % config.flight.slots
    assert [int(word) for word in run.stdout.split()] == [64, 64, *slots]


def test_a_hash_of_the_content_tells_one_changed_number(tmp_path):
    config = override(preset("smoke"), [*SET, "data.solver=born", "data.count=8"])
    data.simulate(config, tmp_path)
    before = data.content_sum(tmp_path)
    other = override(config, ["data.seed=7"])
    data.simulate(other, tmp_path / "other")
    assert data.content_sum(tmp_path / "other") != before
    with pytest.raises(data.DataError, match="no manifest"):
        data.content_sum(tmp_path / "nothing")


@pytest.mark.parametrize(
    "variables, part",
    [
        ({}, None),
        ({"SLURM_JOB_ID": "7"}, None),
        (array(0, 8), (1, 8)),
        (array(7, 8), (8, 8)),
        (array(8, 8, low=1), (8, 8)),
        (array(12, 4, low=8, step=2), (3, 4)),
        (array(5, 1, low=5), (1, 1)),
        ({**array(2, 4), "SLURM_ARRAY_TASK_STEP": ""}, (3, 4)),
    ],
)
def test_the_part_of_a_task(variables, part):
    assert array_part(variables) == part


@pytest.mark.parametrize(
    "change, message",
    [
        ({"SLURM_ARRAY_TASK_COUNT": ""}, "SLURM_ARRAY_TASK_COUNT: '' is no number, but SLURM_ARRAY_TASK_ID is '3'"),
        ({"SLURM_ARRAY_TASK_MAX": "x"}, "SLURM_ARRAY_TASK_MAX: 'x' is no number"),
        ({"SLURM_ARRAY_TASK_MAX": "7"}, "SLURM: an array with gaps .*--array=1-4, or say .* --shard I/N"),
        ({"SLURM_ARRAY_TASK_ID": "9"}, "SLURM: a task that is not in its array"),
        ({"SLURM_ARRAY_TASK_MIN": "2", "SLURM_ARRAY_TASK_MAX": "8", "SLURM_ARRAY_TASK_STEP": "2"}, "not in its array"),
    ],
)
def test_arrays_that_name_no_part_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        array_part({**array(3, 4), **change})


def test_all_parts_of_any_array_are_there_once():
    rng = np.random.default_rng(0)
    for count, low, step in rng.integers([1, 0, 1], [40, 9, 5], (20, 3)).tolist():
        tasks = range(low, low + step * count, step)
        parts = [array_part(array(task, count, low, step)) for task in tasks]
        assert parts == [(number, count) for number in range(1, count + 1)]


@pytest.mark.slow
def test_two_processes_at_once_in_one_folder_make_the_same(tmp_path, capsys):
    simulated(tmp_path / "one")
    wanted = json.loads(capsys.readouterr().out)["content"]
    words = [
        sys.executable,
        "-m",
        "august_jax.app.cli",
        "simulate",
        "--preset",
        "smoke",
        "--out",
        tmp_path / "both",
        *SET,
    ]
    parts = [subprocess.Popen([*words, "--shard", f"{number}/2"]) for number in (1, 2)]
    assert [part.wait() for part in parts] == [0, 0]
    assert data.content_sum(tmp_path / "both") == wanted
