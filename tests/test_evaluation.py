"""Scores: closed forms for answers whose errors are known; the bound; the loop over schemes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_posterior import MadeUpLibrary, made_up_posterior, search_is_made_up
from made_up_track import made_up_track

from august_jax.config import override, preset
from august_jax.data import generate, prepare_targets
from august_jax.evaluation import score, score_track
from august_jax.evaluation.bound import SAMPLES, Bound, track_bound, unit_information
from august_jax.scene import WorldCloud
from august_jax.schemes import Answer, Truth
from august_jax.schemes.matched_field import search_track


def truth(count=3, points=50):
    rng = np.random.default_rng(0)
    normal = np.tile([0.0, 0.0, 1.0], (count, 1))
    cloud = rng.normal(0.0, 0.1, (count, points, 3))
    return Truth(np.zeros((count, 3)), normal, cloud, cloud)


def of_points(points):
    return WorldCloud(points, np.ones(points.shape[:-1]), np.ones(points.shape[:-1]))


def test_a_shifted_answer_errs_in_position_alone():
    true, shift = truth(), np.array([0.3, 0.0, 0.4])
    answer = Answer(true.position + shift, true.normal, true.normal, of_points(true.cloud + shift))
    scores = score(answer, true, 0.1)
    assert scores["mpe_m"] == pytest.approx(0.5) and scores["mpe_se_m"] == pytest.approx(0.0, abs=1e-6)
    assert scores["mde"] == pytest.approx(0.0, abs=1e-6)
    # clouds are compared about their own means: what is left of the shift is the position's share, 10 log10(0.5^2)
    assert scores["wd_db"] == pytest.approx(10 * np.log10(0.25), abs=1e-3)
    assert scores["wd_size_db"] == pytest.approx(scores["wd_db"] + 20.0)  # lengths in units of a tenth of a metre
    assert scores["mcd_db"] < -100


def test_what_an_answer_lacks_is_not_scored():
    true = truth()
    level, nothing = pytest.approx(0.0, abs=1e-6), score(Answer(), true, 0.25)
    assert set(nothing.values()) == {None}
    assert score(Answer(normal=true.normal), true, 0.25) == nothing | {"mde": level, "mde_se": level}
    scattered = true.position + [[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]]
    assert score(Answer(position=scattered), true, 0.25)["mpe_se_m"] == pytest.approx(0.1 / np.sqrt(3.0))
    tilted = np.tile([0.6, 0.0, 0.8], (3, 1))
    scores = score(Answer(normal=true.normal, triple_normal=tilted), true, 0.25)
    assert scores["mde"] == level and scores["mde_triples"] == pytest.approx(0.2)
    scores = score(Answer(cloud=of_points(true.cloud), centre=true.position + [0.0, 0.1, 0.0]), true, 0.25)
    assert scores["mpe_m"] is None and scores["wd_db"] == pytest.approx(-20.0, abs=1e-3)


def test_craft_regions_and_what_is_explained_are_counted():
    true = truth(4)._replace(craft=np.array([0, 1, 2, 2]))
    cross = np.concatenate([radius * np.concatenate([np.eye(3), -np.eye(3)]) for radius in (0.1, 0.2, 0.3)])
    middle = np.array([[0.05, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.5], [np.nan, 0.0, 0.0]])
    answer = Answer(
        samples=middle[:, None] + cross,
        craft=np.array([0, 1, 2, -1]),
        craft_probability=np.full((4, 5), 0.2),
        explained=np.array([True, True, True, False]),
        seconds=np.array([30.0, 1.0, 2.0, 3.0]),
    )
    found = score(answer, true, 0.25)
    assert (found["craft_accuracy"], found["craft_chance"], found["explained"]) == (0.75, 0.2, 0.75)
    # the truth lies nearer than all samples of the first, a third of the second's and none of the third's
    assert (found["inside_50"], found["inside_90"]) == (pytest.approx(1 / 3), pytest.approx(2 / 3))
    assert found["seconds"] == 2.5  # the median: a first slot compiles
    assert found["mpe_m"] is None and score(answer, true._replace(craft=None), 0.25)["craft_accuracy"] is None


def test_expected_errors_stand_beside_true_ones_of_the_slots_that_have_them():
    true = truth(3)
    tilted = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0], [0.8, 0.0, 0.6]])
    answer = Answer(
        position=true.position + [[0.3, 0.0, 0.0], [0.1, 0.0, 0.0], [5.0, 0.0, 0.0]],
        normal=tilted,
        expected_error_m=np.array([0.2, 0.3, np.nan]),
        expected_normal_error=np.array([0.1, 0.3, np.nan]),
    )
    found = score(answer, true, 0.25)
    assert (found["expected_mpe_m"], found["expected_mde"]) == (pytest.approx(0.25), pytest.approx(0.2))
    # of the first two alone: 0.2 m where 0.25 m were expected, 0.1 where 0.2
    assert (found["mpe_over_expected"], found["mde_over_expected"]) == (
        pytest.approx(0.8),
        pytest.approx(0.5, rel=1e-5),
    )
    silent = answer._replace(expected_error_m=np.full(3, np.nan), expected_normal_error=None)
    assert score(silent, true, 0.25)["expected_mpe_m"] is None
    sure = answer._replace(expected_error_m=np.zeros(3))
    assert score(sure, true, 0.25)["mpe_over_expected"] is None


def test_errors_along_and_across_the_line_of_sight():
    true = truth()._replace(position=np.tile([0.0, 5.0, 0.0], (3, 1)))
    scores = score(Answer(position=true.position + [0.3, 0.4, 0.0]), true, 0.25)
    assert (scores["along_m"], scores["across_m"]) == (pytest.approx(0.4), pytest.approx(0.3))


def test_a_perfect_reconstruction_scores_like_the_floor():
    track = made_up_track()
    track = replace(track, points=track.resampled, predicted=track.position + 0.1)
    found = score_track(track, preset("smoke"), 0.25)
    rows = {row["scheme"]: row for row in found["schemes"]}
    for metric in ("mpe_m", "wd_db", "wd_size_db", "mcd_db"):
        assert rows["august"][metric] == pytest.approx(rows["resampling"][metric], rel=1e-3)
    assert rows["prediction"]["mpe_m"] == pytest.approx(0.1 * np.sqrt(3.0), rel=1e-4)
    assert rows["mean_shape"]["wd_db"] > rows["august"]["wd_db"]


def test_a_search_of_a_track_is_told_beside_the_networks(monkeypatch, unchecked):
    search_is_made_up(monkeypatch, unexplained=(1,))
    config, track, library = preset("smoke"), made_up_track(), MadeUpLibrary(("quad_x", "hexa"))
    with pytest.raises(ValueError, match="track: it does not hold what its echoes say"):
        search_track(track, library, config, seed=0, slots=[0])
    said = np.zeros((3, 1, 7, 7), np.complex64)
    track = replace(track, received=said, pilots=said)
    search = search_track(track, library, config, seed=0, slots=[0, 2], craft=1)
    found = score_track(track, config, 0.25, search=search)
    row = {each["scheme"]: each for each in found["schemes"]}["matched_field"]
    assert (row["count"], row["craft_accuracy"], row["craft_chance"], row["explained"]) == (2, 0.5, 0.5, 0.5)
    # the first is the posterior's, about the prediction; the second, which nothing explains, the networks'
    errors = [
        np.linalg.norm(made_up_posterior(track.predicted[0]).mean_position - track.position[0]),
        np.linalg.norm(track.estimated_position[2] - track.position[2]),
    ]
    assert row["mpe_m"] == pytest.approx(np.mean(errors), rel=1e-4)
    first, second, third = (slot["search"] for slot in found["slots"])
    assert second is None and (first["craft"], third["craft"]) == ("hexa", None)
    assert first["explained"] and not third["explained"]
    assert sum(first["craft_probability"].values()) == pytest.approx(1.0)
    best, other = first["hypotheses"]
    assert (best["craft"], best["probability"], other["craft"]) == ("hexa", 0.7, "quad_x")
    np.testing.assert_allclose(best["normal"], [0.0, -0.6, 0.8])
    np.testing.assert_allclose(best["position"], track.predicted[0] + 0.1, atol=1e-6)
    assert best["heading_deg"] == 0.0


def test_meshes_that_are_gone_cost_the_mean_shape_and_no_more():
    config = override(preset("smoke"), ["target.airframes=[quad_x, gone.ply]"])
    with pytest.warns(UserWarning, match="mean_shape.*gone.ply"):
        found = score_track(made_up_track(), config, 0.25)
    assert [row["scheme"] for row in found["schemes"]] == ["august", "prediction", "up", "resampling"]


def test_the_bound_of_the_first_samples_is_the_mean_of_theirs():
    config = override(preset("smoke"), ["evaluate.searched=0"])
    targets = prepare_targets(config)
    slots = config.flight.slots
    samples = generate(config, [row * slots for row in range(4)], targets)  # of both craft in turn
    bound = Bound(samples, samples.position, targets, config)
    alone = [Bound(samples.at(slice(row, row + 1)), samples.position[row : row + 1], targets, config) for row in (0, 1)]
    for name, value in bound.at(20.0, 2).items():
        assert value == pytest.approx(np.mean([each.at(20.0)[name] for each in alone]), rel=1e-3)
    assert bound.at(20.0, 4) == bound.at(20.0) and bound.at(20.0, 2) != bound.at(20.0)
    levels = np.array([0.0, 30.0, 10.0, 20.0])  # each at its own, in the samples' order
    for name, values in bound.each(levels).items():
        assert values[:2] == pytest.approx([each.at(snr)[name] for each, snr in zip(alone, levels)], rel=1e-3)


def test_the_bound_of_a_track_is_over_all_of_its_slots(monkeypatch, unchecked):
    """A flight may be longer than what an evaluation averages over: its last slots have another bound here."""
    slots = SAMPLES + 30
    track = made_up_track(slots, points=1)
    given = []

    def informed(samples, predicted, targets, config):
        given.append(len(predicted))
        strength = np.where(np.asarray(samples.slot) < SAMPLES, 1e6, 1.0)
        return strength[:, None, None] * np.eye(10)

    monkeypatch.setattr("august_jax.evaluation.bound.unit_information", informed)
    target = SimpleNamespace(body=None)
    found = track_bound(track, target, preset("smoke"), 0.0)["bound_m"]
    near = track_bound(made_up_track(SAMPLES, points=1), target, preset("smoke"), 0.0)["bound_m"]
    assert given == [slots, SAMPLES] and found > 10.0 * near


def test_pilots_that_light_all_directions_have_no_bound():
    config = override(preset("smoke"), ["signal.estimator=dft", "data.solver=born", "target.airframes=[quad_x]"])
    targets = prepare_targets(config)
    samples = generate(config, [0], targets)
    assert unit_information(samples, samples.position, targets, config) is None


def test_slots_tell_angles_and_distances():
    track = made_up_track()
    slot = score_track(track, preset("smoke"), 0.25)["slots"][1]
    # the made-up craft leans by 5 degrees and 20 more a second, and its slots last 0.2 s
    assert slot["tilt_deg"] == pytest.approx(9.0) and slot["normal_error_up_deg"] == pytest.approx(9.0)
    assert slot["position_error_m"] == pytest.approx(np.linalg.norm(track.points[1].mean(axis=0) - track.position[1]))
    assert slot["permittivity"] == 3.2 and slot["permittivity_estimate"] == pytest.approx(3.1, abs=0.05)
