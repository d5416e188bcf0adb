"""Benchmarks: a folder that is not there is told at once, and the smallest parts give figures with small errors."""

from __future__ import annotations

import json

import pytest
import scripts

from august_jax.signal import ESTIMATORS

BENCHMARKS = scripts.defining("benchmarks", "main")
SMALL = ("--cells", "150", "--distance", "5", "--batch", "4", "--repeats", "1")
MACHINE = {"processor", "cores", "device", "jax", "python", "gflop_s"}


def figures(name, *arguments, folder, monkeypatch):
    """What a benchmark writes."""
    scripts.run("benchmarks", name, *arguments, "--json", str(folder / "figures.json"), monkeypatch=monkeypatch)
    written = json.loads((folder / "figures.json").read_text())
    assert set(written["machine"]) == MACHINE and written["machine"]["gflop_s"] > 0.0
    return written


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_folder_that_is_not_there_is_told_before_anything_is_measured(name, tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        scripts.run("benchmarks", name, "--json", str(tmp_path / "none" / "x.json"), monkeypatch=monkeypatch)
    told = capsys.readouterr()
    assert ended.value.code == 2 and f"--json: {tmp_path / 'none'} is no folder" in told.err and not told.out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:cells.volumes")  # cells as large as these are for tests alone
def test_rigid_and_moving_agree_with_the_system_solved_in_double_precision(tmp_path, monkeypatch):
    parts = ("--parts", "rigid", "moving")
    written = figures("simulator", *parts, *SMALL, folder=tmp_path, monkeypatch=monkeypatch)
    [rigid], [moving] = written["rigid"], written["moving"]
    assert {"cells", "distance_m", "batch", "modes", "factoring_or_cache_s", "factored_gflop_s"} <= set(rigid)
    assert rigid["cells"] == moving["cells"] <= 150
    for other in ("dense", "scipy"):
        assert rigid[f"{other}_over_factored"] == pytest.approx(rigid[f"{other}_s"] / rigid["factored_s"])
    # single precision: 1e-5 for the factored body, 1e-4 where positions of 5 m lose digits in phases
    assert rigid["factored_error"] < 1e-4 and rigid["dense_error"] < 2e-4
    for solver in ("krylov", "mom"):
        assert moving[f"{solver}_error"] < 1e-4 and moving[f"{solver}_gradient_error"] < 1e-3
        ratio = moving[f"{solver}_gradient_s"] / moving[f"{solver}_value_s"]
        assert moving[f"{solver}_gradient_over_value"] == pytest.approx(ratio)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_scaling_and_set_time_every_size(tmp_path, monkeypatch):
    parts = ("--parts", "scaling", "set", "tables", "--sweep", "60", "120", "--preset", "smoke", "--count", "40")
    written = figures("simulator", *parts, *SMALL, folder=tmp_path, monkeypatch=monkeypatch)
    swept = {
        name: [row["size"] for row in written["scaling"] if row["sweep"] == name] for name in ("antennas", "batch")
    }
    assert swept == {"antennas": [16, 32, 64, 128, 256], "batch": [1, 4, 16, 64, 256]}
    assert sum(row["sweep"] == "cells" for row in written["scaling"]) == 2
    assert all(row["factored_s"] > 0.0 for row in written["scaling"])
    [row] = written["set"]
    assert row["count"] == 40 and len(row["cells"]) == 2 and row["channels_s"] > 0.0
    [row] = written["tables"]
    assert row["channels_s"] > 0.0 and all(0.0 < low < high < 0.1 for low, high in row["errors"])


@pytest.mark.slow
def test_end_to_end_times_imports_and_samples(tmp_path, monkeypatch):
    arguments = ("--preset", "smoke", "--count", "32", "--repeats", "1")
    written = figures("end_to_end", *arguments, folder=tmp_path, monkeypatch=monkeypatch)
    assert 0.0 < written["import jax"] and 0.0 < written["import august_jax"] and 0.0 < written["august --help"]
    assert written["simulate"]["written"] == 32 and written["simulate"]["samples_per_s"] > 0.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_training_times_a_stream_against_a_data_set(tmp_path, monkeypatch):
    arguments = ("--parts", "stream", "--preset", "smoke", "--steps", "2", "--repeats", "1")
    written = figures("training", *arguments, folder=tmp_path, monkeypatch=monkeypatch)
    rates = [written[name]["samples_per_s"] for name in ("stream", "stored")]
    assert min(rates) > 0.0 and written["stream_over_stored"] == pytest.approx(rates[0] / rates[1])
    assert min(written["batch_s"].values()) > 0.0


@pytest.mark.slow
def test_training_times_the_station_by_estimator_and_least_squares_both_ways(tmp_path, monkeypatch):
    before = dict(ESTIMATORS)
    arguments = ("--parts", "observe", "--preset", "smoke", "--repeats", "1")
    written = figures("training", *arguments, folder=tmp_path, monkeypatch=monkeypatch)["observe"]
    assert set(written["batch_s"]) == {*ESTIMATORS, "svd"} and min(written["batch_s"].values()) > 0.0
    assert 0.0 < max(written["apart"]) < 1e-4  # two ways, one answer
    assert before == ESTIMATORS


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_inference_tells_an_error_beside_every_speed_and_draws_its_tables_again(tmp_path, monkeypatch, capsys):
    parts = ("--parts", "slots", "screen", "tables", "routes")
    written = figures("inference", "--small", *parts, folder=tmp_path, monkeypatch=monkeypatch)
    rows = {row["route"]: row for row in written["routes"]}
    ours = {"LU", "body", "table", "table, coefficients", "local", "local, 8 derivatives", "survey"}
    assert ours <= set(rows) <= ours | {"torchgdm"}
    for name in ours:
        row = rows[name]
        assert 0.0 < row["error_median"] <= row["error_most"] < (1e-3 if name in ("LU", "body") else 3e-2)
        assert row["LU_over_it"] == pytest.approx(rows["LU"]["seconds"] / row["seconds"])
    assert max(rows["local, 8 derivatives"]["derivative_errors"].values()) < 0.15
    [later] = written["slots"]["later"]
    assert later["slots"] == 2 and 0.0 < later["error_m"] < 2.0
    # the stages are all that a slot takes
    assert sum(each["median"] for each in later["stages_s"].values()) <= 1.05 * later["wall_s"]["most"]
    assert written["screen"]["poses_per_s"] > 0.0 and written["memory"]["peak_rss_mb"] > 100.0
    tables = written["tables"]
    assert 0.0 < tables["disk_mb"] < tables["memory_mb"] < tables["library_mb"]
    capsys.readouterr()
    scripts.run("benchmarks", "inference", "--draw", str(tmp_path / "figures.json"), monkeypatch=monkeypatch)
    drawn = capsys.readouterr().out
    assert all(f"| {name} |" in drawn for name in ours) and "The first look" in drawn


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_inference_searches_with_fewer_craft_other_attitudes_and_more_tones(tmp_path, monkeypatch):
    parts = ("--parts", "craft", "candidates", "tones")
    written = figures("inference", "--small", *parts, folder=tmp_path, monkeypatch=monkeypatch)
    one, two = written["craft"]
    assert two["poses"] == 2 * one["poses"] and one["craft_right"] == 1.0
    assert written["candidates"][0]["poses"] < written["candidates"][1]["poses"]
    single, several = written["tones"]
    assert (single["tones"], several["tones"]) == (1, 2)
    assert several["table_mb"] > 1.5 * single["table_mb"]


@pytest.mark.slow
def test_steps_of_the_peer_in_pytorch_are_the_same_steps(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    arguments = ("--parts", "torch", "--preset", "smoke", "--steps", "2", "--repeats", "1")
    torch = figures("training", *arguments, folder=tmp_path, monkeypatch=monkeypatch)["torch"]
    assert torch["loss_error"] < 1e-5 and torch["gradient_error"] < 1e-4
    assert torch["torch_over_jax"] == pytest.approx(torch["step_s"]["torch"] / torch["step_s"]["jax"])


@pytest.mark.slow
def test_reconstruction_tells_time_beside_the_distance_to_the_truth(tmp_path, monkeypatch):
    arguments = ("--count", "4", "--batch", "2", "--repeats", "1")
    rows = figures("reconstruction", *arguments, folder=tmp_path, monkeypatch=monkeypatch)["rows"]
    assert [row["sampler"] for row in rows] == ["ancestral, 200", "dpm, 5", "dpm, 10", "dpm, 20"]
    assert rows[0]["chamfer_ratio"] == rows[0]["one_faster"] == 1.0
    assert all(row["one_s"] > 0.0 and row["clouds_per_s"] > 0.0 and -60.0 < row["mcd_db"] < 0.0 for row in rows)
    assert rows[1]["many_faster"] > rows[3]["many_faster"] > 1.0
