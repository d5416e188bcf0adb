"""The report: one offline file whose payload holds the clouds to the tenth of a millimetre."""

import base64
import dataclasses

import numpy as np
from made_up_track import made_up_track
from pages import assert_alone, payload

from august_jax.app import report
from august_jax.app.page import About
from august_jax.scene import WorldCloud

SCORES = {"slots": [{"slot": 0, "note": "</script><b>"}], "schemes": [{"scheme": "august", "mpe_m": 0.1, "mde": None}]}


def write(path, track, scores=SCORES, title="made up", repeat=(), configuration="", **rest):
    report.write_report(
        path,
        track,
        scores,
        About(
            title=title,
            lead="lead",
            note="note",
            setup=[("seed", "1")],
            following=[("august demo", "again")],
            repeat=list(repeat),
            configuration=configuration,
        ),
        permittivity=(1.5, 5.0),
        conductivity=(1e-3, 1e-2),
        **rest,
    )
    return path.read_text()


def test_clouds_come_back_from_the_page(tmp_path):
    track = made_up_track(1)
    slot = payload(write(tmp_path / "report.html", track))["slots"][0]
    for name, points in (("true_points", track.truth[0]), ("points", track.points[0])):
        steps = np.frombuffer(base64.b64decode(slot[name]), "<i2").reshape(-1, 3)
        # rounding to the nearest step, and float64 truth
        np.testing.assert_allclose(steps * report.QUANTUM_M + track.position[0], points, atol=0.51 * report.QUANTUM_M)
    levels = np.frombuffer(base64.b64decode(slot["point_permittivity"]), np.uint8)
    np.testing.assert_allclose(
        1.5 + 3.5 * levels / 255, np.clip(track.point_permittivity[0], 1.5, 5.0), atol=0.51 * 3.5 / 255
    )


def test_a_cloud_that_is_lost_is_drawn_where_it_is(tmp_path):
    """Farther off than 16-bit integers of a tenth of a millimetre reach."""
    track = made_up_track(1)
    track = dataclasses.replace(track, points=track.points + np.float32([0.0, 5.0, 0.0]))
    page = payload(write(tmp_path / "report.html", track))
    steps = np.frombuffer(base64.b64decode(page["slots"][0]["points"]), "<i2").reshape(-1, 3)
    found = steps * page["quantum_m"] + track.position[0]
    np.testing.assert_allclose(found, track.points[0], atol=0.51 * page["quantum_m"])
    assert report.QUANTUM_M < page["quantum_m"] < 2.0 * report.QUANTUM_M


def test_hypotheses_of_a_search_come_back_from_the_page(tmp_path):
    track = made_up_track(2)
    clouds = tuple(WorldCloud(track.resampled[1] + shift, np.ones(400), np.ones(400)) for shift in (0.0, 0.1))
    scores = {"slots": [{"slot": 0, "search": None}, {"slot": 1, "search": {}}], "schemes": []}
    first, second = payload(write(tmp_path / "report.html", track, scores, hypotheses={1: clouds}))["slots"]
    assert first["hypothesis_points"] == []
    for text, cloud in zip(second["hypothesis_points"], clouds, strict=True):
        steps = np.frombuffer(base64.b64decode(text), "<i2").reshape(-1, 3)
        np.testing.assert_allclose(
            steps * report.QUANTUM_M + track.position[1], cloud.points, atol=0.51 * report.QUANTUM_M
        )


def test_page_needs_nothing_from_elsewhere(tmp_path):
    page = write(tmp_path / "report.html", made_up_track(1))
    assert_alone(page)


def test_text_cannot_break_out_of_the_payload(tmp_path):
    page = write(tmp_path / "report.html", made_up_track(1), title="<img> </script> of my drone")
    assert payload(page)["title"] == "<img> </script> of my drone"
    assert payload(page)["slots"][0]["note"] == "</script><b>"
    assert page.count("</script>") == 2


def test_the_run_can_be_made_again_from_the_page(tmp_path):
    scores = {"slots": [], "schemes": [], "bound": {"bound_m": 0.05, "bound_mde": None}}
    again = [("august demo --seed 3", "august_jax 1.2.3")]
    page = write(tmp_path / "report.html", made_up_track(1), scores, repeat=again, configuration="array:\n  nx: 4\n")
    told = payload(page)
    assert (told["repeat"], told["configuration"]) == ([list(again[0])], "array:\n  nx: 4\n")
    assert told["bound"] == scores["bound"]


def test_fifty_slots_of_a_thousand_points_stay_small(tmp_path):
    scores = {"slots": [{"slot": slot} for slot in range(50)], "schemes": []}
    assert len(write(tmp_path / "report.html", made_up_track(50, 1000), scores)) < 1.5e6
