"""Samples from a key to a batch: independence of the order, the disk format, interruptions, splits, observing anew."""

import json
import os
import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax import data
from august_jax.config import override, preset
from august_jax.data.shards import _sharing
from august_jax.files import Occupied, read_json, write_json
from august_jax.physics import PlanarArray, contrast, sensing_channel
from august_jax.signal import Coefficients, Subspace, project

CONFIG = override(preset("smoke"), ["data.count=48", "data.shard_rows=20", "data.observed=true"])
AGAIN = r"\nmake it again: august simulate --out .* --verify$"


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
    for name, value in alone.columns().items():
        np.testing.assert_allclose(
            stored.columns()[name][1], value[0], rtol=1e-4, atol=1e-5 * np.abs(value).max(), err_msg=name
        )


def test_a_sample_is_the_same_under_any_setting_of_jax(targets):
    """Samples of one folder may be made by several processes: what JAX is set to must not tell them apart."""
    plain = data.generate(CONFIG, [3], targets)
    for setting in (jax.enable_x64(True), jax.threefry_partitionable(False), jax.default_prng_impl("rbg")):
        with setting:
            other = data.generate(CONFIG, [3], targets)
        for name, value in plain.columns().items():
            np.testing.assert_array_equal(other.columns()[name], value, err_msg=name)


def test_an_evaluation_s_samples_are_never_a_data_set_s(targets):
    stored, fresh = data.generate(CONFIG, [3], targets), data.generate(CONFIG, [3], targets, domain="evaluate")
    for name in ("position", "rotation", "permittivity", "conductivity", "points", "true_channel"):
        assert not np.any(getattr(stored, name) == getattr(fresh, name)), name


def test_what_nobody_will_read_is_not_stored(targets, folder, tmp_path):
    config = override(CONFIG, ["data.observed=false", "data.count=20"])
    assert data.simulate(config, tmp_path)["written"] == 20
    kept, lean = data.Dataset(folder).read(np.arange(20)), data.Dataset(tmp_path).read(np.arange(20))
    assert lean.observed is None
    for name, value in lean.columns().items():
        np.testing.assert_allclose(value, kept.columns()[name], rtol=1e-5, atol=1e-5 * np.abs(value).max())
    for each in (config, CONFIG):
        place = tmp_path if each is config else folder
        stored = sum(path.stat().st_size for path in place.rglob("*.npy"))
        assert abs(stored - data.bytes_of(each)) < 200 * len(list(place.rglob("*.npy")))  # headers
    with pytest.raises(ValueError, match="data.observed"):
        data.TrainingBatches(data.Dataset(tmp_path), override(CONFIG, ["train.batch=8", "train.reobserve=false"]))


def test_an_observation_says_all_that_the_echo_holds_to_who_asks(targets):
    samples = data.generate(CONFIG, np.arange(4) * CONFIG.flight.slots, targets)
    plain, asked = (
        data.observed_anew(jax.random.key(0), samples, CONFIG, 20.0, statistics=ask) for ask in (False, True)
    )
    assert plain.statistics is None
    jax.tree.map(np.testing.assert_array_equal, plain, asked._replace(statistics=None))
    np.testing.assert_array_equal(asked.statistics.centre, asked.predicted)
    # Z = A C + N of the true channel's coefficients A: what is left is noise of unit power, 196 numbers
    subspace = Subspace.from_config(CONFIG.array)
    true = jax.vmap(project, (0, 0, None))(data.unpack(jnp.asarray(samples.true_channel)), asked.predicted, subspace)
    left = asked.statistics.received - true.values @ asked.statistics.pilots
    assert np.mean(np.abs(left) ** 2) == pytest.approx(1.0, abs=4.0 / np.sqrt(left.size))


def test_materials_that_ask_too_much_of_the_cells_are_told_with_the_figure():
    """Channels are compiled, where no contrast is looked at: both ends of the range are, when targets are prepared."""
    config = override(
        CONFIG, ["target.permittivity=[1.5,40]", "region.permittivity_max=40", "target.airframes=[quad_x]"]
    )
    with pytest.warns(UserWarning, match=r"make 0\.97 a wavelength in their material, of 8\.8 wanted"):
        data.prepare_targets(config)


def test_room_is_checked_before_the_work(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 9, 1000))
    with pytest.raises(data.DataError, match="data.count: 48 samples take .* has 0.0 MB free"):
        data.simulate(CONFIG, tmp_path / "new", progress=said.append)
    assert "48 samples take" in said[0] and not (tmp_path / "new").exists()


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_the_channel_is_that_of_the_cells_in_that_pose(targets):
    sample = data.generate(CONFIG, [9], targets).each(lambda value: value[0])
    cells = targets[sample.airframe].cells
    chi = contrast(float(sample.permittivity), float(sample.conductivity), CONFIG.array.frequency_hz)
    with jax.enable_x64(True):
        moved = cells.moved(sample.rotation.astype(float), sample.position.astype(float))
        array = PlanarArray.from_config(CONFIG.array)
        exact = np.asarray(sensing_channel(array, moved, complex(chi)))
    channel = np.asarray(data.unpack(sample.true_channel))[0]
    # Rotations come in float32; the response itself is good to 3e-5.
    assert np.linalg.norm(channel - exact) < 2e-4 * np.linalg.norm(exact)


def test_the_paper_s_echo_lies_in_its_link_budget():
    """50 to 100 cm^3 of material and -3 to 30 dB from 10 to 40 dBm, so 12 to 15 dB in the middle."""
    paper = override(
        preset("paper"), ["target.airframes=[quad_x]", "data.solver=local_field_born", "signal.power_dbm=[25, 25]"]
    )
    targets = data.prepare_targets(paper)
    cells = targets[0].cells
    assert 50e-6 < np.sum(cells.fill * cells.volumes) < 100e-6
    heard = data.generate(paper, np.arange(64) * paper.flight.slots, targets).observed.snr_db
    assert 10.0 < np.median(heard) < 17.0


def test_labels_lie_on_the_airframe_and_are_centred_on_the_position(folder):
    samples = data.Dataset(folder).read(np.arange(48))
    assert np.abs(samples.points.mean(axis=1)).max() < 0.1  # 64 points of a craft 0.2 m about its centroid
    assert np.linalg.norm(samples.points, axis=-1).max() < 2.0 * CONFIG.target.half_wheelbase_m
    miss = np.abs(samples.observed.predicted - samples.position)
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
    whole, parts = (data.Dataset(each).read(places).columns() for each in (folder, tmp_path))
    for name in whole:
        np.testing.assert_array_equal(whole[name], parts[name])
    (tmp_path / "shard-00001" / "snr_db.npy").write_bytes(b"\x93NUMPY broken")
    with pytest.raises(data.DataError, match=r"shard-00001: snr_db.npy is damaged" + AGAIN):
        data.Dataset(tmp_path)
    np.save(tmp_path / "shard-00001" / "snr_db.npy", np.zeros(5, np.float32))
    with pytest.raises(data.DataError, match=r"shard-00001: snr_db.npy is damaged" + AGAIN):
        data.Dataset(tmp_path)
    np.save(tmp_path / "shard-00001" / "snr_db.npy", np.zeros(20, np.float32))  # only its sum tells
    assert data.simulate(CONFIG, tmp_path)["written"] == 0
    assert data.simulate(CONFIG, tmp_path, verify=True)["written"] == 20
    np.testing.assert_array_equal(data.Dataset(tmp_path).read(places).observed.snr_db, whole["snr_db"])


def flip(path, place=-5):
    """One bit of a file."""
    content = bytearray(path.read_bytes())
    content[place] ^= 0x10
    path.write_bytes(content)


@pytest.mark.parametrize("column", ["true_channel", "points", "flight", "row_sums"])
def test_one_bit_of_the_data_is_noticed_when_it_is_read_and_made_again(folder, tmp_path, column):
    shutil.copytree(folder, tmp_path / "copy")
    flip(tmp_path / "copy" / "shard-00001" / f"{column}.npy")
    with pytest.raises(data.DataError, match=r"shard-00001: \w+.npy is damaged" + AGAIN):
        data.Dataset(tmp_path / "copy").read(np.arange(48))
    assert data.simulate(CONFIG, tmp_path / "copy", verify=True)["written"] == 20
    data.Dataset(tmp_path / "copy").read(np.arange(48))


def test_one_bit_of_a_description_is_noticed_and_mended(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "copy")
    manifest, meta = tmp_path / "copy" / "manifest.json", tmp_path / "copy" / "shard-00001" / "meta.json"
    flip(manifest, manifest.read_bytes().index(b"wanted") + 9)
    with pytest.raises(data.DataError, match="manifest.json: is damaged\nremove it, and write it again: august simul"):
        data.Dataset(tmp_path / "copy")
    manifest.unlink()
    flip(meta, meta.read_bytes().index(b"digest") + 12)
    assert data.simulate(CONFIG, tmp_path / "copy")["written"] == 20
    assert data.Dataset(tmp_path / "copy").count == 48


def test_shards_of_other_data_are_not_overwritten_where_the_manifest_is_gone(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "manifest.json").unlink()
    with pytest.raises(data.DataError, match="another configuration"):
        data.simulate(override(CONFIG, ["data.seed=5"]), tmp_path / "copy")
    assert data.simulate(CONFIG, tmp_path / "copy")["written"] == 0


@pytest.mark.parametrize("part, free", [((1, 1), False), ((1, 2), False), ((2, 4), True), ((3, 4), False)])
def test_who_makes_other_shards_may_work_in_the_same_folder(tmp_path, part, free):
    with _sharing(tmp_path, (1, 2)):
        if free:
            with _sharing(tmp_path, part):
                return
        with pytest.raises(Occupied, match=f"is being written by process {os.getpid()}"), _sharing(tmp_path, part):
            raise AssertionError
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["[]", '{"format": 4}', "{", "\xff"])
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
    with pytest.raises(data.DataError, match="holds no manifest.json"):
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
    assert isinstance(first.heard, Coefficients) and first.heard.values.shape == (8, 1, 7, 7)
    assert (first.predicted.shape, first.snr_db.shape, first.cloud.shape) == ((8, 3), (8,), (8, 64, 5))
    np.testing.assert_array_equal(first.heard.values, again.heard.values)
    np.testing.assert_array_equal(first.heard.centre, first.predicted)
    assert not np.allclose(first.predicted, other.predicted)
    stored = dataset.read(np.arange(4))
    batch = data.as_observed(stored, config)
    assert batch.heard is batch.estimated_channel and batch.heard.shape == (4, 1, 8, 8)
    np.testing.assert_array_equal(data.pack(batch.heard), stored.observed.estimated_channel)
    np.testing.assert_array_equal(batch.predicted, stored.observed.predicted)
    with pytest.raises(data.DataError, match="train.batch"):
        data.TrainingBatches(dataset, replace(CONFIG, train=replace(CONFIG.train, batch=1000)))


def test_a_manifest_whose_list_is_old_does_not_hide_a_shard(folder, tmp_path):
    """Two parts that end together each list what they saw; a killed one lists what it began with."""
    shutil.copytree(folder, tmp_path / "copy")
    path = tmp_path / "copy" / "manifest.json"
    write_json(path, read_json(path) | {"rows": 20, "shards": {"shard-00001": [20, 40]}})
    assert data.Dataset(tmp_path / "copy").count == 48


def test_the_manifest_is_json_that_says_what_is_there(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["rows"] == 48 and manifest["shards"]["shard-00002"] == [40, 48]


@pytest.mark.parametrize(
    "places, words",
    [
        (np.array([True, False]), "bool"),
        (np.array([0.5]), "float64"),
        (np.array([48]), "out of range"),
        (np.array([], int), "got none"),
        (np.array([-49]), "out of range"),
        (np.array([[1]]), "shape"),
    ],
)
def test_places_that_are_no_rows_are_refused(unchecked, folder, places, words):
    with pytest.raises(ValueError, match=f"places: .*{words}"):
        data.Dataset(folder).read(places)


@pytest.mark.parametrize(
    "meta",
    [
        "[1]",
        '{"rows": 3, "digest": "x", "arrays": {}}',
        '{"rows": [0, 20]}',
        '{"rows": ["a", 2], "digest": "x", "arrays": {"flight": 3}}',
    ],
)
def test_an_edited_shard_counts_as_missing(folder, tmp_path, meta):
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "shard-00000" / "meta.json").write_text(meta)
    with pytest.raises(data.DataError, match="28 of 48"):
        data.Dataset(tmp_path / "copy")


def test_triangles_alone_unpack(unchecked):
    whole = np.arange(9.0).reshape(3, 3) + np.arange(9.0).reshape(3, 3).T
    np.testing.assert_array_equal(data.unpack(data.pack(whole)), whole)
    with pytest.raises(ValueError, match="7 numbers"):
        data.unpack(np.zeros(7))
