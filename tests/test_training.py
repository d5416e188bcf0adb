"""The training step and the run around it: it learns, it continues to the same numbers, it stops when it must."""

import errno
import json
import re
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from august_jax.app.cli.messages import told
from august_jax.config import preset
from august_jax.data.fields import Batch
from august_jax.files import DamagedFile, read_npz
from august_jax.models import reconstruct
from august_jax.signal.roi import Coefficients
from august_jax.training import Checkpoints, compiled_step, initial_state, load_weights, not_finite, save_weights, train
from august_jax.training.checkpoint import flatten, warm_start

SMOKE = preset("smoke")
MODEL = replace(
    SMOKE.model,
    channel_features=8,
    encoder_features=16,
    encoder_layers=1,
    latent=4,
    fourier=1,
    flow_layers=2,
    flow_features=8,
    denoiser=(16, 16),
    steps=20,
)
CONFIG = replace(
    SMOKE,
    array=replace(SMOKE.array, nx=5, nz=4),
    model=MODEL,
    train=replace(SMOKE.train, steps=4, batch=8, points=8, log_every=1, save_every=2),
)
ORDERS = 15
ROWS, COLUMNS = np.triu_indices(ORDERS)
GAIN = np.random.default_rng(5).normal(size=(len(ROWS), 3, 2)) @ np.array([0.05, 0.05j])
"""What each coefficient gains per unit of offset, beside a leading one of 1: a stand-in for physics."""


def next_batch(step, count=CONFIG.train.batch):
    """A flat square shifted by an offset that the channel tells linearly, under an unknown phase."""
    generator = np.random.default_rng(step)
    offset = generator.uniform(-0.6, 0.6, (count, 3))
    channel = np.zeros((count, 1, ORDERS, ORDERS), complex)
    channel[:, 0, ROWS, COLUMNS] = offset @ GAIN.T
    channel[:, 0, 0, 0] = 1.0
    channel = (channel + np.swapaxes(channel, -1, -2)) * np.exp(2j * np.pi * generator.uniform(size=(count, 1, 1, 1)))
    cloud = np.full((count, 12, 5), 0.5)
    cloud[..., :2] = generator.uniform(-0.2, 0.2, (count, 12, 2))
    cloud[..., 2] = 0.0
    cloud[..., :3] += offset[:, None]
    predicted = np.tile(np.float32([5, 6, 3]), (count, 1))
    return Batch(
        predicted,
        np.full(count, 20.0, np.float32),
        cloud.astype(np.float32),
        coefficients=Coefficients((1e-6 * channel).astype(np.complex64), predicted),
    )


def same(one, two):
    for name, leaf in flatten(one._replace(key=jax.random.key_data(one.key))).items():
        other = flatten(two._replace(key=jax.random.key_data(two.key)))[name]
        np.testing.assert_array_equal(leaf, other, err_msg=name)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    lines, drawn = [], []
    state = train(
        CONFIG,
        next_batch,
        folder,
        progress=lines.append,
        draw=lambda *paths: drawn.append(paths),
        validate=lambda graphdef, arrays, done: {"position_error": done / 100},
    )
    return folder, state, lines, drawn


def test_a_run_leaves_its_configuration_metrics_weights_and_checkpoints(finished):
    folder, state, lines, drawn = finished
    assert int(state.step) == 4
    metrics = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in metrics] == [1, 2, 3, 4]
    assert {"loss", "position", "material", "latent", "gradient", "samples_per_s"} <= set(metrics[0])
    assert [line.get("position_error") for line in metrics] == [None, 0.02, None, 0.04]
    assert drawn == [(folder / "metrics.jsonl", folder / "curves.png")] * 2
    assert any(line.startswith("step 4/4") and "left" in line for line in lines)
    _, arrays = load_weights(folder / "weights.npz", CONFIG)
    np.testing.assert_array_equal(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(arrays)]), state.ema)


def test_a_run_continued_after_an_interruption_ends_in_the_same_numbers(finished, tmp_path):
    folder, state, *_ = finished

    def interrupted(step):
        if step == 3:
            raise ConnectionError("power cut")
        return next_batch(step)

    with pytest.raises(ConnectionError):
        train(CONFIG, interrupted, tmp_path)
    stale = tmp_path / "checkpoints" / "3.orbax-checkpoint-tmp"  # what kill -9 leaves of a save
    stale.mkdir()
    lines = []
    again = train(CONFIG, next_batch, tmp_path, progress=lines.append)
    assert lines[0] == "continuing from step 2 of 4"
    assert not stale.exists()
    same(again, state)
    kept = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    whole = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [(line["step"], line["loss"]) for line in kept] == [(line["step"], line["loss"]) for line in whole]

    lines.clear()
    same(train(CONFIG, next_batch, tmp_path, progress=lines.append, weights=folder / "weights.npz"), state)
    assert "other weights are for new runs" in lines[0]
    with pytest.raises(ValueError, match="train.steps: 3 is less than the 4 steps"):
        train(replace(CONFIG, train=replace(CONFIG.train, steps=3)), next_batch, tmp_path, progress=lines.append)
    other = replace(CONFIG, model=replace(MODEL, latent=5))
    with pytest.raises(ValueError, match="model.latent: the run in .* was started with 4, now it is 5"):
        train(other, next_batch, tmp_path)


def test_a_damaged_checkpoint_is_named_and_the_one_before_serves(finished, tmp_path):
    folder, state, *_ = finished
    shutil.copytree(folder, tmp_path / "run")
    for path in (tmp_path / "run" / "checkpoints" / "4").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(ValueError, match="checkpoints/4: the checkpoint cannot be read .*; remove that folder"):
        train(CONFIG, next_batch, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "4")
    lines = []
    same(train(CONFIG, next_batch, tmp_path / "run", progress=lines.append), state)
    assert lines[0] == "continuing from step 2 of 4"


def test_weights_without_a_checkpoint_are_set_aside_and_never_written_over(finished, tmp_path):
    """They may be the only copy; a run that was stopped before its first checkpoint does not put it at risk."""
    original = (finished[0] / "weights.npz").read_bytes()
    (tmp_path / "weights.npz").write_bytes(original)
    (tmp_path / "metrics.jsonl").write_text('{"step": 9}\n')
    (tmp_path / "config.yaml").write_text("another: configuration\n")
    lines = []

    def killed(*_):
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train(CONFIG, next_batch, tmp_path, progress=lines.append, validate=killed)
    assert "weights.npz of the run before is now weights.previous.npz" in "\n".join(lines)
    assert (tmp_path / "weights.previous.npz").read_bytes() == original
    assert (tmp_path / "metrics.previous.jsonl").read_text() == '{"step": 9}\n'
    assert (tmp_path / "config.previous.yaml").read_text() == "another: configuration\n"
    assert {"weights.npz", "weights.previous-2.npz", "config.previous-2.yaml", "metrics.previous-2.jsonl"} <= {
        path.name for path in tmp_path.iterdir()
    }


def poisoned(step):
    """A cloud with NaN in two samples of the third step, and a channel with infinity in one."""
    batch = next_batch(step)
    if step == 2:
        batch.cloud[[3, 5], 4:, 4] = np.nan
        batch.coefficients.values[6, 0, 1, 1] = np.inf
    return batch


@pytest.mark.parametrize("log_every", [1, 4])
def test_a_batch_that_is_not_finite_stops_the_run_is_told_and_kept(finished, tmp_path, log_every):
    """Seen up to ``log_every`` steps later; mended, the run goes on to the numbers of one that met no such batch."""
    seldom = replace(CONFIG, train=replace(CONFIG.train, log_every=log_every))
    for _ in range(2):  # going on meets it again
        with pytest.raises(FloatingPointError) as caught:
            train(seldom, poisoned, tmp_path)
    text = str(caught.value)
    assert re.match(r"training: step 3 gave .* not finite in .*loss, .*material", text)
    assert "of cloud 16 in 2 of 8 rows, first in row 3; of coefficients.values 1 in 1 of 8 rows, first in row 6" in text
    assert "goes on from step 2" in text
    assert len(told(caught.value).splitlines()) <= 6
    kept = tmp_path / "not-finite-step-3.npz"
    assert str(kept) in text
    batch, arrays = poisoned(2), read_npz(kept)
    assert list(arrays) == ["predicted", "snr_db", "cloud", "coefficients.values", "coefficients.centre"]
    np.testing.assert_array_equal(arrays["cloud"], batch.cloud)
    np.testing.assert_array_equal(arrays["coefficients.values"], batch.coefficients.values)
    assert {path.name for path in tmp_path.iterdir()} == {
        "checkpoints", "config.yaml", "metrics.jsonl", "weights.npz", kept.name
    }  # fmt: skip
    same(train(seldom, next_batch, tmp_path), finished[1])


def test_a_loss_that_diverges_on_finite_data_is_told_as_such(tmp_path):
    def far_out(config):
        layout, state = initial_state(config)
        return layout, state._replace(params=1e30 * state.params)

    with pytest.raises(FloatingPointError, match="its batch is finite(.|\n)*lower train.learning_rate") as caught:
        train(CONFIG, next_batch, tmp_path, begin=far_out)
    assert "step 1 gave" in str(caught.value) and "go on from the start" in str(caught.value)
    np.testing.assert_array_equal(read_npz(tmp_path / "not-finite-step-1.npz")["cloud"], next_batch(0).cloud)


def test_a_batch_that_finds_no_room_does_not_hide_the_step(tmp_path, monkeypatch):
    def full(path, batch):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(not_finite, "keep_batch", full)
    with pytest.raises(FloatingPointError, match="step 3 gave .* cannot be kept in .*No space left.*make room"):
        train(CONFIG, poisoned, tmp_path)


def test_a_validation_that_is_not_finite_stops_the_run(tmp_path):
    with pytest.raises(FloatingPointError, match="after step 2 the validation .* not finite in position_error;"):
        train(CONFIG, next_batch, tmp_path, validate=lambda *_: {"position_error": float("nan"), "other": 1.0})


def test_a_step_clips_decays_and_averages():
    """The first Adam step moves every heard parameter by the learning rate; the average starts with weight 2/11."""
    layout, state = initial_state(CONFIG)
    before = np.asarray(state.params)
    state, numbers = compiled_step(layout.loss, CONFIG.train, state, next_batch(0))
    moved = np.asarray(state.params) - before
    heard = np.abs(moved) > 0
    # |g|/(|g| + 1e-8): full size unless a clipped gradient is as small as Adam's epsilon
    np.testing.assert_allclose(np.quantile(np.abs(moved[heard]), 0.95), CONFIG.train.learning_rate[0], rtol=1e-2)
    assert np.abs(moved).max() <= CONFIG.train.learning_rate[0] * (1 + 1e-3)
    np.testing.assert_allclose(np.asarray(state.ema) - before, moved * 9 / 11, atol=1e-6)
    assert np.isfinite(numbers["gradient"]) and int(state.step) == 1


def test_runs_of_one_process_share_their_compiled_step():
    """Equal losses, where methods of two objects are not: else each run kept a program of its own, 45 MiB."""
    one, other = (initial_state(CONFIG)[0].loss for _ in range(2))
    assert one == other and hash(one) == hash(other)
    wider = replace(CONFIG, model=replace(MODEL, latent=5))
    assert initial_state(wider)[0].loss != one


def test_training_learns_where_the_target_is():
    """A hundred and fifty steps from a channel that tells the offset: the cloud's mean follows it."""
    settings = replace(
        CONFIG,
        model=replace(MODEL, encoder_features=48, channel_features=32, denoiser=(32, 32)),
        train=replace(CONFIG.train, steps=150, batch=64, learning_rate=(5e-3, 1e-4)),
    )
    layout, state = initial_state(settings)
    for number in range(settings.train.steps):
        state, _ = compiled_step(layout.loss, settings.train, state, next_batch(number, 64))
    test = next_batch(10_000, 64)
    clouds = reconstruct(
        layout.graphdef,
        layout.arrays(np.asarray(state.ema)),
        jax.random.key(0),
        test.heard,
        test.predicted,
        test.snr_db,
        count=64,
        steps=8,
    )
    truth = test.cloud.mean(axis=1)[:, :3]
    error = np.sqrt(np.mean((np.asarray(clouds)[..., :3].mean(axis=1) - truth) ** 2))
    # not knowing anything gives 0.35, the offset's own spread
    assert error < 0.15, error


def test_weights_come_back_in_full_or_half_precision(tmp_path):
    layout, state = initial_state(CONFIG)
    arrays = layout.arrays(np.asarray(state.params))
    save_weights(tmp_path / "full.npz", arrays)
    save_weights(tmp_path / "bare", arrays)  # a name without the suffix is a name
    assert {path.name for path in tmp_path.iterdir()} == {"full.npz", "bare"}
    assert (tmp_path / "bare").read_bytes() == (tmp_path / "full.npz").read_bytes()
    save_weights(tmp_path / "half.npz", arrays, half=True)
    _, full = load_weights(tmp_path / "full.npz", CONFIG)
    _, half = load_weights(tmp_path / "half.npz", CONFIG)
    jax.tree.map(np.testing.assert_array_equal, full, arrays)
    # float16 keeps 11 bits; below 6e-5 it is subnormal
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2**-11, atol=6e-8), half, arrays)
    assert (tmp_path / "half.npz").stat().st_size < 0.8 * (tmp_path / "full.npz").stat().st_size
    with np.load(tmp_path / "full.npz") as stored:
        assert "denoiser.layers.0.gate.kernel" in stored.files and stored["format"] == 1
        np.savez(tmp_path / "first.npz", **{name: stored[name] for name in stored.files if name != "format"})
    # as version 0.1 wrote them
    jax.tree.map(np.testing.assert_array_equal, load_weights(tmp_path / "first.npz", CONFIG)[1], arrays)
    with pytest.raises(ValueError, match="not finite in float16; nothing written"):
        save_weights(tmp_path / "big.npz", jax.tree.map(lambda leaf: leaf + np.float32(1e6), arrays), half=True)
    assert not (tmp_path / "big.npz").exists()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"latent": 6}, r"has shape .*, the configuration wants"),
        ({"flow_layers": 3}, r"prior.conditioners.2.* is missing"),
        ({"flow_layers": 1}, r"prior.conditioners.1.* is not part of this configuration"),
    ],
)
def test_weights_of_another_configuration_are_refused(change, message, finished):
    with pytest.raises(ValueError, match=message):
        load_weights(finished[0] / "weights.npz", replace(CONFIG, model=replace(MODEL, **change)))


@pytest.fixture(scope="module")
def damaged(finished, tmp_path_factory):
    """Files of weights by what is wrong with them."""
    folder = tmp_path_factory.mktemp("damaged")
    with np.load(finished[0] / "weights.npz") as stored:
        arrays = dict(stored)
    name = "mean_head.layers.0.kernel"
    (folder / "torn.npz").write_bytes(b"PK\x03\x04 torn")
    np.savez(folder / "nan.npz", **arrays | {name: np.full_like(arrays[name], np.nan)})
    np.savez(folder / "infinite.npz", **arrays | {name: np.full(arrays[name].shape, 1e300)})
    np.savez(folder / "whole.npz", **arrays | {name: np.zeros(arrays[name].shape, int)})
    np.savez(folder / "alien.npz", nothing=np.zeros(3))
    np.savez(folder / "later.npz", **arrays | {"format": np.int32(2)})
    return folder


@pytest.mark.parametrize(
    "file, error, message",
    [
        ("missing", FileNotFoundError, "missing.npz"),
        ("torn", DamagedFile, "torn.npz: is damaged"),
        ("later", ValueError, r"later.npz: .*another version .*\(format 2, wanted 1\); train them again with `august"),
        ("nan", ValueError, "nan.npz: mean_head.layers.0.kernel holds NaN or infinity"),
        ("infinite", ValueError, "infinite.npz: mean_head.layers.0.kernel holds NaN or infinity"),
        ("whole", ValueError, "whole.npz: mean_head.layers.0.kernel holds int64 and no real numbers"),
        ("alien", ValueError, "alien.npz"),
    ],
)
@pytest.mark.parametrize("door", ["load_weights", "train"])
def test_a_wrong_file_of_weights_is_named_before_any_work(door, file, error, message, damaged, tmp_path):
    path = damaged / f"{file}.npz"
    with pytest.raises(error, match=message):
        if door == "load_weights":
            load_weights(path, CONFIG)
        else:
            train(CONFIG, next_batch, tmp_path / "run", weights=path)
    assert not (tmp_path / "run").exists()


def test_an_empty_folder_has_no_checkpoint(tmp_path):
    _, state = initial_state(CONFIG)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest is None
        with pytest.raises(ValueError, match="no checkpoint in"):
            checkpoints.restore(state)


def test_a_run_may_start_from_what_fits_of_another(tmp_path):
    layout, state = initial_state(CONFIG)
    _, other = initial_state(replace(CONFIG, train=replace(CONFIG.train, seed=3)))
    save_weights(tmp_path / "other.npz", layout.arrays(np.asarray(other.params)))
    started, kept = warm_start(layout, state, tmp_path / "other.npz")
    assert kept == []
    np.testing.assert_array_equal(started.params, other.params)
    np.testing.assert_array_equal(started.ema, other.params)

    wider, grown = initial_state(replace(CONFIG, model=replace(MODEL, denoiser=(24, 16))))
    started, kept = warm_start(wider, grown, tmp_path / "other.npz")
    assert kept and all(name.startswith("denoiser.layers") for name in kept)
    own, wanted = flatten(wider.arrays(np.asarray(started.params))), flatten(layout.arrays(np.asarray(other.params)))
    before = flatten(wider.arrays(np.asarray(grown.params)))
    for name, leaf in own.items():
        np.testing.assert_array_equal(leaf, before[name] if name in kept else wanted[name], err_msg=name)
