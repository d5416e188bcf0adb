"""Pictures: they are written, they hold ink where they should, and bad input is refused by name."""

import json
import struct

import numpy as np
import pytest
from made_up_track import made_up_track

from august_jax.app import plotting
from august_jax.schemes import SCHEMES


def size(png):
    head = png.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", head[16:24])


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved, to look into."""
    figures = []
    monkeypatch.setattr(plotting, "save", lambda figure, png: figures.append(figure))
    return figures


def test_training_curves_draw_every_term_once(tmp_path):
    lines = [{"step": 10 * k, "loss": 1.0 / k, "position": 0.5 / k, "samples_per_s": 100.0} for k in range(1, 40)]
    (tmp_path / "two.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (tmp_path / "one.jsonl").write_text("\n".join(json.dumps({"step": x["step"], "loss": x["loss"]}) for x in lines))
    plotting.training_curves(tmp_path / "two.jsonl", tmp_path / "two.png")
    plotting.training_curves(tmp_path / "one.jsonl", tmp_path / "one.png")
    # one panel a loss term: the speed is not one
    assert size(tmp_path / "two.png")[0] == 2 * size(tmp_path / "one.png")[0]


NETWORKS = {"step": 2.0, "gradient": 9.0, "latent": 8.0, "loss": 3.0, "material": 2.0, "position": 1.0,
            "samples_per_s": 7.0, "seconds_left": 0.0,
            "validation_mpe_m": 0.2, "validation_prediction_m": 0.5}  # fmt: skip
PREDICTOR = {"step": 2.0, "gradient": 9.0, "kalman": 1.2, "loss": 0.9, "samples_per_s": 7.0, "seconds_left": 0.0,
             "smooth": 0.1, "dynamic": 0.2, "smooth_kalman": 0.15, "dynamic_kalman": 0.3}  # fmt: skip


def test_each_number_of_a_training_run_has_one_panel_with_its_baseline_in_it(tmp_path, drawn):
    wanted = {"validation_mpe_m": "validation_prediction_m", "loss": None, "latent": None, "material": None,
              "position": None, "gradient": None}  # fmt: skip
    assert {panel.name: panel.base for panel in plotting.training_panels([{"step": 1.0}, NETWORKS])} == wanted
    assert [(panel.name, panel.base) for panel in plotting.training_panels([PREDICTOR])] == [
        ("smooth", "smooth_kalman"), ("dynamic", "dynamic_kalman"), ("loss", "kalman"), ("gradient", None)
    ]  # fmt: skip
    assert plotting.training_panels([]) == []
    assert all(len(panel.title) > len(panel.name) for panel in plotting.training_panels([NETWORKS]))
    (tmp_path / "metrics.jsonl").write_text(json.dumps({**NETWORKS, "step": 1.0}) + "\n" + json.dumps(NETWORKS))
    plotting.training_curves(tmp_path / "metrics.jsonl", tmp_path / "curves.png")
    first, *others = drawn[0].axes
    heights = [line.get_ydata()[-1] for line in first.lines]
    assert heights == [0.2, 0.5] and [len(axes.lines) for axes in others] == [1] * 5


def test_a_dollar_sign_of_a_name_is_drawn_and_powers_of_ten_stay_formulas(tmp_path):
    figure = plotting.new_figure(4.0, 3.0)
    axes = figure.add_subplot(1, 1, 1)
    axes.loglog([1.0, 1e4], [1e-3, 1.0], label="run_$HOME_$USER")
    axes.set_title("my$v1_$2.stl, a single $")
    axes.legend()
    plotting.save(figure, tmp_path / "dollars.png")
    assert axes.title.get_text() == "my$v1_$2.stl, a single $" and not axes.title.get_parse_math()
    ticks = [tick for tick in axes.get_xticklabels() if "mathdefault" in tick.get_text()]
    assert ticks and all(tick.get_parse_math() for tick in ticks)


def test_training_curves_refuse_an_empty_log(tmp_path):
    (tmp_path / "metrics.jsonl").write_text("")
    with pytest.raises(ValueError, match="holds no loss terms"):
        plotting.training_curves(tmp_path / "metrics.jsonl", tmp_path / "curves.png")
    assert not (tmp_path / "curves.png").exists()


@pytest.mark.parametrize("slots, panels", [(1, 2), (3, 6), (9, 8)])
def test_clouds_show_truth_and_reconstruction_of_at_most_four_slots(tmp_path, drawn, slots, panels):
    track = made_up_track(slots)
    plotting.clouds(track, tmp_path / "clouds.png", permittivity=(1.5, 5.0), title="made up")
    boxes = [axes for axes in drawn[0].axes if axes.name == "3d"]
    assert len(boxes) == panels
    last = track.points[-1] - track.position[-1]
    np.testing.assert_allclose(np.stack(boxes[-1].collections[0]._offsets3d, -1), last, atol=1e-6)


@pytest.mark.parametrize("slots, panels", [(1, 3), (3, 7)])
def test_clouds_show_what_a_search_found_below_or_beside(tmp_path, drawn, slots, panels):
    track = made_up_track(slots)
    moved = track.truth[-1] + np.array([0.03, 0.0, 0.0])
    found = plotting.Shown("search: hexa, 97 %", moved, np.full(len(moved), 3.0), track.normal[-1])
    plotting.clouds(track, tmp_path / "c.png", permittivity=(1.5, 5.0), title="made up", found={slots - 1: found})
    boxes = [axes for axes in drawn[0].axes if axes.name == "3d"]
    assert len(boxes) == panels
    assert boxes[-1].get_title().startswith("search: hexa, 97 %")
    offsets = np.stack(boxes[-1].collections[0]._offsets3d, -1)
    np.testing.assert_allclose(offsets, moved - track.position[-1], atol=1e-6)


def test_evaluation_curves_leave_out_what_is_not_defined(tmp_path, drawn):
    none = {"mpe_m": None, "mde": None, "wd_db": None, "mcd_db": None, "count": 8, "bound_m": 0.02, "bound_mde": 0.001}
    rows = [
        {"scheme": scheme, "snr_db": snr, **none, **values}
        for snr in (0.0, 20.0)
        for scheme, values in {
            "august": {"mpe_m": 0.1, "mde": 0.02, "wd_db": -20.0, "mcd_db": -30.0},
            "prediction": {"mpe_m": 0.48},
        }.items()
    ]
    plotting.evaluation_curves(rows, tmp_path / "evaluation.png", title="made up")
    lines = [{line.get_label(): line.get_ydata().tolist() for line in axes.lines} for axes in drawn[0].axes]
    august, prediction = (SCHEMES[name].label for name in ("august", "prediction"))
    assert lines == [
        {august: [0.1, 0.1], prediction: [0.48, 0.48], "bound": [0.02, 0.02]},
        {august: [0.02, 0.02], "bound": [0.001, 0.001]},
        {august: [-20.0, -20.0]},
        {august: [-30.0, -30.0]},
    ]


def test_one_snr_draws_lines_across_at_their_heights(tmp_path, drawn):
    none = {"mpe_m": None, "mde": None, "wd_db": None, "mcd_db": None, "count": 8, "bound_m": 0.02, "bound_mde": 0.001}
    rows = [
        {"scheme": scheme, "snr_db": 20.0, **none, "mpe_m": error}
        for scheme, error in (("august", 0.1), ("prediction", 0.48))
    ]
    plotting.evaluation_curves(rows, tmp_path / "evaluation.png", title="made up")
    lines = {line.get_label(): line for line in drawn[0].axes[0].lines}
    heights = {SCHEMES["august"].label: 0.1, SCHEMES["prediction"].label: 0.48, "bound": 0.02}
    assert {label: set(line.get_ydata()) for label, line in lines.items()} == {k: {v} for k, v in heights.items()}
    for line in lines.values():
        assert line.get_xdata()[0] < 20.0 < line.get_xdata()[-1]
