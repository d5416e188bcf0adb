"""Following a craft: laws of motion against flights, updates against Gaussian algebra, flights at the smallest array.

Flights are heard by 8 x 4 antennas: the preset's eight hear so little that most echoes have several explanations.
"""

import json
from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from made_up_posterior import made_up_posterior

from august_jax import evaluation, streams
from august_jax.app import cli, plotting
from august_jax.config import preset
from august_jax.data import channels_along, prepare_targets
from august_jax.inference import Candidates, Follower, Hypotheses, Motion, follow, known_craft
from august_jax.inference.motion import SEEN, SIZE
from august_jax.pipeline import draw_scenario
from august_jax.scene.trajectory import fly_many
from august_jax.schemes import follow_flight

SMOKE = preset("smoke")
CONFIG = replace(
    SMOKE, target=replace(SMOKE.target, permittivity=(1.5, 4.0)), flight=replace(SMOKE.flight, style="smooth")
)
SLOTS = 7


@cache
def motion(style):
    return Motion.of_flights(replace(CONFIG.flight, style=style))


@cache
def flights(style):
    """States (B, T, 16) of flights that nothing was learned from, as far as a flight tells them."""
    keys = streams.members(streams.key(1, "inference.motion"), np.arange(64))
    place, velocity, acceleration, rotation = (
        np.asarray(part, np.float64) for part in fly_many(keys, replace(CONFIG.flight, style=style, slots=12))
    )
    states = np.zeros((*place.shape[:2], SIZE))
    states[..., :3], states[..., 3:5] = place, rotation[..., :2, 2]
    states[..., 5] = np.unwrap(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]), axis=1)
    states[..., 9:12], states[..., 12:15] = velocity, acceleration
    states[:, 1:, 15] = np.diff(states[..., 5], axis=1)
    return states[:, 1:]


@pytest.mark.parametrize("style", ["smooth", "dynamic"])
def test_a_step_errs_by_as_much_as_it_says(style):
    law = motion(style)
    states, known = flights(style), np.r_[0:6, 9:15]
    now, then = states[:, :-1].reshape(-1, SIZE), states[:, 1:].reshape(-1, SIZE)
    _, noise = law.ahead(now[0], np.zeros((SIZE, SIZE)), 0)
    left = (then - law.step(now, 0))[:, known]
    squares = np.einsum("ni,ij,nj->n", left, np.linalg.inv(noise[np.ix_(known, known)]), left) / len(known)
    # 704 steps of few flights that resemble one another: the mean of three other sets was within 8 % of one; floors of
    # the noise lower it a little
    assert len(law.share) == 1
    assert 0.6 < squares.mean() < 1.2


def test_tilt_tells_of_the_next_speed():
    """Of two craft alike in all but tilt, the one that leans forward is expected to be faster and farther."""
    law = motion("dynamic")
    mean, covariance = law.birth()
    mean[:3] = [5.0, 6.0, 3.5]
    seen = np.zeros((1, SIZE))
    seen[0, 3] = 1.0
    gain = covariance @ seen.T / (seen @ covariance @ seen.T + 1e-4)
    level, leaning = (law.step((mean + gain[:, 0] * (lean - mean[3]))[None], 0)[0] for lean in (0.0, 0.3))
    assert leaning[9] - level[9] > 0.2 and leaning[0] - level[0] > 0.02
    assert abs(leaning[10] - level[10]) < 0.1


def test_jumps_have_a_law_for_straight_flight_and_one_for_turns():
    law = motion("jump")
    assert len(law.share) == 2 and law.share.sum() == pytest.approx(1.0)
    straight = int(np.argmin([np.trace(noise[3:6, 3:6]) for noise in law.noise]))
    mean, _ = law.birth()
    mean[:3], mean[9:12] = [5.0, 6.0, 3.5], [1.0, -0.5, 0.0]
    later = law.step(mean[None], straight)[0]
    np.testing.assert_allclose(later[:2] - mean[:2], 0.2 * mean[9:11], atol=0.02)
    np.testing.assert_allclose(later[9:11], mean[9:11], atol=0.3)


def test_an_update_is_that_of_gaussians():
    """A mode in the middle of its own valley: mean, covariance and evidence as normal equations give them."""
    rng = np.random.default_rng(3)
    rotation = np.asarray(follow.rotations_of(np.array([[0, 0, 0, 0.1, -0.2, 0.7] + [0.0] * 10]))[0], np.float32)
    scales = np.array([0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.3, 1e-3, 0.05, 0.5])
    root = rng.normal(size=(20, 10)) / scales / 4.0
    information, slope = root.T @ root, 0.3 * rng.normal(size=10) / scales
    mode = Candidates(
        np.int32(0), rotation, np.array([5.0, 6.0, 3.0], np.float32), np.float32(2.5), np.float32(5e-3),
        np.float32(0.1), np.float32(0.0), np.float32(200.0), np.float32(information), np.float32(slope),
        np.float32(0.01),
    )  # fmt: skip
    seen, turned = follow._seen_of(mode)
    spread = rng.normal(size=(SIZE, 40)) * np.r_[scales[:9], [1.0] * 6, 0.1][:, None] / 4.0
    covariance = spread @ spread.T
    mean = np.r_[seen, np.zeros(7)] + 0.3 * np.sqrt(np.diagonal(covariance)) * rng.normal(size=SIZE)
    mean[7] = 5e-3
    ranges = np.array([[1.0, 4.0], [0.0, 1e-2]])
    child = follow._updated(follow.Belief(0, -1.0, mean, covariance), 0, mode, ranges)

    # the same by normal equations in (state, phase): turns become axis and heading
    change = np.zeros((10, SIZE + 1))
    change[:9, :9], change[9, SIZE] = np.eye(9), 1.0
    change[3:6, 3:6] = np.linalg.inv(turned)
    precision = np.zeros((SIZE + 1, SIZE + 1))
    precision[:SIZE, :SIZE] = np.linalg.inv(covariance)
    at = np.r_[mean[:SEEN] - seen, np.zeros(8)]  # of the prediction from the mode; other numbers from their means
    whole = precision + change.T @ np.float32(information) @ change
    push = change.T @ np.float32(slope) + precision @ at
    best = np.linalg.solve(whole, push)
    np.testing.assert_allclose(child.belief.covariance, np.linalg.inv(whole)[:SIZE, :SIZE], rtol=2e-3, atol=1e-6)
    wanted = np.r_[seen + best[:SEEN], mean[SEEN:] + best[SEEN:SIZE]]
    wanted[6:8] = np.clip(wanted[6:8], ranges[:, 0], ranges[:, 1])
    np.testing.assert_allclose(child.belief.mean, wanted, rtol=1e-3, atol=1e-4)
    square = 200.0 + 0.5 * at @ precision @ at - 0.5 * push @ best
    size = 0.5 * np.linalg.slogdet(whole)[1] + 0.5 * np.linalg.slogdet(covariance)[1]
    assert child.belief.log_weight == pytest.approx(-1.0 - square - size, abs=0.02)


@cache
def library():
    return known_craft(CONFIG, prepare_targets(CONFIG), spacing_deg=20.0)


@cache
def flight(airframe="quad_x"):
    shot = draw_scenario(CONFIG, 5, SLOTS, airframe)
    pose = shot.rotations, shot.positions
    return shot, channels_along(CONFIG, shot.airframe, *pose, shot.permittivity, shot.conductivity)


@pytest.fixture(autouse=True)
def whole_search_is_made_up(monkeypatch):
    """The whole search has tests of its own (test_inference.py). Here it says of every craft that it flies nearly as
    the one of :func:`flight` does in the nearest slot."""

    def search(library, statistics, prior, *, key, level):
        shot, _ = flight()
        slot = int(np.argmin(np.linalg.norm(shot.positions - np.asarray(statistics.centre), axis=1)))
        shift = np.random.default_rng(slot).normal(size=3) * 0.01
        crafts = len(library.targets)
        alike = np.ones(crafts)
        modes = Hypotheses(
            craft=np.arange(crafts),
            rotation=np.tile(shot.rotations[slot], (crafts, 1, 1)),
            position=np.tile(shot.positions[slot] + shift, (crafts, 1)),
            permittivity=shot.permittivity * alike,
            conductivity=shot.conductivity * alike,
            weight=alike / crafts,
            residual=alike,
            covariance=np.zeros((crafts, 8, 8)),
        )
        return replace(made_up_posterior(shot.positions[slot], crafts=crafts), hypotheses=modes)

    monkeypatch.setattr(follow, "find_craft", search)


def strange(channels):
    """Symmetric channels that no craft has: so few antennas cannot always tell a real one from another."""
    real, imag = np.random.default_rng(4).normal(size=(2, *channels.shape)).astype(np.float32)
    drawn = real + 1j * imag
    return jnp.asarray(np.float32(np.abs(channels).mean()) * (drawn + np.swapaxes(drawn, -1, -2)))


def followed(channels, airframe="quad_x"):
    shot, lines = flight(airframe)[0], []
    return follow_flight(library(), CONFIG, shot, channels, seed=2, snr_db=30.0, progress=lines.append), lines


@pytest.fixture(scope="module")
def kept():
    """What flights left, for the tests that come after the first."""
    return {}


def test_a_flight_is_followed(kept):
    found, lines = kept["flown"] = followed(flight()[1])
    steps, track = found.steps, found.track
    assert [step.detected for step in steps] == [True] * 3 + [False] * (SLOTS - 3)
    assert steps[0].searched and not any(step.lost for step in steps)
    error = np.linalg.norm(track.estimated_position - track.position, axis=1)
    missed = np.linalg.norm(track.predicted - track.position, axis=1)
    # of four flights the last four slots erred by 3 to 8 cm, were expected to by 3 to 7, and were predicted to 2 to 20
    assert error[3:].mean() < 0.15 < missed[:3].mean()
    assert error[3:].mean() < 3.0 * np.mean([step.expected_error_m for step in steps[3:]])
    assert missed[3:].max() < 0.4  # the past says where to listen
    assert all(step.craft_probability[found.craft] > 0.9 for step in steps[3:])
    np.testing.assert_allclose(track.estimated_position[-1], steps[-1].mean_position, atol=1e-6)
    assert any("s left" in line for line in lines)


def test_a_slot_is_listened_to_where_the_past_says():
    """Where the slots of a flight are listened to does not change with what is heard there or later."""
    channels = flight()[1]
    changed = jnp.concatenate([channels[:4], channels[4:] * 0.5])
    first, second = (followed(each)[0].track.predicted for each in (channels, changed))
    np.testing.assert_array_equal(first[:5], second[:5])


def test_a_craft_that_is_lost_is_told_and_found_again():
    channels = flight()[1]
    found, _ = followed(channels.at[4].set(strange(channels)[4]))
    lost, back = found.steps[4:6]
    assert lost.lost and lost.searched and not lost.explained and not lost.detected
    assert lost.expected_error_m > 0.3  # it does not claim to know
    assert back.detected and back.searched and not back.lost
    assert np.argmax(back.craft_probability) == found.craft
    assert not any(step.lost for step in found.steps[:4])
    scores = evaluation.score_flown(found, CONFIG, 0.25)
    told = scores["slots"][4]
    assert told["lost"] and told["search"]["craft"] is None and scores["summary"][0]["lost"] == 1


def test_an_unknown_craft_is_told_to_be_unknown():
    found, _ = followed(strange(flight("octo")[1]), "octo")
    assert found.craft is None
    assert not any(step.explained for step in found.steps)
    assert all(step.detected and step.lost for step in found.steps)
    scores = evaluation.score_flown(found, CONFIG, 0.25)
    assert scores["summary"][-1]["craft_accuracy"] is None and scores["summary"][-1]["explained"] == 0.0


def test_the_command_tells_of_slots_and_draws_them(kept, tmp_path, monkeypatch, capsys):
    found, _ = kept["flown"] if "flown" in kept else followed(flight()[1])
    monkeypatch.setattr("august_jax.data.prepare_targets", lambda *_: [])
    monkeypatch.setattr("august_jax.inference.known_craft", lambda *_, **__: library())
    monkeypatch.setattr("august_jax.schemes.follow_flight", lambda *_, **__: found)
    monkeypatch.setattr("august_jax.data.channels_along", lambda *_: None)
    words = "track --preset smoke --airframe quad_x --seed 5 --slots 7 --style smooth --json --out"
    assert cli.main([*words.split(), str(tmp_path / "out")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["slots"]) == SLOTS and told["style"] == "smooth"
    assert {"position", "predicted", "estimate", "expected_error_m", "level", "search"} <= set(told["slots"][0])
    assert told["slots"][-1]["search"]["craft"] == "quad_x"
    assert [row["scheme"] for row in told["schemes"]][:2] == ["followed", "prediction"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(told["files"])


def test_a_lost_slot_is_in_the_picture(kept, tmp_path):
    found, _ = kept["flown"] if "flown" in kept else followed(flight()[1])
    scores = evaluation.score_flown(found, CONFIG, 0.25)
    scores["slots"][2]["lost"] = True
    plotting.flight(found.track, scores["slots"], tmp_path / "track.png", title="made up")
    assert (tmp_path / "track.png").stat().st_size > 50_000


def test_what_cannot_be_followed_is_refused():
    shot = draw_scenario(CONFIG, 5, 3, "quad_x")
    with pytest.raises(ValueError, match=r"slots: 3 is too short .* give 4 or more"):
        follow_flight(library(), CONFIG, shot, jnp.zeros((3, 1, 32, 32), jnp.complex64), seed=0, snr_db=20.0)
    follower = Follower(library())
    with pytest.raises(ValueError, match=r"detection: .*nan.* give \(x, y, z\)"):
        follower.place(np.array([np.nan, 6.0, 3.0]))
    place = follower.place(np.array([5.0, 6.0, 3.0]))
    orders = library().subspace.orders
    nothing = np.zeros((1, orders, orders), np.complex64)
    statistics = follow.Statistics(nothing, nothing, place + np.float32(0.1))
    with pytest.raises(ValueError, match="statistics: heard about .* place"):
        follower.hear(statistics)
    with pytest.raises(ValueError, match="statistics: heard about .*nan"):
        follower.hear(statistics._replace(centre=place * np.float32(np.nan)))
    with pytest.raises(ValueError, match="statistics: received .* not finite"):
        follower.hear(statistics._replace(received=nothing * np.nan, centre=place))
    with pytest.raises(ValueError, match="statistics: pilots has shape .* tones and array"):
        follower.hear(statistics._replace(pilots=nothing[:, :-1], centre=place))
