"""The scheme that searches: how it puts a posterior into an answer, and when it leaves the word to the networks."""

import jax
import numpy as np
import pytest
from made_up_posterior import MadeUpLibrary, made_up_posterior, search_is_made_up

from august_jax.config import preset
from august_jax.evaluation import metrics
from august_jax.models import Networks, create
from august_jax.scene import procedural_airframe
from august_jax.schemes import SCHEMES, Setting, Slots, matched_field
from august_jax.signal import Coefficients, Statistics

CONFIG = preset("smoke")
NAMES = CONFIG.target.airframes
COUNT = 3


@pytest.fixture(scope="module")
def networks():
    return Networks("untrained", CONFIG, *create(CONFIG, 0))


@pytest.fixture
def slots():
    rng = np.random.default_rng(0)
    predicted = (np.array([5.0, 6.0, 3.0]) + rng.uniform(-0.5, 0.5, (COUNT, 3))).astype(np.float32)
    values = rng.normal(size=(COUNT, 1, 7, 7)) + 1j * rng.normal(size=(COUNT, 1, 7, 7))
    values = (values + values.swapaxes(-1, -2)).astype(np.complex64)
    said = Statistics(values, values, predicted)
    return Slots(predicted, np.full(COUNT, 20.0, np.float32), Coefficients(values, predicted), None, said)


@pytest.fixture
def ask(monkeypatch, unchecked):
    """Ask the scheme with posteriors about q_pre, of which ``unexplained`` slots have no explanation."""

    def asked(slots, networks=None, unexplained=()):
        search_is_made_up(monkeypatch, unexplained)
        setting = Setting(CONFIG, networks, None, jax.random.key(0), MadeUpLibrary(NAMES))
        return SCHEMES["matched_field"].prepare(setting)(jax.random.key(1), slots)

    return asked


def test_it_needs_known_craft_and_what_the_echo_says(ask, slots):
    assert SCHEMES["matched_field"].prepare(Setting(CONFIG, None, None, jax.random.key(0))) is None
    with pytest.raises(ValueError, match=r"slots: statistics are None.*observed_anew\(\.\.\., statistics=True\)"):
        ask(slots._replace(statistics=None))


def test_the_answer_is_the_posteriors(ask, slots):
    answer = ask(slots)
    expected = [made_up_posterior(centre) for centre in slots.predicted]
    np.testing.assert_allclose(answer.position, [each.mean_position for each in expected], atol=1e-6)
    np.testing.assert_allclose(answer.normal, [each.mean_normal for each in expected], atol=1e-6)
    np.testing.assert_allclose(answer.craft_probability, [each.craft_probability for each in expected], rtol=1e-6)
    np.testing.assert_array_equal(answer.craft, 1)
    errors = [matched_field.expected_errors(each) for each in expected]
    np.testing.assert_allclose(np.stack([answer.expected_error_m, answer.expected_normal_error], 1), errors, rtol=1e-5)
    assert answer.explained.all() and answer.triple_normal is None
    np.testing.assert_allclose(answer.seconds, 1.5)


def test_it_is_under_its_own_name_and_repeats_itself_for_the_same_key(ask, slots):
    scheme = SCHEMES["matched_field"]
    assert scheme.name == "matched_field" and scheme.label and scheme.hears and scheme.slow
    jax.tree.map(np.testing.assert_array_equal, ask(slots), ask(slots))


def test_samples_are_equally_probable(ask, slots):
    """Systematic resampling: a row comes as often as its weight says, to within one."""
    answer, made = ask(slots), made_up_posterior(slots.predicted[0])
    apart = np.linalg.norm(answer.samples[0][:, None] - made.position[None].astype(np.float32), axis=-1)
    times = np.bincount(np.argmin(apart, axis=1), minlength=len(made.craft))
    assert np.abs(times - matched_field.SAMPLES * made.weights).max() <= 1.0


def test_the_cloud_is_one_craft_in_the_pose_of_the_most_probable_hypothesis(ask, slots):
    answer = ask(slots)
    modes = made_up_posterior(slots.predicted[0]).hypotheses
    body = (answer.cloud.points[0] - modes.position[0]) @ modes.rotation[0]
    surface = np.asarray(procedural_airframe(NAMES[1]).sample_surface(jax.random.key(9), 20_000))
    assert float(np.sqrt(metrics.nearest_squared(body, surface).max())) < 0.02  # 20,000 points lie a centimetre apart
    assert answer.cloud.points.shape == (COUNT, CONFIG.target.points, 3)
    np.testing.assert_allclose(answer.cloud.permittivity, 2.0)
    np.testing.assert_allclose(answer.cloud.conductivity, 4e-3)


def test_where_no_known_craft_explains_the_echo_the_networks_answer(ask, slots, networks):
    answer, sure = ask(slots, networks, unexplained=(1,)), ask(slots, networks)
    assert answer.explained.tolist() == [True, False, True] and answer.craft.tolist() == [1, -1, 1]
    same = [0, 2]
    assert np.isnan(answer.expected_error_m[1]) and np.isnan(answer.expected_normal_error[1])
    for field in ("position", "normal", "samples", "expected_error_m", "expected_normal_error"):
        np.testing.assert_array_equal(getattr(answer, field)[same], getattr(sure, field)[same])
    # theirs is a cloud of many materials, and its mean the position
    np.testing.assert_allclose(answer.position[1], answer.cloud.points[1].mean(axis=0), atol=1e-5)
    assert np.std(answer.cloud.permittivity[1]) > 0.0 and np.isnan(answer.samples[1]).all()
    # without networks the search is all there is
    alone = ask(slots, None, unexplained=(1,))
    assert alone.craft.tolist() == [1, -1, 1] and np.isfinite(alone.samples).all()
    np.testing.assert_array_equal(alone.position, sure.position)
