"""The paper's figures: a plan before the work, refusals with the way out, and pictures from numbers."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scripts
from test_experiments import assert_ink

SNRS_DB = (0.0, 15.0, 30.0)
RUNS = ("--runs", "runs", "--results", "results")


@pytest.fixture
def reproduce(monkeypatch, tmp_path):
    """The script as a module, in a folder of its own."""
    for folder in ("experiments/paper", "experiments"):
        monkeypatch.syspath_prepend(scripts.ROOT / folder)
    monkeypatch.chdir(tmp_path)
    return importlib.import_module("reproduce")


def campaign(preset="laptop"):
    from campaign import Campaign

    return Campaign(preset, Path("runs"), Path("results"))


@pytest.mark.parametrize(
    "words, told",
    [
        (("positon_error",), "did you mean 'position_error'?"),
        (("whatever",), "there are all, position_error,"),
        (("tracks", "--preset", "smoke", "--budget", "0.1"), "--budget: 0.1 minutes are too few"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_way_out(reproduce, capsys, tmp_path, words, told):
    assert reproduce.main([*words, *RUNS]) == 2
    error = capsys.readouterr().err
    assert told in error and len(error.splitlines()) <= 6
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("preset", ["smoke", "laptop", "paper"])
def test_the_plan_counts_what_is_missing_and_writes_nothing(reproduce, capsys, tmp_path, preset):
    from campaign import SCALES

    assert reproduce.main(["all", "--preset", preset, "--plan", *RUNS]) == 0
    lines = capsys.readouterr().out.splitlines()
    trained = [line for line in lines if "  train " in line]
    assert len({line.split()[3] for line in trained}) == len(trained)  # what figures share is trained once
    assert all(f"0 of {SCALES[preset].steps} steps" in line for line in trained)
    assert sum("  figure " in line for line in lines) == len(reproduce.NAMES)
    assert lines[-1].startswith(f"{len(lines) - 1} of {len(lines) - 1} pieces to do")
    assert not list(tmp_path.iterdir())


def test_a_rehearsal_is_a_twentieth_in_folders_of_its_own(reproduce, capsys):
    from campaign import SCALES, Campaign

    assert reproduce.main(["denoising", "--preset", "paper", "--rehearse", "--plan", *RUNS]) == 0
    assert f"0 of {SCALES['paper'].steps // 20} steps" in capsys.readouterr().out
    whole, part = (Campaign("paper", Path("runs"), Path("results"), rehearse=each) for each in (False, True))
    run = reproduce.figures(["denoising"])[0].runs("paper")[0][0]
    assert whole.folder(run) != part.folder(run) and whole.picture("x") != part.picture("x")
    assert part.config(run).model == whole.config(run).model
    assert [each.config(run).train.points for each in (whole, part)] == [100, 5]
    assert part.config(run).train.save_every == part.scale.steps // 2
    assert part.scale.flights == SCALES["paper"].flights // 20 and part.scale.searched == 1


def test_runs_differ_where_their_names_do(reproduce):
    from campaign import digest_of

    here = campaign()
    runs = {run for figure in reproduce.figures(["all"]) for run, _ in figure.runs("laptop")}
    assert len(runs) == len({run.name for run in runs}) == len({digest_of(here.config(run)) for run in runs})
    assert all(here.config(run).train.source == "stream" for run in runs)


def test_results_of_another_configuration_are_refused(reproduce, capsys):
    here = campaign("smoke")
    here.keep("denoising", {"some": np.zeros(3)}, "0123456789abcdef", 1.0)
    (figure,) = reproduce.figures(["denoising"])
    with pytest.raises(ValueError, match="another configuration .0123456789abcdef, now .*remove it"):
        here.numbers("denoising", figure.digest(here))
    here.keep("denoising", {"some": np.zeros(3)}, figure.digest(here), 1.0)
    assert set(here.numbers("denoising", figure.digest(here))) == {"some"}
    with np.load("results/smoke/denoising.npz") as kept:
        told = json.loads(str(kept["record"]))
    assert told["preset"] == "smoke" and told["seconds"] == 1.0 and told["hardware"]
    assert {"jax", "python", "august_jax"} <= set(told["versions"])


def test_one_figure_that_is_not_computed_says_what_to_run(reproduce, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["tracks.py", "draw", "--preset", "smoke", *RUNS])
    from figure import main

    (figure,) = reproduce.figures(["tracks"])
    with pytest.raises(SystemExit) as ended:
        main(figure, "")
    assert ended.value.code == 2
    assert "`python experiments/paper/tracks.py compute --preset smoke`" in capsys.readouterr().err


def rows(level):
    """What an evaluation may say, better from SNR to SNR."""
    found = []
    for number, snr_db in enumerate(SNRS_DB):
        for scheme in (
            "august",
            "polar",
            "polar_angles",
            "matched_field",
            "prediction",
            "up",
            "mean_shape",
            "resampling",
        ):
            value = level / (1.0 + number)
            found.append(
                {"scheme": scheme, "snr_db": snr_db, "count": 10, "mpe_m": value, "mpe_se_m": 0.1 * value,
                 "mde": 0.1 * value, "mde_se": 0.01 * value, "wd_db": -10.0 * value, "wd_se_db": 0.3, "mcd_db": -20.0,
                 "mcd_se_db": 0.2, "craft_accuracy": None, "bound_m": 0.1 * value, "bound_mde": 0.001 * value,
                 "expected_mpe_m": value if scheme == "matched_field" else None}
            )  # fmt: skip
    return found


def test_what_schemes_without_networks_say_is_taken_once(reproduce):
    from figure import columns

    numbers = columns([("first", rows(1.0)), ("second", rows(0.5))])
    lines = list(numbers["line"])
    assert lines.count("first") == lines.count("second") == lines.count("polar") == len(SNRS_DB)
    assert np.all(numbers["mpe_m"][numbers["line"] == "second"] == np.array([0.5, 0.25, 0.5 / 3.0]))
    assert np.all(np.isnan(numbers["craft_accuracy"]))


def test_the_bound_is_drawn_once_where_all_hear_alike_and_line_by_line_where_not(reproduce):
    from figure import columns, over_snr

    from august_jax.app.plotting import new_figure

    alike = columns([("first", rows(1.0)), ("second", rows(1.0))])
    for numbers, bounds in ((alike, 1), (columns([("first", rows(1.0)), ("second", rows(0.5))]), 2)):
        lines, search = {"first": ("a", "red", "-"), "second": ("b", "blue", "-")}, {"matched_field": ("c", "k", "-")}
        for shown, expectations in ((lines, 0), (lines | search, 1)):  # without the search, nothing of what it expects
            axes = new_figure(3.0, 3.0).add_subplot()
            over_snr(axes, numbers, "mpe_m", shown, bound="bound_m")
            told = axes.get_legend_handles_labels()[1]
            assert sum(label.startswith("what the search expects") for label in told) == expectations
            assert len(shown) > 2 or [line.get_linestyle() for line in axes.lines].count("-.") == bounds


def beyond(name):
    """Rows of the figures that the paper does not have, over what each of them is over."""
    from answered import table

    lines = ("august", "AUGUST", "without", "all", "matched_field", "search")
    found = []
    for number, level in enumerate((1.0, 2.0, 4.0, 8.0)):
        for line in (*lines, "prediction", "up", "mean_shape", "resampling"):
            (own,) = [row for row in rows(level) if (row["scheme"], row["snr_db"]) == ("august", 0.0)]
            over = {"tones": level, "range_m": 10.0 * level, "snr_db": 30.0 - 10.0 * number}
            # beyond two, the search expects more than its bound allows
            expected = {"expected_mpe_m": 0.05 * level**2, "own_bound_m": 0.05 * level, "explained": 0.5 / level,
                        "expected_mde": 1e-3 * level**3, "own_bound_mde": 1e-3 * level}  # fmt: skip
            said = expected if line in ("matched_field", "search") else {}
            found += [own | over | said | {"line": line, "world": world} for world in ("left out", "known")]
    numbers = table(found)
    if name == "left_out":
        return numbers
    return {column: values[numbers["world"] == "known"] for column, values in numbers.items()}


def made_up(figure, here):
    """Numbers of the shapes that a figure draws."""
    from campaign import Run

    rng = np.random.default_rng(0)
    if figure.name in ("bandwidth", "soft_boundary", "left_out"):
        return beyond(figure.name)
    if figure.name in ("position_error", "shape_error", "attitude_error", "array_size", "region_size"):
        here.rows = lambda run, searched=False: rows(0.2 + 0.01 * len(run.name))
        return figure.compute(here)
    points, slots, drawn = 50, 2, 3
    truth = rng.normal(scale=0.1, size=(slots, points, 3))
    clouds = {
        "truth_m": truth, "true_permittivity": np.full((slots, points), 3.0),
        "true_conductivity": np.full((slots, points), 5e-3), "label": np.array(["a", "b", "c"]),
        "points_m": truth + 0.02 * rng.normal(size=(drawn, slots, points, 3)), "off_m": np.full((drawn, slots), 0.1),
        "permittivity": rng.uniform(2.0, 4.0, (drawn, slots, points)), "chamfer_m2": np.full((drawn, slots), 1e-3),
        "conductivity": rng.uniform(0.0, 1e-2, (drawn, slots, points)),
    }  # fmt: skip
    if figure.name == "denoising":
        return {
            "instants": np.array([0, 10, 20]), "points_m": clouds["points_m"][:, 0], "truth_m": truth[0],
            "permittivity": clouds["permittivity"][:, 0], "true_permittivity": clouds["true_permittivity"][0],
            "off_m": np.array([0.3, 0.1, 0.05]), "spread_m": np.array([0.5, 0.2, 0.1]),
        }  # fmt: skip
    if figure.name == "tracks":
        errors = rng.uniform(0.01, 0.5, (2, 3, 20))
        lost = np.zeros(errors.shape, bool)
        searched = np.where(np.arange(3)[:, None] < 2, 0.1 * errors, np.nan)  # some of the flights
        return {"label": np.array(["smooth", "dynamic"]), "places_m": rng.normal(size=(2, 3, 20, 3)).cumsum(axis=2),
                "predicted_m": errors, "estimated_m": 0.5 * errors, "search_m": searched, "estimated_lost": lost,
                "search_lost": lost, "first": np.array(3)}  # fmt: skip
    if figure.name.startswith("craft_"):
        lines = {name: rng.uniform(0.1, 1.0, (2, 3)) for name in ("wd_se_db", "mpe_m", "mpe_se_m", "snr_db", "bound_m")}
        return {"label": np.array(["small", "large"]), "power_dbm": np.array([-30.0, -15.0, 0.0]), **lines,
                "wd_db": -10.0 * lines["mpe_m"], "mcd_db": -20.0 * lines["mpe_m"],
                "prediction_m": np.full(2, 0.48), "floor_db": np.full(2, -37.0)}  # fmt: skip
    assert figure.name.startswith("clouds_by") or figure.name == "region_view"
    assert isinstance(figure.runs("laptop")[0][0], Run)
    return clouds


@pytest.mark.parametrize("number", range(16))
def test_a_figure_is_drawn_from_its_numbers(reproduce, number):
    from figure import picture

    (figure,) = reproduce.figures([reproduce.NAMES[number]])
    here = campaign()
    numbers = made_up(figure, here)
    pdf, png = picture(figure, here, numbers)
    assert pdf.read_bytes().startswith(b"%PDF")
    assert_ink(png)
    drawn = figure.draw(numbers)
    assert all(legend.get_window_extent().width <= drawn.bbox.width for legend in drawn.legends)


def test_every_figure_has_a_script_and_every_script_is_in_the_list(reproduce):
    assert len(reproduce.NAMES) == 16
    for figure in reproduce.figures(["all"]):
        assert figure.minutes > 0.0 and figure.subject and figure.paper
    found = {
        path.stem for path in (scripts.ROOT / "experiments" / "paper").glob("*.py") if "\nFIGURE" in path.read_text()
    }
    assert found == set(reproduce.NAMES)
    told = (scripts.ROOT / "experiments" / "README.md").read_text()
    studies = scripts.defining("experiments", "compute", "draw")
    assert all(f"`{name}.py`" in told for name in (*found, *studies))


def test_the_soft_boundary_is_where_a_search_expects_more_than_its_bound_allows(reproduce):
    (figure,) = reproduce.figures(["soft_boundary"])
    from soft_boundary import boundary_m

    numbers = beyond(figure.name)
    assert boundary_m(numbers, "position") == 10.0 and boundary_m(numbers, "normal") == 10.0
    search = numbers["line"] == "search"
    near = numbers | {"expected_mpe_m": np.where(search, numbers["own_bound_m"], np.nan)}
    assert boundary_m(near, "position") is None  # nowhere in sight
    assert boundary_m({name: values[~search] for name, values in numbers.items()}, "position") is None


def test_a_search_is_asked_slot_by_slot_and_says_what_it_explains(reproduce, monkeypatch, unchecked):
    from answered import Asked, row
    from made_up_posterior import MadeUpLibrary, made_up_posterior, search_is_made_up

    from august_jax.config import preset
    from august_jax.schemes import Slots, Truth
    from august_jax.signal import Statistics

    config, count = preset("smoke"), 3
    search_is_made_up(monkeypatch, unexplained=(1,))
    place = np.array([[5.0, 6.0, 3.0], [4.0, 7.0, 2.0], [6.0, 5.0, 4.0]], np.float32)
    cloud = place[:, None] + np.random.default_rng(0).normal(scale=0.1, size=(count, 64, 3)).astype(np.float32)
    none = np.zeros((count, 1, 7, 7), np.complex64)
    slots = Slots(place, np.full(count, 20.0, np.float32), None,
                  Truth(place, np.tile(np.array([0.0, 0.0, 1.0], np.float32), (count, 1)), cloud, cloud),
                  Statistics(none, none, place))  # fmt: skip
    told = []
    found = row(Asked("a line", "matched_field", config, None, MadeUpLibrary(config.target.airframes)), slots, 0.25,
                told.append)  # fmt: skip
    assert (found["line"], found["count"], len(told)) == ("a line", count, count)
    assert found["explained"] == pytest.approx(2 / 3)
    off = np.linalg.norm(made_up_posterior(np.zeros(3)).mean_position)
    assert found["mpe_m"] == pytest.approx(off, abs=1e-4) and found["expected_mpe_m"] > 0.0


@pytest.mark.slow
def test_all_figures_at_the_smallest_scale(reproduce, tmp_path, capsys):
    """Trained, evaluated, computed and drawn; a second run has nothing to do."""
    assert reproduce.main(["all", "--preset", "smoke", *RUNS]) == 0
    for name in reproduce.NAMES:
        assert_ink(tmp_path / "results" / "smoke" / f"{name}.png")
    capsys.readouterr()
    assert reproduce.main(["all", "--preset", "smoke", "--plan", *RUNS]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("0 of ")
