"""Samples from a key to a batch: independence of the order, the disk format, interruptions, splits, observing anew."""

import json
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from august_jax import data
from august_jax.config import override, preset
from august_jax.physics import PlanarArray, contrast, sensing_channel

CONFIG = override(preset("smoke"), ["data.count=48", "data.shard_rows=20"])


@pytest.fixture(scope="module")
def targets():
    return data.prepare_targets(CONFIG)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    data.simulate(CONFIG, folder)
    return folder


def test_a_sample_depends_on_its_number_alone(folder, targets):
    stored = data.Dataset(folder).read(np.array([41, 3]))
    alone = data.generate(CONFIG, [3], targets)
    for name, value in alone.items():
        np.testing.assert_allclose(stored[name][1], value[0], rtol=1e-4, atol=1e-5 * np.abs(value).max(), err_msg=name)


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_the_channel_is_that_of_the_cells_in_that_pose(targets):
    sample = {name: value[0] for name, value in data.generate(CONFIG, [9], targets).items()}
    cells = targets[sample["airframe"]].cells
    chi = contrast(float(sample["permittivity"]), float(sample["conductivity"]), CONFIG.array.frequency_hz)
    with jax.enable_x64(True):
        moved = cells.moved(sample["rotation"].astype(float), sample["position"].astype(float))
        array = PlanarArray(CONFIG.array.nx, CONFIG.array.nz, CONFIG.array.frequency_hz)
        exact = np.asarray(sensing_channel(array, moved, complex(chi)))
    channel = np.asarray(data.unpack(sample["channel"]))[0]
    # Rotations come in float32; the response itself is good to 3e-5.
    assert np.linalg.norm(channel - exact) < 2e-4 * np.linalg.norm(exact)


def test_the_paper_s_echo_lies_in_its_link_budget():
    """50 to 100 cm^3 of material and -3 to 30 dB from 10 to 40 dBm, so 12 to 15 dB in the middle."""
    paper = override(preset("paper"), ["target.airframes=[quad_x]", "data.solver=local_field_born",
                                       "signal.power_dbm=[25, 25]"])
    targets = data.prepare_targets(paper)
    cells = targets[0].cells
    assert 50e-6 < np.sum(cells.fill * cells.volumes) < 100e-6
    heard = data.generate(paper, np.arange(64) * paper.flight.slots, targets)["snr_db"]
    assert 10.0 < np.median(heard) < 17.0


def test_labels_lie_on_the_airframe_and_are_centred_on_the_position(folder):
    samples = data.Dataset(folder).read(np.arange(48))
    assert np.abs(samples["points"].mean(axis=1)).max() < 0.1  # 64 points of a craft 0.2 m about its centroid
    assert np.linalg.norm(samples["points"], axis=-1).max() < 2.0 * CONFIG.target.half_wheelbase_m
    miss = np.abs(samples["predicted"] - samples["position"])
    assert 0.3 < miss.max() <= CONFIG.region.threshold_m * (1 + 1e-5)


def test_shards_survive_a_kill_and_parts_make_the_whole(folder, tmp_path):
    done = data.simulate(CONFIG, tmp_path, part=(2, 2))
    assert done["written"] == 20 and list(done["shards"]) == ["shard-00001"]
    with pytest.raises(data.DataError, match="20 of 48 samples"):
        data.Dataset(tmp_path)
    (tmp_path / ".shard-00000.part").mkdir()  # what a killed run leaves
    assert data.simulate(CONFIG, tmp_path)["written"] == 28
    assert data.simulate(CONFIG, tmp_path)["written"] == 0
    places = np.arange(48)
    whole, parts = (data.Dataset(each).read(places) for each in (folder, tmp_path))
    for name in whole:
        np.testing.assert_array_equal(whole[name], parts[name])
    (tmp_path / "shard-00001" / "snr_db.npy").write_bytes(b"\x93NUMPY broken")
    with pytest.raises(data.DataError, match="shard-00001: meta.json or an array is damaged.*--verify"):
        data.Dataset(tmp_path)
    np.save(tmp_path / "shard-00001" / "snr_db.npy", np.zeros(5, np.float32))
    with pytest.raises(data.DataError, match="shard-00001: snr_db is damaged.*--verify"):
        data.Dataset(tmp_path)
    np.save(tmp_path / "shard-00001" / "snr_db.npy", np.zeros(20, np.float32))  # only its sum tells
    assert data.simulate(CONFIG, tmp_path)["written"] == 0
    assert data.simulate(CONFIG, tmp_path, verify=True)["written"] == 20
    np.testing.assert_array_equal(data.Dataset(tmp_path).read(places)["snr_db"], whole["snr_db"])


@pytest.mark.parametrize("text", ["[]", "{\"format\": 3}", "{", "\xff"])
def test_a_damaged_manifest_is_named_and_made_again(folder, tmp_path, text):
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "manifest.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(data.DataError, match="manifest.json: is damaged"):
        data.simulate(CONFIG, tmp_path / "copy")
    (tmp_path / "copy" / "manifest.json").unlink()
    assert data.simulate(CONFIG, tmp_path / "copy")["written"] == 0


def test_what_cannot_be_simulated_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match="quadx"):
        data.simulate(override(CONFIG, ["target.airframes=[quadx]"]), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_other_data_are_not_overwritten(folder):
    with pytest.raises(data.DataError, match="another configuration"):
        data.simulate(override(CONFIG, ["data.seed=5"]), folder)
    with pytest.raises(data.DataError, match="shard size"):  # the same rows would be there twice
        data.simulate(override(CONFIG, ["data.shard_rows=24"]), folder)
    with pytest.raises(data.DataError, match="data.count: 32 is less than the 48"):
        data.simulate(override(CONFIG, ["data.count=32"]), folder)
    with pytest.raises(ValueError, match="1 <= i <= n"):
        data.simulate(CONFIG, folder, part=(3, 2))
    with pytest.raises(data.DataError, match="august simulate"):
        data.Dataset(folder / "nowhere")


def test_splits_keep_flights_whole_and_airframes_balanced():
    config = preset("laptop")
    flights = np.arange(5000)
    split = data.split_of(flights, config)
    assert np.bincount(split).tolist() == [4000, 500, 500]
    kinds = flights % len(config.target.airframes)
    assert {tuple(np.bincount(kinds[split == part])) for part in (1, 2)} == {(100,) * 5}


def test_batches_follow_from_the_step(folder):
    dataset = data.Dataset(folder)
    config = replace(CONFIG, train=replace(CONFIG.train, batch=8))
    batches = data.TrainingBatches(dataset, config)
    first, again, other = batches(3), batches(3), batches(4)
    assert {name: value.shape for name, value in first.items()} == {
        "channel": (8, 1, 7, 7), "predicted": (8, 3), "snr_db": (8,), "cloud": (8, 64, 5)}
    np.testing.assert_array_equal(first["channel"], again["channel"])
    assert not np.allclose(first["predicted"], other["predicted"])
    stored = data.as_stored(dataset.read(np.arange(4)), config)
    estimate = dataset.read(np.arange(4))["estimate"]
    np.testing.assert_array_equal(data.pack(stored["channel"]), estimate)
    with pytest.raises(data.DataError, match="train.batch"):
        data.TrainingBatches(dataset, replace(CONFIG, train=replace(CONFIG.train, batch=1000)))


def test_a_manifest_whose_list_is_old_does_not_hide_a_shard(folder, tmp_path):
    """Two parts that end together each list what they saw; a killed one lists what it began with."""
    shutil.copytree(folder, tmp_path / "copy")
    path = tmp_path / "copy" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"rows": 20, "shards": {"shard-00001": [20, 40]}}))
    assert data.Dataset(tmp_path / "copy").count == 48


def test_the_manifest_is_json_that_says_what_is_there(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["rows"] == 48 and manifest["shards"]["shard-00002"] == [40, 48]
