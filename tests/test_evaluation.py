"""Scores and baselines: closed forms for answers whose errors are known."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from made_up_track import made_up_track

from august_jax import evaluation
from august_jax.config import override, preset
from august_jax.scene import procedural_airframe


def truth(count=3, points=50):
    rng = np.random.default_rng(0)
    normal = np.tile([0.0, 0.0, 1.0], (count, 1))
    return {"position": np.zeros((count, 3)), "normal": normal, "cloud": rng.normal(0.0, 0.1, (count, points, 3))}


def test_a_shifted_answer_errs_in_position_alone():
    true, shift = truth(), np.array([0.3, 0.0, 0.4])
    scores = evaluation.score({"position": true["position"] + shift, "normal": true["normal"],
                               "cloud": true["cloud"] + shift}, true, 0.1)
    assert scores["mpe_m"] == pytest.approx(0.5) and scores["mpe_se_m"] == pytest.approx(0.0, abs=1e-6)
    assert scores["mde"] == pytest.approx(0.0, abs=1e-6)
    # clouds are compared about their own means: what is left of the shift is the position's share, 10 log10(0.5^2)
    assert scores["wd_db"] == pytest.approx(10 * np.log10(0.25), abs=1e-3)
    assert scores["wd_size_db"] == pytest.approx(scores["wd_db"] + 20.0)  # lengths in units of a tenth of a metre
    assert scores["mcd_db"] < -100


def test_what_an_answer_lacks_is_not_scored():
    true = truth()
    level = pytest.approx(0.0, abs=1e-6)
    assert evaluation.score({"normal": true["normal"]}, true, 0.25) == {
        "mpe_m": None, "mpe_se_m": None, "mde": level, "mde_triples": level, "wd_db": None, "wd_size_db": None,
        "mcd_db": None}
    scattered = true["position"] + [[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]]
    assert evaluation.score({"position": scattered}, true, 0.25)["mpe_se_m"] == pytest.approx(0.1 / np.sqrt(3.0))
    tilted = np.tile([0.6, 0.0, 0.8], (3, 1))
    scores = evaluation.score({"normal": true["normal"], "triples": tilted}, true, 0.25)
    assert scores["mde"] == level and scores["mde_triples"] == pytest.approx(0.2)
    scores = evaluation.score({"cloud": true["cloud"], "about": true["position"] + [0.0, 0.1, 0.0]}, true, 0.25)
    assert scores["mpe_m"] is None and scores["wd_db"] == pytest.approx(-20.0, abs=1e-3)


def test_mean_shape_is_level_and_has_no_heading():
    airframes = [procedural_airframe(name) for name in ("quad_x", "octo")]
    points = np.asarray(evaluation.mean_shape(jax.random.key(0), airframes, 5001))
    assert points.shape == (5001, 3)
    # four standard errors: 0.2 m / sqrt(5001)
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=0.012)
    spread = points.T @ points / len(points)
    assert spread[0, 0] == pytest.approx(spread[1, 1], rel=0.1)
    assert abs(spread[0, 1]) < 0.05 * spread[0, 0]
    # shares alike, and heights are those of the craft, whom a heading does not move
    heights = np.concatenate([np.asarray(each.sample_surface(jax.random.key(1), 2500))[:, 2] for each in airframes])
    assert np.std(points[:, 2]) == pytest.approx(np.std(heights), rel=0.1)


def test_a_perfect_reconstruction_scores_like_the_floor():
    track = made_up_track()
    track = replace(track, points=track.again, predicted=track.position + 0.1)
    found = evaluation.score_track(track, preset("smoke"), 0.25)
    rows = {row["scheme"]: row for row in found["schemes"]}
    for metric in ("mpe_m", "wd_db", "wd_size_db", "mcd_db"):
        assert rows["august"][metric] == pytest.approx(rows["resampling"][metric], rel=1e-3)
    assert rows["prior"]["mpe_m"] == pytest.approx(0.1 * np.sqrt(3.0), rel=1e-4)
    assert rows["mean_shape"]["wd_db"] > rows["august"]["wd_db"]


def test_meshes_that_are_gone_cost_the_mean_shape_and_no_more():
    config = override(preset("smoke"), ["target.airframes=[quad_x, gone.ply]"])
    with pytest.warns(UserWarning, match="mean_shape.*gone.ply"):
        found = evaluation.score_track(made_up_track(), config, 0.25)
    assert [row["scheme"] for row in found["schemes"]] == ["august", "prior", "up", "resampling"]


def test_pilots_that_light_all_directions_have_no_bound():
    config = override(preset("smoke"), ["signal.estimator=dft"])
    assert evaluation.unit_information({}, np.zeros((0, 3)), [], config) is None


def test_slots_tell_angles_and_distances():
    track = made_up_track()
    slot = evaluation.score_track(track, preset("smoke"), 0.25)["slots"][1]
    # the made-up craft leans by 5 degrees and 20 more a second, and its slots last 0.2 s
    assert slot["tilt_deg"] == pytest.approx(9.0) and slot["normal_error_up_deg"] == pytest.approx(9.0)
    assert slot["position_error_m"] == pytest.approx(np.linalg.norm(track.points[1].mean(axis=0) - track.position[1]))
    assert slot["permittivity"] == 3.2 and slot["permittivity_estimate"] == pytest.approx(3.1, abs=0.05)
