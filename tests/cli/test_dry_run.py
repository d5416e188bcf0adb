"""A dry run says what a command would do and take, and writes nothing."""

import json

import pytest

from august_jax import memory
from august_jax.app import cli, plan
from august_jax.app.cli.dry import short_of
from august_jax.config import override, preset
from august_jax.data import bytes_of
from august_jax.training import fit


def planned(capsys, *words):
    status = cli.main([*words, "--dry-run", "--json"])
    told = capsys.readouterr()
    assert status == 0, told.err
    found = json.loads(told.out)
    assert found["dry_run"] and found["short_of"] is None
    return found, told.err


def test_a_data_set(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = preset("smoke")
    found, err = planned(capsys, "simulate", "--preset", "smoke", "--shard", "2/2")
    assert (found["rows"], found["rows_here"], found["rows_left"], found["shards_left"]) == (64, 0, 32, 1)
    assert found["disk_bytes"] == bytes_of(config, 32) and found["seconds"] > 0.0
    assert err.splitlines()[-1] == "next:  august simulate --preset smoke --shard 2/2"
    assert not list(tmp_path.iterdir())


def test_by_table_and_of_fewer_antennas_it_is_faster():
    laptop = preset("laptop")
    seconds = [
        plan.simulation(override(laptop, changes), plan.Path("nowhere"))["seconds"]
        for changes in ([], ["data.solver=table"], ["array.nx=8"], ["data.count=100000"])
    ]
    assert seconds == pytest.approx([200_000 / 104, 20_000 / 104, 100_000 / 104, 100_000 / 104])


def test_training_is_timed_and_sized_here(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, err = planned(capsys, "train", "--preset", "smoke")
    assert "august simulate --preset smoke --out august_data/smoke" in err
    assert found["steps"] == 20 and found["batch"] == 16 and found["seconds"] > 0.0
    # parameters, their average and Adam's two moments at the least
    assert found["memory_bytes"] > 4 * 4 * found["parameters"] > 0
    assert not list(tmp_path.iterdir())


def test_a_batch_that_does_not_fit_is_answered_with_one_that_does(monkeypatch, tmp_path):
    small = override(preset("smoke"), ["train.steps=1"])
    monkeypatch.setattr(memory, "for_a_program", lambda _: 1 << 40)
    ample = plan.training(small, tmp_path)
    held = ample["available_bytes"] - (1 << 40)  # by the state, which is there already
    monkeypatch.setattr(memory, "for_a_program", lambda _: int(0.96 * ample["memory_bytes"] / fit._SHARE) - held)
    found = plan.training(small, tmp_path)
    assert found["seconds"] is None and 1 <= found["batch_fits"] < 16
    assert f"train.batch={found['batch_fits']} fits" in short_of(found)


def test_an_evaluation(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, err = planned(capsys, "evaluate", "evaluate.count=50", "evaluate.searched=4", "evaluate.snr_db=[10,20]")
    assert (found["samples"], found["searched"], found["snr_db"]) == (50, 8, [10.0, 20.0])
    assert "matched_field" in found["asked"] and "evaluate.searched=0" in err
    found, _ = planned(capsys, "evaluate", "--schemes", "august,prediction")
    assert found["searched"] == 0 and found["search_seconds"] == 0.0
    assert not list(tmp_path.iterdir())


def test_memory_counts_what_is_searched_with_and_what_is_free(monkeypatch, tmp_path):
    laptop, table = preset("laptop"), 240 * 1024**2
    searched, unsearched = (
        plan.evaluation(override(laptop, [f"evaluate.searched={count}"]), 1, None)["memory_bytes"] for count in (20, 0)
    )
    assert searched - unsearched > 5 * table  # of five craft
    by_table, by_mom = (
        plan.simulation(override(laptop, [f"data.solver={name}"]), tmp_path)["memory_bytes"]
        for name in ("table", "mom")
    )
    assert by_table - by_mom == 5 * table
    monkeypatch.setattr(plan, "memory", lambda: memory.Memory(2 * 1024**3, 1024**3))
    told = short_of(plan.evaluation(laptop, 1, None))
    assert "are free" in told and "evaluate.searched=0" in told
    assert short_of(plan.simulation(laptop, tmp_path)) is None


def test_a_predictor_is_not_planned(capsys):
    assert cli.main(["train", "--target", "predictor", "--dry-run"]) == 2
    assert "a minute" in capsys.readouterr().err


def test_too_small_a_disk_is_said():
    assert "make room" in short_of({"disk_bytes": 10**10, "free_bytes": 10**9})
    assert short_of({"disk_bytes": 10**8, "free_bytes": 10**9, "batch_fits": None}) is None
