"""Files that appear whole or not at all, and damaged ones told as such."""

import os

import numpy as np
import pytest

from august_jax.files import DamagedFile, read_npz, replacing, write_text


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "numbers.npz"
    write_text(path, "old")
    with pytest.raises(RuntimeError), replacing(path) as aside:
        aside.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["numbers.npz"]


def test_the_folder_is_flushed_after_the_rename(tmp_path, monkeypatch):
    done = []
    rename, fsync = os.replace, os.fsync
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("rename"), rename(*paths)))
    monkeypatch.setattr(
        os,
        "fsync",
        lambda number: (done.append("folder" if os.path.isdir(f"/proc/self/fd/{number}") else "file"), fsync(number)),
    )
    write_text(tmp_path / "deep" / "note.txt", "whole")
    assert done == ["file", "rename", "folder"]


def test_arrays_come_back(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.arange(3), y=np.eye(2))
    found = read_npz(tmp_path / "a.npz")
    assert set(found) == {"x", "y"}
    np.testing.assert_array_equal(found["y"], np.eye(2))


def _whole(path):
    np.savez_compressed(path, x=np.arange(1000.0), y=np.array("text"))
    return path.read_bytes()


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: b"junk",
        lambda content: content[:60],
        lambda content: content[:-30],
        lambda content: content[:100] + bytes(40) + content[140:],
        lambda content: b"\x93NUMPY" + content[6:],
    ],
    ids=["empty", "junk", "head alone", "cut", "overwritten", "another magic number"],
)
def test_damage_is_told_with_the_file(tmp_path, damage):
    path = tmp_path / "a.npz"
    path.write_bytes(damage(_whole(path)))
    with pytest.raises(DamagedFile, match=r"a\.npz: is damaged"):
        read_npz(path)


def test_one_array_or_objects_are_no_npz(tmp_path):
    np.save(tmp_path / "one.npy", np.arange(3))
    np.savez(tmp_path / "objects.npz", x=np.array([{}], object))
    for name in ("one.npy", "objects.npz"):
        with pytest.raises(DamagedFile, match=name):
            read_npz(tmp_path / name)


def test_a_missing_file_is_missing_and_not_damaged(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_npz(tmp_path / "nothing.npz")
