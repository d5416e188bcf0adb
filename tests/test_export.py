"""Files that other programs read: what is written is what comes back, and a failure leaves nothing behind."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.io import loadmat

from august_jax import files
from august_jax.app import export
from august_jax.app.cli.messages import told

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(7, 3)).astype(np.float32)
PERMITTIVITY = np.linspace(1.5, 5.0, 7, dtype=np.float32)


def read_ply(path):
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    return names, np.frombuffer(body, "<f4").reshape(-1, len(names))


def test_ply_keeps_every_attribute(tmp_path):
    export.write_ply(tmp_path / "cloud.ply", POINTS, PERMITTIVITY, 2e-3)
    names, table = read_ply(tmp_path / "cloud.ply")
    assert names == ["x", "y", "z", "permittivity", "conductivity"]
    np.testing.assert_array_equal(table[:, :3], POINTS)
    np.testing.assert_array_equal(table[:, 3], PERMITTIVITY)
    np.testing.assert_array_equal(table[:, 4], np.float32(2e-3))


def test_ply_opens_in_an_independent_reader(tmp_path):
    export.write_ply(tmp_path / "cloud.ply", POINTS, PERMITTIVITY, 2e-3)
    cloud = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(cloud.vertices, POINTS)


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
