"""The program as a user meets it: data, training, accuracy, a flight, their own drone, and files for other programs.

One run of the smallest preset serves all tests of this file; what is checked is that each command leaves what it says
and that its numbers hang together. How good the numbers are is not a matter of twenty steps.
"""

import hashlib
import json
import math
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import trimesh
from made_up_posterior import search_is_made_up
from pages import payload

from august_jax.app import cli
from august_jax.app.cli.parser import parse
from august_jax.data import Dataset, channels_along, unpack
from august_jax.scene import procedural_airframe, resolve_airframe
from august_jax.schemes import SCHEMES

SMALL = [
    "target.airframes=[quad_x]",
    "data.count=40",
    "data.shard_rows=20",
    "flight.slots=4",
    "train.steps=4",
    "train.save_every=4",
    "train.log_every=2",
]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with a data set and a training run."""
    home = tmp_path_factory.mktemp("home")
    assert cli.main(["simulate", "--preset", "smoke", "--out", f"{home}/data", *SMALL]) == 0
    assert cli.main(["train", "--data", f"{home}/data", "--out", f"{home}/run", *SMALL[4:]]) == 0
    return home


def call(capsys, *words):
    """The JSON result of a command that works."""
    status = cli.main([*map(str, words), "--json"])
    captured = capsys.readouterr()
    assert status == 0, captured.err
    return json.loads(captured.out)


def refused(capsys, *words):
    status = cli.main([*map(str, words)])
    captured = capsys.readouterr()
    assert status == 2 and len(captured.err.strip().splitlines()) <= 6 and "Traceback" not in captured.err
    return captured.err


def test_simulate_has_nothing_left_to_do(capsys, home):
    result = call(capsys, "simulate", "--preset", "smoke", "--out", home / "data", *SMALL)
    assert (result["rows"], result["written"]) == (40, 0)


def test_a_flight_keeps_off_the_report_of_an_evaluation(capsys, home, tmp_path):
    (tmp_path / "evaluation.json").write_text("{}")
    assert "august evaluate wrote" in refused(capsys, "demo", "--run", home / "run", "--out", tmp_path)


DAMAGES = {
    "a bit": lambda data: flip(data / "shard-00001" / "points.npy"),
    "an end": lambda data: cut(data / "shard-00001" / "points.npy"),
    "a column": lambda data: (data / "shard-00001" / "points.npy").unlink(),
    "a shard": lambda data: shutil.rmtree(data / "shard-00001"),
    "the manifest": lambda data: cut(data / "manifest.json"),
}


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 8
    file.write_bytes(content)


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_data_set_is_whole_again_after_the_command_that_the_message_gives(capsys, home, tmp_path, damage):
    data, out = tmp_path / "my data", tmp_path / "out"
    shutil.copytree(home / "data", data)
    DAMAGES[damage](data)
    words = ["export", data, "--format", "npz", "--index", 29, "--out", out]
    message = refused(capsys, *words)
    advice = message.splitlines()[-1]
    if "remove it" in advice:
        (data / "manifest.json").unlink()
    program, *again = shlex.split(advice.partition("again: ")[2] or advice.partition("missing: ")[2])
    assert program == "august"
    call(capsys, *again)
    call(capsys, *words)
    first, second = (Dataset(folder).read(np.arange(40)) for folder in (home / "data", data))
    for name, column in first.columns().items():
        np.testing.assert_array_equal(second.columns()[name], column)


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_simulate_keeps_off_other_data(capsys, home, dry):
    words = ["simulate", "--preset", "smoke", "--out", home / "data", *SMALL, *dry]
    assert "another configuration" in refused(capsys, *words, "target.skin_m=0.003")
    assert "less than the 40 samples" in refused(capsys, *words, "data.count=20")


def test_a_dry_run_counts_what_is_there(capsys, home):
    words = ["simulate", "--preset", "smoke", "--out", home / "data", *SMALL, "--dry-run"]
    for count, left in ((40, 0), (50, 10)):
        found = call(capsys, *words, f"data.count={count}")
        assert (found["rows"], found["rows_here"], found["rows_left"]) == (count, 40, left)


@pytest.mark.slow
def test_train_needs_no_data_for_a_stream_and_continues(capsys, tmp_path):
    words = ("train", "--preset", "smoke", "--out", tmp_path / "run", "train.source=stream", *SMALL[4:])
    first = call(capsys, *words)
    assert first["metrics"]["step"] == 4 and 0.2 < first["metrics"]["validation_prediction_m"] < 0.8
    longer = [word if word != "train.steps=4" else "train.steps=6" for word in words]
    assert cli.main([*map(str, longer)]) == 0
    told = capsys.readouterr()
    assert "16 new ones in each of 6 steps" in told.err and "continuing from step 4 of 6" in told.err
    assert call(capsys, *longer)["metrics"]["step"] == 6


def test_train_leaves_a_run(home):
    names = {path.name for path in (home / "run").iterdir()}
    assert {"weights.npz", "config.yaml", "metrics.jsonl", "curves.png", "report.html"} <= names
    lines = [json.loads(line) for line in (home / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4]
    assert all(math.isfinite(value) for line in lines for value in line.values())
    # the ninth of ten flights is for validation; its predictions miss by less than the cube's half diagonal
    assert 0.0 < lines[-1]["validation_prediction_m"] < 0.5 * math.sqrt(3.0)
    page = payload((home / "run" / "report.html").read_text(encoding="utf-8"))
    assert page["lines"] == lines and page["steps"] == 4 and str(home / "data") in page["lead"]
    assert page["configuration"] in (home / "run" / "config.yaml").read_text()
    (again, _), (following, _) = page["repeat"][0], page["next"][0]
    assert shlex.split(again)[:2] == ["august", "train"] and str(home / "run") in shlex.split(again)
    assert shlex.split(following) == ["august", "evaluate", str(home / "run"), "--seed", "1"]


def test_commands_keep_off_each_other_s_folders(capsys, home, flown):
    for words, folder, owner in (
        (["simulate", "--preset", "smoke"], home / "run", "august train"),
        (["train", "--data", home / "data"], home / "data", "august simulate"),
        (["train", "--data", home / "data"], flown, "august demo"),
        (["demo", "--run", home / "run"], home / "run", "august train"),
        (["evaluate", home / "run"], home / "run", "august train"),
        (["evaluate", home / "run"], flown, "august demo"),
    ):
        before = (folder / "config.yaml").read_bytes()
        message = refused(capsys, *words, "--out", folder)
        assert str(folder) in message and owner in message
        assert (folder / "config.yaml").read_bytes() == before


@pytest.mark.parametrize(
    "extra, wanted",
    [
        (["--preset", "laptop"], ["preset: 'laptop'", "'smoke'"]),
        (["array.nx=8"], ["array.nx: 8", "made with 4"]),
        (["data.seed=3"], ["data.seed: 3", "made with 0"]),
        (["train.batch=64"], ["train.batch", "64"]),
        (["data.count=80"], ["data.count: 80", "made with 40"]),
        (["train.weight_position=-1"], ["train.weight_position", "0 to"]),
        (["model.scheme=noebt"], ["model.scheme: unknown value 'noebt'", "did you mean 'noebd'"]),
        (["--init", "nowhere"], ["nowhere/config.yaml", "august train"]),
    ],
)
def test_train_wants_what_the_data_are(capsys, home, tmp_path, extra, wanted):
    message = refused(capsys, "train", "--data", home / "data", "--out", tmp_path / "run", *extra)
    assert all(text in message for text in wanted)
    assert not (tmp_path / "run").exists()


def test_evaluate_rows(capsys, home, monkeypatch, unchecked):
    search_is_made_up(monkeypatch)
    result = call(
        capsys,
        "evaluate",
        home / "run",
        "--seed",
        5,
        "--out",
        home / "evaluation",
        "evaluate.count=4",
        "evaluate.snr_db=[20]",
        "evaluate.searched=2",
    )
    rows = {row["scheme"]: row for row in result["rows"]}
    assert list(rows) == list(SCHEMES)
    defined = {
        scheme: {name for name in ("mpe_m", "mde", "wd_db", "mcd_db") if row[name] is not None}
        for scheme, row in rows.items()
    }
    assert defined["prediction"] == defined["polar"] == defined["polar_angles"] == {"mpe_m"}
    assert defined["up"] == {"mde"} and defined["mean_shape"] == {"wd_db", "mcd_db"}
    assert len(defined["august"]) == len(defined["matched_field"]) == len(defined["resampling"]) == 4
    for name, row in rows.items():
        assert (row["snr_db"], row["count"]) == (20.0, 2 if name == "matched_field" else 4)
        assert (row["explained"] is None) == (row["craft_accuracy"] is None) == (name != "matched_field")
        assert 0.0 < row["bound_m"] < 0.5 and 0.0 < row["bound_mde"] < 0.25
        assert (row["expected_mpe_m"] is None) == (row["expected_mde"] is None) == (name != "matched_field")
        assert (row["own_bound_m"] == row["bound_m"]) == (row["count"] == 4)
    assert [(each["scheme"], each["of"]) for each in result["thresholds"]] == [
        ("matched_field", "position"),
        ("matched_field", "normal"),
    ]
    # the floor lies below what knows only the prediction; the prediction misses by at most the cube's half diagonal
    assert rows["resampling"]["wd_db"] < rows["mean_shape"]["wd_db"]
    assert rows["resampling"]["mpe_m"] < rows["prediction"]["mpe_m"] < 0.5 * math.sqrt(3.0)
    assert json.loads((home / "evaluation" / "evaluation.json").read_text())["rows"] == result["rows"]
    assert (home / "evaluation" / "evaluation.png").is_file()
    page = payload((home / "evaluation" / "report.html").read_text(encoding="utf-8"))
    assert page["rows"] == result["rows"] and page["thresholds"] == result["thresholds"]
    (again, _), (following, _) = page["repeat"][0], page["next"][0]
    assert again == result["command_line"]
    # what is to be tried next is of the same run, and leaves out what is of evaluations alone
    assert shlex.split(following) == ["august", "demo", "--seed", "5", "--run", str(home / "run")]


@pytest.mark.slow
def test_another_of_the_compared_networks_trains_and_stands_beside(capsys, home):
    """By one override on the same data; its reference channels are made by table on the way."""
    other = home / "reference"
    call(capsys, "train", "--data", home / "data", "--out", other, "model.scheme=refchannel", *SMALL[4:])
    logged = json.loads((other / "metrics.jsonl").read_text().splitlines()[-1])
    assert 0.0 < logged["reference"] < 100.0
    few = ["evaluate.count=4", "evaluate.snr_db=[20]", "--schemes", "prediction,august", "--out", home / "compared"]
    result = call(capsys, "evaluate", home / "run", other, *few)
    assert [row["scheme"] for row in result["rows"]] == ["august_roi", "refchannel_roi", "prediction"]
    assert result["weights"] == {"august_roi": str(home / "run"), "refchannel_roi": str(other)}
    assert len({row["mpe_m"] for row in result["rows"]}) == 3
    assert (home / "compared" / "evaluation.png").is_file()
    page = payload((home / "compared" / "report.html").read_text(encoding="utf-8"))
    assert [["august_roi", str(home / "run")], ["refchannel_roi", str(other)]] == page["setup"][1:3]


def test_weights_refuse_another_configuration(capsys, home):
    assert "model.latent: 4" in refused(capsys, "evaluate", home / "run", "model.latent=4")
    assert "'smoke'" in refused(capsys, "evaluate", home / "run", "--preset", "laptop")


def test_weights_that_are_not_finite_are_refused_at_once(capsys, home, tmp_path):
    shutil.copytree(home / "run", tmp_path / "run", ignore=shutil.ignore_patterns("checkpoints"))
    with np.load(tmp_path / "run" / "weights.npz") as stored:
        arrays = dict(stored)
    name = next(iter(arrays))
    arrays[name].flat[0] = np.nan
    np.savez(tmp_path / "run" / "weights.npz", **arrays)
    message = refused(capsys, "demo", "--run", tmp_path / "run", "--out", tmp_path / "out")
    assert name in message and "NaN" in message and not (tmp_path / "out").exists()


FILES = {"report.html", "cloud.ply", "clouds.npz", "metrics.json", "config.yaml"}


@pytest.fixture(scope="module")
def flown(home):
    assert cli.main(["demo", "--run", f"{home}/run", "--slots", "3", "--search", "0", "--out", f"{home}/demo"]) == 0
    return home / "demo"


def test_demo_leaves_a_report_and_numbers_that_agree(flown):
    assert {path.name for path in flown.iterdir()} == FILES | {"demo.png"}
    found = json.loads((flown / "metrics.json").read_text())
    assert len(found["slots"]) == 3
    schemes = {row["scheme"]: row for row in found["schemes"]}
    # a mean over slots in float32 against the same in float64
    for scheme, error in (("august", "position_error_m"), ("prediction", "predicted_error_m")):
        assert schemes[scheme]["mpe_m"] == pytest.approx(np.mean([slot[error] for slot in found["slots"]]), rel=1e-4)
    with np.load(flown / "clouds.npz") as track:
        np.testing.assert_allclose(track["points"].mean(axis=1), [s["estimate"] for s in found["slots"]], atol=1e-5)
        # the first prediction is drawn within the threshold, as the report says
        assert np.abs(track["predicted"][0] - track["position"][0]).max() <= 0.5 + 1e-5


def test_a_demo_that_searches_tells_what_it_found(capsys, home, tmp_path, monkeypatch, unchecked):
    search_is_made_up(monkeypatch)
    words = [
        "demo",
        "--run",
        home / "run",
        "--slots",
        3,
        "--search",
        2,
        "--airframe",
        "hexa",
        "--out",
        tmp_path / "demo",
    ]
    result = call(capsys, *words)
    rows = {row["scheme"]: row for row in result["schemes"]}
    assert (rows["matched_field"]["count"], rows["august"]["count"]) == (2, 3)
    first, between, last = (slot["search"] for slot in result["slots"])
    # the run knows a quad_x alone: what flies is added to the library, and named there by the made-up posterior; two
    # known drones are what a demo compares with
    assert between is None and first["craft"] == last["craft"] == "hexa"
    assert set(first["craft_probability"]) == {"quad_x", "hexa"} and rows["matched_field"]["craft_accuracy"] == 1.0
    assert 0.0 < result["bound"]["bound_m"] < 0.5 and 0.0 < result["bound"]["bound_mde"] < 0.25
    assert "known drones" in (tmp_path / "demo" / "report.html").read_text()


def test_what_cannot_be_searched_for_is_said_before_anything_is_sensed(capsys, home, tmp_path, monkeypatch):
    from august_jax import pipeline

    sensed = []

    def sense(*_, **__):
        sensed.append(True)
        raise ValueError("sensed")

    monkeypatch.setattr(pipeline, "sense", sense)
    for name, craft in (("one", "quad_x"), ("two", "octo")):
        (tmp_path / name).mkdir()
        procedural_airframe(craft, 0.25).mesh.export(tmp_path / name / "model.stl")
    alike = f'target.airframes=["{tmp_path}/one/model.stl","{tmp_path}/two/model.stl"]'
    words = ["demo", "--run", home / "run", "--search", 1, "--out", tmp_path / "out"]
    message = refused(capsys, *words, alike)
    assert "two of the known craft are called 'model'" in " ".join(message.split()) and not sensed
    message = refused(capsys, *words, "data.solver=born")
    assert "no search: data.solver=born makes no bodies" in message and sensed and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_networks_follow_a_flight_in_the_smallest_region_that_is_large_enough(capsys, home, tmp_path):
    """Of two, told by their configurations: the filter asks for 0.61 m on agile flights."""
    for name, threshold in (("wide", 0.8), ("wider", 1.1)):
        shutil.copytree(home / "run", tmp_path / name, ignore=shutil.ignore_patterns("checkpoints"))
        text = (tmp_path / name / "config.yaml").read_text().partition("\n")[2]  # without its check sum: it is edited
        text = text.replace("scale_m: 0.75", f"scale_m: {0.25 + threshold}")
        (tmp_path / name / "config.yaml").write_text(text.replace("threshold_m: 0.5", f"threshold_m: {threshold}"))
    shutil.copytree(tmp_path / "wide", tmp_path / "slower")
    text = (tmp_path / "wide" / "config.yaml").read_text().replace("slot_s: 0.2", "slot_s: 0.4")
    (tmp_path / "slower" / "config.yaml").write_text(text)
    words = ["track", "--scheme", "august", "--predictor", "kalman", "--slots", 5, "--out", tmp_path / "out"]
    told = refused(capsys, *words, "--run", home / "run", "--run", tmp_path / "slower")
    assert "--run: were trained for different flights (slots of 0.2 s, dynamic; slots of 0.4 s" in " ".join(
        told.split()
    )
    runs = [word for run in (tmp_path / "wider", home / "run", tmp_path / "wide") for word in ("--run", run)]
    result = call(capsys, *words, *runs, "--style", "dynamic")
    assert result["weights"] == str(tmp_path / "wide") and result["predictor"] == "kalman"
    region = result["region"]
    assert (region["threshold_m"], region["enough"], region["compared"]) == (0.8, True, 3)
    assert 0.5 < region["needed_m"] < 0.8
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"track.png"}
    rows = {row["scheme"]: row for row in result["schemes"]}
    assert {"august", "prediction", "up", "mean_shape", "resampling"} <= set(rows)
    assert rows["august"]["wd_db"] is not None
    first, last = result["summary"]
    assert first["lost"] == sum(slot["lost"] for slot in result["slots"]) and last["slots"] == [3, 4]
    assert [slot["detected"] for slot in result["slots"][:3]] == [True] * 3
    for slot in result["slots"]:
        assert (slot["threshold_m"] is None) == slot["detected"]


def test_a_point_is_followed_without_networks(capsys, tmp_path):
    """The same numbers of a slot, null where a point has nothing to say; a flight of few antennas may be lost."""
    words = ["track", "--scheme", "polar", "--preset", "smoke", "--airframe", "quad_x", "--slots", 5, "--out", tmp_path]
    result = call(capsys, *words)
    assert result["predictor"] == "lstm" and result["weights"] is None
    assert [row["scheme"] for row in result["schemes"]][:2] == ["polar", "prediction"]
    assert result["schemes"][0]["mpe_m"] > 0.0 and result["schemes"][0]["wd_db"] is None
    for slot in result["slots"]:
        assert slot["normal_estimate"] is None and slot["permittivity_estimate"] is None
        assert len(slot["estimate"]) == 3 and slot["position_error_m"] > 0.0
    assert (tmp_path / "report.html").is_file()


@pytest.mark.parametrize("kind, count", [("ply", 2), ("csv", 2), ("mat", 1), ("json", 1)])
def test_export_of_a_flight(capsys, flown, tmp_path, kind, count):
    result = call(capsys, "export", flown, "--format", kind, "--index", 1, "--out", tmp_path)
    assert result["index"] == 1 and len(result["files"]) == count
    assert {str(path) for path in tmp_path.iterdir()} == set(result["files"])
    with np.load(flown / "clouds.npz") as track:
        wanted = {"truth": track["truth"][1], "points": track["points"][1]}
    if kind in ("ply", "csv"):
        read = {
            "ply": lambda path: trimesh.load(path).vertices,
            "csv": lambda path: np.loadtxt(path, delimiter=",", skiprows=1)[:, :3],
        }[kind]
        found = {
            name: read(tmp_path / f"demo_00001_{file}.{kind}")
            for name, file in (("truth", "true"), ("points", "reconstructed"))
        }
    else:
        path = Path(result["files"][0])
        found = scipy.io.loadmat(path) if kind == "mat" else json.loads(path.read_text())
    for name, points in wanted.items():
        np.testing.assert_allclose(found[name], points, atol=1e-6)


@pytest.mark.parametrize("content", [b"", b"junk", b"PK\x03\x04 torn"])
def test_export_of_a_damaged_result_names_the_file(capsys, tmp_path, content):
    (tmp_path / "clouds.npz").write_bytes(content)
    assert "clouds.npz: is damaged" in refused(capsys, "export", tmp_path, "--format", "ply")


def test_export_of_a_sample_is_the_sample(capsys, home, tmp_path):
    result = call(capsys, "export", home / "data", "--format", "npz", "--index", 7, "--out", tmp_path)
    with np.load(result["files"][0]) as record:
        assert record["slot"] == 3 and record["flight"] == 1
        np.testing.assert_array_equal(record["true_channel"], record["true_channel"].swapaxes(-1, -2))
    assert "--index: 40 is out of range" in refused(capsys, "export", home / "data", "--format", "npz", "--index", 40)


def test_a_flight_meets_the_channels_that_the_data_hold(home):
    dataset = Dataset(home / "data")
    rows = dataset.read(np.arange(4))
    airframe = resolve_airframe("quad_x", dataset.config.target.half_wheelbase_m)
    channels = channels_along(
        dataset.config, airframe, rows.rotation, rows.position, float(rows.permittivity[0]), float(rows.conductivity[0])
    )
    # a few poses are solved densely: positions of metres in single precision cost a weak echo four digits
    for channel, stored in zip(np.asarray(channels), unpack(rows.true_channel)):
        assert np.linalg.norm(channel - stored) < 5e-4 * np.linalg.norm(stored)


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    """A drone in a file of its own, in millimetres."""
    craft = procedural_airframe("quad_x", 0.25).mesh.copy()
    craft.apply_scale(1000.0)
    path = tmp_path_factory.mktemp("mesh") / "mine.stl"
    craft.export(path)
    return path


def test_reconstruct_a_drone_from_a_file(capsys, home, mesh, tmp_path):
    words = [
        "reconstruct",
        "--mesh",
        mesh,
        "--unit",
        "mm",
        "--half-wheelbase",
        "0.25",
        "--run",
        home / "run",
        "--out",
        tmp_path / "mine",
        "--position",
        "4,5,3",
        "--pitch",
        "-10",
    ]
    result = call(capsys, *words)
    assert {path.name for path in (tmp_path / "mine").iterdir()} == FILES | {"reconstruct.png"}
    (slot,) = result["slots"]
    np.testing.assert_allclose(slot["position"], [4.0, 5.0, 3.0])
    # nose up by 10 degrees: the normal leans back
    lean = math.radians(10)
    np.testing.assert_allclose(slot["normal"], [-math.sin(lean), 0.0, math.cos(lean)], atol=1e-6)
    # the numbers say how they came about
    craft = json.loads((tmp_path / "mine" / "metrics.json").read_text())["craft"]
    assert (craft["mesh"]["path"], craft["mesh"]["unit_m"], craft["mesh"]["up"]) == (str(mesh), 0.001, "z")
    assert (craft["half_wheelbase_m"], craft["pitch_deg"]) == (0.25, -10.0)
    assert craft["mesh_sha256"] == hashlib.sha256(mesh.read_bytes()).hexdigest()
    program, *back = shlex.split(result["command_line"])
    assert program == "august" and back == [*map(str, words), "--json"]


def test_lines_to_try_next_hold_what_was_given(capsys, home, mesh, tmp_path, monkeypatch):
    """They are pasted: unit, axes, size, place and run are those of the result, quoted where a path needs it."""
    from august_jax.app import report

    written = {}

    def write_report(path, track, scores, about, **rest):
        written.update(following=about.following)

    monkeypatch.setattr(report, "write_report", write_report)
    spaced = tmp_path / "my drones" / "one of them.stl"
    spaced.parent.mkdir()
    shutil.copy(mesh, spaced)
    call(
        capsys,
        "reconstruct",
        "--mesh",
        spaced,
        "--unit",
        "mm",
        "--forward",
        "-y",
        "--half-wheelbase",
        "0.25",
        "--run",
        home / "run",
        "--out",
        tmp_path / "the result",
        "--position",
        "4,5,3",
        "evaluate.sampler_steps=2",
        "target.permittivity=[2,2.5]",
    )
    assert np.load(tmp_path / "the result" / "clouds.npz")["permittivity"] == pytest.approx(2.25)  # mid-range
    another, accuracy, export = (parse(shlex.split(line)[1:], cli.COMMANDS) for line, _ in written["following"])
    assert (another.mesh, another.unit, another.up, another.forward) == (str(spaced), "mm", "z", "-y")
    assert (another.half_wheelbase, another.position, another.run) == (0.25, (4.0, 5.0, 3.0), str(home / "run"))
    assert another.overrides == accuracy.overrides == ["evaluate.sampler_steps=2", "target.permittivity=[2,2.5]"]
    assert accuracy.rest == [str(home / "run")] and export.rest == [str(tmp_path / "the result")]


@pytest.mark.parametrize(
    "extra, wanted",
    [
        ([], ["half", "0.25", "unit"]),
        (["--unit", "furlong"], ["--unit 'furlong'", "mm"]),
        (["--unit", "mm", "--up", "w"], ["--up 'w'"]),
        (["--unit", "mm", "--position", "40,5,3"], ["position", "40", "x 3 to 7", "5,6,3.5"]),
        (["--unit", "mm", "--roll", "60"], ["roll", "60", "30 degrees"]),
        (["--unit", "mm", "--roll", "26", "--pitch", "30"], ["by 38.9 degrees", "30 degrees"]),
        (["--unit", "mm", "--pitch", "35", "--yaw", "45"], ["by 35 degrees", "30 degrees"]),
        (["--unit", "mm", "--permittivity", "12"], ["permittivity", "12", "1.5 to 5"]),
        (["--unit", "mm", "--conductivity", "2"], ["conductivity", "0.001 to 0.01 S/m"]),
        (["--unit", "mm", "--pitch", "70", "flight.tilt_deg=80"], ["70 degrees", "30 degrees"]),
        (["--unit", "mm", "--snr", "300"], ["--snr", "300", "-100 to 100 dB"]),
    ],
)
def test_reconstruct_refuses_what_the_weights_do_not_know(capsys, home, mesh, tmp_path, extra, wanted):
    message = refused(capsys, "reconstruct", "--mesh", mesh, "--run", home / "run", "--out", tmp_path / "out", *extra)
    assert all(text in message for text in wanted), message
    assert not (tmp_path / "out").exists()


def test_reconstruct_without_a_file(capsys, home, tmp_path):
    message = refused(capsys, "reconstruct", "--mesh", tmp_path / "none.stl", "--run", home / "run")
    assert "none.stl" in message and "no such file" in message
