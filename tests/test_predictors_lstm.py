"""The corrected filter: what its network hears and answers, what it gains on flights, and how it is trained."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from august_jax import streams
from august_jax.app import cli
from august_jax.config import ConfigError, FlightConfig, override, preset, to_yaml
from august_jax.files import DamagedFile
from august_jax.models.weights import flatten
from august_jax.scene import fly_many
from august_jax.tracking import Kalman, KalmanLSTM, predict_next
from august_jax.tracking.predictors.lstm import (
    FEATURES,
    SHIPPED,
    UNITS,
    WEIGHTS,
    WINDOW,
    Corrector,
    MotionLSTM,
    create_motion,
    expect,
)
from august_jax.training import save_weights
from august_jax.training.predictor import (
    NOISE_M,
    SLOTS,
    STYLES,
    WIDER,
    PredictorBatches,
    split_flights,
    train_predictor,
)

FLIGHT = FlightConfig(style="dynamic")
FILTER = Kalman.for_flight(FLIGHT)
SMOKE = override(preset("smoke"), ["train.steps=4", "train.batch=7", "train.log_every=1", "train.save_every=2"])


def network(seed, gain=0.3):
    """One whose answer is not zero."""
    graphdef, state = create_motion(seed)
    draw = np.random.default_rng(seed)
    return Corrector(graphdef, jax.tree.map(lambda leaf: leaf + gain * draw.normal(size=leaf.shape), state))


def walk(seed, slots):
    return jnp.asarray(np.cumsum(np.random.default_rng(seed).normal(size=(slots, 3)), axis=0), jnp.float32)


def test_the_cell_is_what_the_docstring_says():
    """A twin in NumPy, one slot after the other."""
    own = network(3)
    arrays = {name: np.asarray(leaf, float) for name, leaf in flatten(own.state).items()}
    window = np.random.default_rng(0).normal(size=(2, WINDOW, FEATURES))

    def logistic(value):
        return 1.0 / (1.0 + np.exp(-value))

    for one, answer in zip(window, nnx.merge(own.graphdef, own.state)(jnp.asarray(window, jnp.float32))):
        cell, output = np.zeros(UNITS), np.zeros(UNITS)
        for heard in one:
            gates = np.concatenate([heard, output]) @ arrays["gates.kernel"] + arrays["gates.bias"]
            enter, keep, new, leave = np.split(gates, 4)
            cell = logistic(keep + 1.0) * cell + logistic(enter) * np.tanh(new)
            output = logistic(leave) * np.tanh(cell)
        np.testing.assert_allclose(answer, output @ arrays["answer.kernel"] + arrays["answer.bias"], atol=1e-4)


def test_nothing_is_corrected_before_the_window_is_full():
    predictor, path = KalmanLSTM(FILTER, network(0)), walk(1, WINDOW + 2)
    for known in (1, WINDOW - 1, WINDOW, WINDOW + 2):
        made, filtered = (predict_next(each, path[:known]) for each in (predictor, FILTER))
        apart = np.linalg.norm(made.position - filtered.position)
        assert apart == 0.0 if known < WINDOW else apart > 1e-3, known
        np.testing.assert_allclose(made.covariance, filtered.covariance, rtol=1e-6)  # it stays the filter's


def test_an_untrained_network_leaves_the_filter_as_it_is():
    path = walk(2, 20)
    made = predict_next(KalmanLSTM(FILTER, Corrector(*create_motion(5))), path)
    np.testing.assert_array_equal(made.position, predict_next(FILTER, path).position)


def test_the_network_hears_surprises_velocities_and_accelerations_of_the_last_slots():
    """Against the filter's own states: metres a slot, in units of the innovation that it expects next."""
    predictor, path = KalmanLSTM(FILTER, network(0)), walk(3, 14)
    course, motion, rows = predictor.start(path[0]), FILTER.start(path[0]), []
    for place in path[1:]:
        course = predictor.update(predictor.predict(course)[0], place)
        ahead, expected = FILTER.predict(motion)
        motion = FILTER.update(ahead, place)
        slot = FILTER.slot_s
        rows.append(np.concatenate([place - expected.position, slot * motion.mean[1], slot**2 * motion.mean[2]]))
    _, expected, heard, scale = expect(FILTER, course)
    np.testing.assert_allclose(scale, np.sqrt(np.trace(expected.covariance) / 3.0), rtol=1e-5)
    np.testing.assert_allclose(heard, np.array(rows[-WINDOW:]) / scale, rtol=1e-3, atol=1e-4)


def test_it_is_a_static_argument_and_a_pytree():
    """Equal where filter and network are the same, so that nothing compiles twice; gradients reach the network."""
    shipped = KalmanLSTM.for_flight(FLIGHT)
    again = KalmanLSTM.for_flight(replace(FLIGHT, slots=7))
    assert shipped == again and hash(shipped) == hash(again) and shipped != KalmanLSTM.for_flight(FlightConfig())
    path = walk(4, 12)
    traced = []

    def miss(predictor):
        traced.append(predictor)
        return jnp.sum(predict_next(predictor, path).position ** 2)

    compiled = jax.jit(miss, static_argnums=0)
    np.testing.assert_allclose(compiled(shipped), compiled(again))
    assert len(traced) == 1
    slope = jax.jit(jax.grad(miss))(shipped)
    assert all(np.any(np.asarray(leaf) != 0.0) for leaf in jax.tree.leaves(slope))


def errors(predictor, seen, true):
    made = jax.jit(jax.vmap(jax.vmap(lambda past: predict_next(predictor, past).position)))(seen)
    return np.mean(np.linalg.norm(made - true, axis=-1))


# The most that may be left of the filter's mean error; a thousand flights leave 0.72, 0.53 and 0.59.
@pytest.mark.parametrize("style, noise_m, most", [("dynamic", 0.1, 0.85), ("dynamic", 0.3, 0.75), ("jump", 0.1, 0.75)])
def test_the_shipped_weights_gain_on_agile_flights(style, noise_m, most):
    """In the box of `laptop`, on flights of a stream that nothing is trained on."""
    flight = replace(preset("laptop").flight, style=style, slots=24)
    true = fly_many(jax.random.split(streams.key(7, "evaluate.flight"), 64), flight).positions
    seen = true + noise_m * np.random.default_rng(1).normal(size=true.shape)
    pasts = np.stack([seen[:, end - 16 : end] for end in (16, 20, 23)], axis=1).astype(np.float32)
    nexts = np.stack([true[:, end] for end in (16, 20, 23)], axis=1)
    root = {kind.__name__: errors(kind.for_flight(flight), pasts, nexts) for kind in (Kalman, KalmanLSTM)}
    assert root["KalmanLSTM"] < most * root["Kalman"], root


@pytest.fixture(scope="module")
def flown():
    return split_flights(SMOKE)


def test_training_and_validation_fly_apart_in_both_boxes(flown):
    known, others = flown
    assert known.shape == (len(STYLES), 2 * 28, SLOTS, 3) and others.shape == (len(STYLES), 2 * 3, SLOTS, 3)
    firsts = np.concatenate([known, others], axis=1)[:, :, 0].reshape(-1, 3)
    assert len(np.unique(firsts, axis=0)) == len(firsts)
    box = np.array(SMOKE.flight.box_m)
    middle, half = box.mean(axis=1), 0.5 * np.ptp(box, axis=1)
    away = np.abs(known - middle).max(axis=(2,)) / half
    narrow, wide = np.split(away, 2, axis=1)
    assert narrow.max() <= 1.0 + 1e-5 < wide.max() <= WIDER + 1e-5


def test_a_step_s_histories_are_those_of_the_predictor(flown):
    """Noise of the stated size, an equal share of each style, the same for the same step."""
    batches = PredictorBatches(SMOKE, flown[0], count=300)
    batch, same, other = batches(3), batches(3), batches(4)
    np.testing.assert_array_equal(batch.windows, same.windows)
    assert np.any(np.asarray(batch.windows) != np.asarray(other.windows))
    assert batch.windows.shape == (300, WINDOW, FEATURES) and batch.wanted.shape == (300, 3)
    # the first third is smooth: another filter, which expects less
    assert np.asarray(batch.scale)[:100].max() < np.asarray(batch.scale)[100:].min()
    # what is wanted is what the filter misses by: decimetres on smooth flights, metres on jumps
    missed = np.asarray(batch.scale) * np.linalg.norm(batch.wanted, axis=-1)
    assert missed[200:].mean() > 2.0 * missed[:100].mean() > 2.0 * NOISE_M[0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("predictor")
    lines = []
    return folder, train_predictor(SMOKE, folder, progress=lines.append), lines


def test_a_run_leaves_a_predictor(finished):
    folder, state, lines = finished
    assert int(state.step) == 4 and any(line.startswith("step 4/4") and "left" in line for line in lines)
    assert {"predictor.npz", "config.yaml", "metrics.jsonl", "checkpoints"} == {path.name for path in folder.iterdir()}
    own = KalmanLSTM.for_flight(FLIGHT, folder)
    np.testing.assert_array_equal(
        np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(own.corrector.state)]), state.ema
    )
    assert np.any(predict_next(own, walk(5, 12)).position != predict_next(FILTER, walk(5, 12)).position)


def test_the_command_continues_a_predictor_and_says_what_is_next(finished, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(finished[0], folder)
    words = ["train", "--target", "predictor", "--preset", "smoke", "--out", str(folder)]
    words += ["train.steps=4", "train.batch=7", "train.log_every=1", "train.save_every=2"]
    assert cli.main(words) == 0
    told = capsys.readouterr()
    assert "continuing from step 4 of 4" in told.err
    assert f"written to {folder}/: predictor.npz" in told.out and "experiments/prediction.py compute --run" in told.out
    assert cli.main(["train", "--preset", "smoke", "--out", str(folder), "train.source=stream"]) == 2
    assert f"--out: {folder} holds a predictor (predictor.npz); choose another" in capsys.readouterr().err
    (folder / "predictor.npz").rename(folder / "weights.npz")
    assert cli.main(words) == 2
    assert f"--out: {folder} holds networks (weights.npz); choose another" in capsys.readouterr().err


def test_a_run_continued_ends_in_the_same_numbers(finished, tmp_path, monkeypatch):
    whole = np.asarray(finished[1].params)
    drawn = PredictorBatches.__call__

    def cut(self, step):
        if step == 3:
            raise ConnectionError("power cut")
        return drawn(self, step)

    with monkeypatch.context() as patched, pytest.raises(ConnectionError):
        patched.setattr(PredictorBatches, "__call__", cut)
        train_predictor(SMOKE, tmp_path)
    lines = []
    state = train_predictor(SMOKE, tmp_path, progress=lines.append)
    assert "continuing from step 2 of 4" in lines
    np.testing.assert_array_equal(state.params, whole)


def test_a_box_without_room_is_refused():
    tight = override(SMOKE, ["flight.box_m=[[3,3.01],[4,4.01],[2,2.01]]"])
    with pytest.raises(ValueError, match=r"flight.box_m: .* enlarge the box"):
        split_flights(tight)


def _weights(folder, arrays):
    (folder / "config.yaml").write_text(to_yaml(SMOKE))
    np.savez(folder / WEIGHTS, **arrays)


def test_wrong_weights_are_named_with_the_way_out(tmp_path):
    whole = {name: np.asarray(leaf) for name, leaf in flatten(create_motion(0)[1]).items()}
    with pytest.raises(ValueError, match=r"run: .*predictor.npz is not there; give what august train wrote"):
        KalmanLSTM.for_flight(FLIGHT, tmp_path)
    _weights(tmp_path, {"alien": np.zeros(3)})
    with pytest.raises(ValueError, match="run: .* holds no predictor of 64 units"):
        KalmanLSTM.for_flight(FLIGHT, tmp_path)
    _weights(tmp_path, whole | {"answer.bias": np.full(3, np.nan)})
    with pytest.raises(ValueError, match=r"answer.bias holds NaN or infinity"):
        KalmanLSTM.for_flight(FLIGHT, tmp_path)
    _weights(tmp_path, whole)
    KalmanLSTM.for_flight(FLIGHT, tmp_path)
    with pytest.raises(ValueError, match=r"flight.slot_s: 0.1 s, but the predictor was trained with slots of 0.2 s"):
        KalmanLSTM.for_flight(replace(FLIGHT, slot_s=0.1), tmp_path)
    (tmp_path / WEIGHTS).write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(DamagedFile, match="is damaged"):
        KalmanLSTM.for_flight(FLIGHT, tmp_path)
    (tmp_path / WEIGHTS).unlink()
    save_weights(tmp_path / WEIGHTS, create_motion(0)[1], half=True)
    (tmp_path / "config.yaml").write_text("flight: 3")
    with pytest.raises(ConfigError, match="config.yaml"):
        KalmanLSTM.for_flight(FLIGHT, tmp_path)


def test_the_shipped_weights_are_small_and_of_this_network():
    assert (SHIPPED / WEIGHTS).stat().st_size < 100_000
    assert isinstance(nnx.merge(*(lambda own: (own.graphdef, own.state))(Corrector.read(SHIPPED))), MotionLSTM)
