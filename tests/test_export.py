"""Files that other programs read: what is written is what comes back, and a failure leaves nothing behind."""

import dataclasses
import errno
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.io import loadmat

from august_jax import files
from august_jax.app import export
from august_jax.app.cli.messages import told
from august_jax.data import Observed, Sample
from august_jax.tracking import Track

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(7, 3)).astype(np.float32)
PERMITTIVITY = np.linspace(1.5, 5.0, 7, dtype=np.float32)


def by_plyfile(path):
    from plyfile import PlyData

    vertex = PlyData.read(str(path))["vertex"]
    return {name: np.asarray(vertex[name]) for name in vertex.data.dtype.names}


def by_trimesh(path):
    cloud = trimesh.load(path)
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    return {name: np.asarray(data[name]).reshape(-1) for name in data.dtype.names}


def by_meshio(path):
    meshio = pytest.importorskip("meshio")
    mesh = meshio.read(path)
    data = {name: each.view(np.uint8) if each.dtype == np.int8 else each for name, each in mesh.point_data.items()}
    return dict(zip("xyz", mesh.points.T)) | data  # it takes unsigned bytes for signed ones


def by_open3d(path):
    open3d = pytest.importorskip("open3d")
    cloud = open3d.t.io.read_point_cloud(str(path))
    found = {name: cloud.point[name].numpy().reshape(len(POINTS), -1) for name in cloud.point}
    named = {name: values[:, 0] for name, values in found.items() if values.shape[1] == 1}
    return named | dict(zip("xyz", found["positions"].T)) | dict(zip(("red", "green", "blue"), found["colors"].T))


@pytest.mark.parametrize("reader", [by_plyfile, by_trimesh, by_meshio, by_open3d])
def test_other_libraries_read_every_property_of_a_ply(tmp_path, reader):
    export.write_ply(tmp_path / "cloud.ply", POINTS, PERMITTIVITY, 2e-3, span=(1.5, 5.0))
    found = reader(tmp_path / "cloud.ply")
    for name, column in zip("xyz", POINTS.T):
        np.testing.assert_array_equal(found[name], column)
    np.testing.assert_array_equal(found["permittivity"], PERMITTIVITY)
    np.testing.assert_array_equal(found["conductivity"], np.float32(2e-3))
    # dark violet at the low end, yellow at the high one
    assert [found[name][0] for name in ("red", "green", "blue")] == [68, 1, 84]
    assert [found[name][-1] for name in ("red", "green", "blue")] == [253, 231, 37]


def test_points_of_no_known_material_are_grey(tmp_path):
    export.write_ply(tmp_path / "cloud.ply", POINTS, np.full(7, np.nan), np.nan)
    found = by_plyfile(tmp_path / "cloud.ply")
    assert np.isnan(found["permittivity"]).all() and {*found["red"], *found["green"], *found["blue"]} == {150}


def test_csv_names_its_units_and_keeps_single_precision(tmp_path):
    export.write_csv(tmp_path / "cloud.csv", POINTS, PERMITTIVITY, 2e-3)
    head, *lines = (tmp_path / "cloud.csv").read_text().splitlines()
    assert head == "x_m,y_m,z_m,permittivity,conductivity_s_m" and len(lines) == len(POINTS)
    table = np.genfromtxt(tmp_path / "cloud.csv", delimiter=",", names=True, dtype=np.float32)
    np.testing.assert_array_equal(table["y_m"], POINTS[:, 1])
    np.testing.assert_array_equal(table["permittivity"], PERMITTIVITY)
    np.testing.assert_array_equal(table["conductivity_s_m"], np.float32(2e-3))


def test_ply_refuses_a_batch(tmp_path):
    with pytest.raises(ValueError, match=r"points: shape \(2, 7, 3\)"):
        export.write_ply(tmp_path / "cloud.ply", np.zeros((2, 7, 3)), 1.0, 0.0)
    assert not list(tmp_path.iterdir())


RECORD = {"points": POINTS, "channel": (POINTS + 1j * POINTS[::-1]).astype(np.complex64), "snr_db": np.float32(20.0)}


def read_json(path):
    tree = json.loads(path.read_text())
    tree["channel"] = np.array(tree["channel"]["real"]) + 1j * np.array(tree["channel"]["imag"])
    return tree


READERS = {"npz": np.load, "mat": loadmat, "json": read_json}


@pytest.mark.parametrize("kind", READERS)
def test_record_comes_back(tmp_path, kind):
    path = tmp_path / f"record.{kind}"
    export.write_record(path, RECORD)
    back = READERS[kind](path)
    for name, value in RECORD.items():
        # JSON prints float32 as its exact double, so equality is exact in all three formats
        np.testing.assert_array_equal(np.squeeze(back[name]), value)


def texts(path, name):
    """``units`` or ``axes`` of a record, by whoever reads its format."""
    if path.suffix == ".npz":
        return dict(np.load(path)[name].tolist())
    if path.suffix == ".json":
        return json.loads(path.read_text())[name]
    found = loadmat(path, simplify_cells=True)[name]
    return {field: str(text) for field, text in found.items()}


SAMPLE = {
    "true_channel": (RNG.normal(size=(2, 3, 3)) + 1j * RNG.normal(size=(2, 3, 3))).astype(np.complex64),
    "points": POINTS,
    "snr_db": np.float32(20.0),
    "note": np.float32(1.0),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_record_says_units_and_axes(tmp_path, kind):
    path = tmp_path / f"record.{kind}"
    export.write_record(path, SAMPLE, described=export.DESCRIBED)
    units, axes = texts(path, "units"), texts(path, "axes")
    assert set(units) == set(axes) == set(SAMPLE) - {"note"}
    assert (units["points"], axes["points"], axes["snr_db"]) == ("m", "point x xyz", "one number")
    assert units["true_channel"].startswith("1/m") and axes["true_channel"].startswith("tone x receiving antenna")


def test_every_array_of_a_slot_and_of_a_sample_is_described():
    for kind in (Track, Sample, Observed):
        names = kind._fields if hasattr(kind, "_fields") else [field.name for field in dataclasses.fields(kind)]
        assert not set(names) - set(export.DESCRIBED) - {"observed"}


@pytest.mark.skipif(shutil.which("octave") is None, reason="no Octave here")
def test_octave_reads_what_the_axes_say(tmp_path):
    export.write_record(tmp_path / "record.mat", SAMPLE, described=export.DESCRIBED)
    told = (
        "load record.mat; printf('%d ', size(true_channel)); printf('|%s|%.6f', axes.points, imag(true_channel(2,1,3)))"
    )
    run = subprocess.run(["octave", "--eval", told], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert run.stdout == f"2 3 3 |point x xyz|{SAMPLE['true_channel'][1, 0, 2].imag:.6f}"


def test_unknown_suffix_names_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"'\.xyz'; a record is written as \.npz, \.mat or \.json"):
        export.write_record(tmp_path / "record.xyz", RECORD)


def test_interrupted_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "kept.txt"
    files.write_text(path, "old")
    with pytest.raises(KeyboardInterrupt), files.replacing(path) as aside:
        aside.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["kept.txt"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
def test_a_full_disk_is_told_by_its_file(tmp_path):
    with pytest.raises(OSError) as full, files.naming("shard/points.npy"), open("/dev/full", "wb") as file:
        np.save(file, np.zeros(100_000))
    assert told(full.value).startswith("august: shard/points.npy: No space left on device; make room there")
    with pytest.raises(OSError) as full, files.replacing(tmp_path / "cloud.ply"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert full.value.filename == str(tmp_path / "cloud.ply")
    assert not list(tmp_path.iterdir())
