"""A measurement that is not finite: refused at every door, by the argument and the first row, before anything is made
of it. Training has its own tests (tests/test_training.py), the search too (tests/test_inference_refusals.py)."""

import importlib

import jax
import numpy as np
import pytest

from august_jax import data
from august_jax.app.cli.messages import told
from august_jax.config import override, preset
from august_jax.data.shards import ROW_SUMS, row_sums
from august_jax.files import read_json, sha256_of, write_json
from august_jax.models import create, reconstruct
from august_jax.physics import PlanarArray
from august_jax.schemes.polar import locate
from august_jax.signal import Coefficients, Statistics, estimate_channel, observe, observe_region
from august_jax.tracking.loss import silent

SMOKE = preset("smoke")
COUNT = SMOKE.array.count
CHANNEL = np.full((1, COUNT, COUNT), 1e-6, np.complex64)
PREDICTED = np.float32([5, 6, 3])
ORDERS = 7


def spoiled(array, *place, value=np.nan):
    array = np.array(array)
    array[place] = value
    return array


def samples(rows):
    """A craft that stays where it is, its channel ones."""
    count = len(rows)
    return data.Sample(
        position=np.ones((count, 3), np.float32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        permittivity=np.full(count, 3.0, np.float32),
        conductivity=np.full(count, 5e-3, np.float32),
        airframe=np.zeros(count, np.int32),
        flight=np.asarray(rows, np.int32),
        slot=np.zeros(count, np.int32),
        points=np.ones((count, 4, 3), np.float32),
        true_channel=np.ones((count, 1, COUNT * (COUNT + 1) // 2), np.complex64),
    )


def station(door, channel=CHANNEL, predicted=PREDICTED, **level):
    config = SMOKE
    return door(
        jax.random.key(0),
        channel,
        predicted,
        array=config.array,
        signal=config.signal,
        region=config.region,
        **(level or {"snr_db": 10.0}),
    )


DOORS = {
    f"{door.__name__} of {name}": (lambda door=door, change=change: station(door, **change), rf"{name}: holds NaN")
    for door in (observe, observe_region)
    for name, change in {
        "channel": {"channel": spoiled(CHANNEL, 0, 2, 3)},
        "predicted": {"predicted": spoiled(PREDICTED, 1, value=np.inf)},
        "snr_db": {"snr_db": float("nan")},
        "power_dbm": {"power_dbm": np.float32("inf")},
    }.items()
} | {
    "observe_region of coefficients": (
        lambda: station(
            observe_region, Coefficients(spoiled(np.zeros((1, ORDERS, ORDERS), np.complex64), 0, 0, 0), PREDICTED)
        ),
        "channel: holds NaN",
    ),
    "estimate_channel of received": (
        lambda: estimate_channel("ls", spoiled(CHANNEL[0], 1, 1), CHANNEL[0]),
        "received: holds NaN",
    ),
    "estimate_channel of pilots": (
        lambda: estimate_channel("ls", CHANNEL[0], spoiled(CHANNEL[0], 1, 1)),
        "pilots: holds NaN",
    ),
}


@pytest.mark.parametrize("name", DOORS)
def test_the_base_station_refuses_it(name):
    call, words = DOORS[name]
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("name", ["heard", "predicted", "snr_db"])
def test_the_networks_refuse_it(name):
    heard = {
        "heard": Coefficients(np.zeros((4, 1, ORDERS, ORDERS), np.complex64), np.tile(PREDICTED, (4, 1))),
        "predicted": np.tile(PREDICTED, (4, 1)),
        "snr_db": np.full(4, 20.0, np.float32),
    }
    heard[name] = jax.tree.map(lambda leaf: spoiled(leaf, [2, 3]), heard[name])
    with pytest.raises(ValueError, match=f"{name}: 2 of 4 slots hold NaN or infinity, the first is 2; leave them out"):
        reconstruct(*create(SMOKE, 0), jax.random.key(0), *heard.values(), count=8)


@pytest.mark.parametrize("column", ["true_channel", "position"])
def test_who_observes_samples_refuses_it(column):
    good = samples(np.arange(5))
    bad = good._replace(**{column: spoiled(getattr(good, column), 3, 0)})
    with pytest.raises(ValueError, match=f"samples: {column} holds NaN or infinity in 1 of 5 samples, the first is 3"):
        data.observed_anew(jax.random.key(0), bad, SMOKE)


def test_who_makes_samples_refuses_it_before_it_is_written(monkeypatch):
    module = importlib.import_module("august_jax.data.generate")
    config = override(SMOKE, ["data.solver=born", "target.points=20", "data.observed=false"])
    made = module._compiled

    def spoiling(keys, *rest):
        results = dict(made(keys, *rest))
        return results | {"true_channel": spoiled(results["true_channel"], 2)}

    monkeypatch.setattr(module, "_compiled", spoiling)
    words = "true_channel of 1 of 3 samples holds NaN or infinity, the first is row 2 "
    with pytest.raises(FloatingPointError, match=words):
        data.generate(config, [0, 1, 2], data.prepare_targets(config))  # of one flight, so of one craft


def test_a_point_is_not_looked_for_in_it():
    array, tones = PlanarArray(4, 2, 3e9), (3e9,)
    good = np.full((1, 8, 8), 1e-6, np.complex64)
    for channel, predicted, name in (
        (spoiled(good, 0, 1), PREDICTED, "channel"),
        (good, PREDICTED * np.nan, "predicted"),
    ):
        with pytest.raises(ValueError, match=f"{name}: holds NaN or infinity; leave that slot out"):
            locate(channel, predicted, array, tones, reach_m=0.5)


def test_an_echo_that_is_no_number_was_not_heard():
    """So that a track is begun anew, where one that kept it would hold it for good."""
    none = np.zeros((1, 7, 7), np.complex64)
    for received, heard in ((none, False), (none + 100.0, True), (spoiled(none + 100.0, 0, 3, 3), False)):
        assert bool(silent(Statistics(received, none, PREDICTED))) != heard


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A data set of 9 rows in 3 shards, with NaN in a channel of row 4, and with the sums of what it holds."""
    config = override(SMOKE, ["data.count=9", "data.shard_rows=3", "data.observed=false"])
    monkeypatch.setattr(data.shards, "generate", lambda config, rows, targets, **_: samples(rows))
    monkeypatch.setattr(data.shards, "prepare_targets", lambda config, progress: [])
    data.simulate(config, tmp_path)
    shard = tmp_path / "shard-00001"
    path = shard / "true_channel.npy"
    np.save(path, spoiled(np.load(path), 1, 0, 5))
    meta = read_json(shard / "meta.json")
    sums = np.load(shard / ROW_SUMS)
    sums[:, list(meta["arrays"]).index("true_channel")] = row_sums(np.load(path))
    np.save(shard / ROW_SUMS, sums)
    meta["arrays"]["true_channel"]["sha256"], meta["row_sums"] = sha256_of(path), sha256_of(shard / ROW_SUMS)
    write_json(shard / "meta.json", meta)
    return tmp_path


def test_who_reads_a_data_set_is_told_the_row(folder):
    """No sum tells it: it was written so."""
    dataset = data.Dataset(folder)
    assert dataset.read(np.array([3, 5, 8])).rows == 3
    words = r"shard-00001: true_channel.npy holds NaN or infinity in 1 of 2 rows, the first is row 4 of the data"
    advice = r", as they were written\nremove that shard, and make it again: august simulate --out"
    with pytest.raises(data.DataError, match=words + advice) as caught:
        dataset.read(np.array([5, 4, 0]))
    assert len(told(caught.value).splitlines()) <= 6
