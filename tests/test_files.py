"""Files that appear whole or not at all, and damaged ones told as such."""

import os
import subprocess
import sys

import numpy as np
import pytest

from august_jax.files import (
    DamagedFile,
    Occupied,
    occupant,
    occupying,
    read_json,
    read_npz,
    replacing,
    write_json,
    write_text,
)


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
    assert done == ["folder", "file", "rename", "folder"]  # first the one that holds the new folder


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


def test_a_flipped_bit_anywhere_in_an_npz_is_told_or_changes_nothing(tmp_path):
    """Of a member read as shorter than it is no check sum would be compared."""
    path = tmp_path / "a.npz"
    arrays = {"x": np.arange(12.0).reshape(3, 4), "y": np.array([True, False])}
    np.savez(path, **arrays)
    content, told = path.read_bytes(), 0
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ (1 << place % 8)]) + content[place + 1 :])
        try:
            found = read_npz(path)
        except DamagedFile:
            told += 1
            continue
        for name in set(found) & set(arrays):
            assert found[name].dtype == arrays[name].dtype
            np.testing.assert_array_equal(found[name], arrays[name])
    assert told > 0.5 * len(content)


def test_a_flipped_bit_in_a_json_file_is_told(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"rows": 20, "names": ["one", "two"], "share": 0.1})
    assert read_json(path) == {"rows": 20, "names": ["one", "two"], "share": 0.1}
    content = path.read_bytes()
    for place, byte in enumerate(content):
        if bytes([byte]).isalnum() and content[place - 3 : place + 3].find(b"sum") < 0:
            path.write_bytes(content[:place] + bytes([byte ^ 1]) + content[place + 1 :])
            with pytest.raises(DamagedFile, match=r"a\.json: is damaged"):
                read_json(path)
    path.write_text('{"rows": 20}')  # of an older version
    assert read_json(path) == {"rows": 20}


def test_what_a_killed_process_left_aside_goes_with_the_next_write(tmp_path):
    with replacing(tmp_path / "note.txt") as held:
        held.write_text("one")
        left = tmp_path / ".note.txt.0123abcd.part.txt"
        left.write_text("half")
        other = tmp_path / ".other.txt.0123abcd.part.txt"
        other.touch()
        write_text(tmp_path / "note.txt", "two")
        assert held.exists() and not left.exists() and other.exists()
    assert (tmp_path / "note.txt").read_text() == "one"


HOLDS = """
import os, sys, time
from august_jax.files import occupying
with occupying(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_folder_is_held_until_its_process_ends_however_it_ends(tmp_path):
    folder = tmp_path / "new" / "folder"
    with subprocess.Popen([sys.executable, "-c", HOLDS, folder], stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout.readline() == "held\n"
            with pytest.raises(Occupied, match=f"folder: .* is being written by process {other.pid} on "):
                with occupying(folder):
                    raise AssertionError
        finally:
            other.kill()
    assert (folder / ".lock").exists() and occupant(folder / ".lock") is None
    with occupying(folder):
        assert occupant(folder / ".lock") == f"process {os.getpid()} on {os.uname().nodename}"
    assert list(folder.iterdir()) == []


def test_a_folder_made_for_nothing_vanishes_again(tmp_path):
    with pytest.raises(RuntimeError), occupying(tmp_path / "new" / "folder"):
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    with occupying(tmp_path / "new"):
        (tmp_path / "new" / "file").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "file"]
