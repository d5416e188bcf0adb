"""Compiled programs are kept from one process to the next, where the user has not said otherwise."""

import os
import subprocess
import sys
import zlib

import pytest

from august_jax.app import compiled, machine

PROGRAM = """
from august_jax.app.compiled import keep_compiled
print(keep_compiled())
import jax, jax.numpy as jnp
def slow(x):  # to compile
    for _ in range(60):
        x = jnp.sort(jnp.sin(x) + x[::-1])
    return x
print(float(jax.jit(slow)(jnp.arange(8.0))[0]))
"""


def processed(folder, **variables):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"AUGUST_CACHE": str(folder)} | variables
    run = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, text=True, capture_output=True, check=True)
    return run.stdout.split()


def test_a_second_process_finds_what_the_first_compiled(tmp_path):
    anything = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}  # however quick the machine is
    first = processed(tmp_path, **anything)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "compiled").rglob("*") if path.is_file()}
    assert first[0].startswith(str(tmp_path / "compiled")) and any("slow" in path.name for path in kept)
    assert processed(tmp_path, **anything) == first
    assert {path for path in (tmp_path / "compiled").rglob("*") if path.is_file()} == set(kept)


def test_processors_of_other_instructions_keep_programs_apart(monkeypatch):
    """A program for one may end a process on the other with an illegal instruction."""
    marks = []
    for flags, clock in (("fpu sse avx2", "2500"), ("fpu sse avx2", "3100"), ("fpu sse avx2 avx512f", "2500")):
        listed = ["model name\t: One of many", f"flags\t\t: {flags}", f"cpu MHz\t\t: {clock}", "processor\t: 0"]
        monkeypatch.setattr(machine, "_listed", lambda lines=listed: lines)
        marks.append(machine.processor_mark())
    assert marks[0] == marks[1] != marks[2] and all(len(mark) == 12 for mark in marks)


@pytest.mark.parametrize(
    "variables", [{"JAX_COMPILATION_CACHE_DIR": "elsewhere"}, {"JAX_ENABLE_COMPILATION_CACHE": "false"}]
)
def test_what_the_user_says_holds(tmp_path, variables):
    if "JAX_COMPILATION_CACHE_DIR" in variables:
        variables = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "elsewhere")}
    assert processed(tmp_path, **variables)[0] == "None"
    assert not (tmp_path / "compiled").exists()


def test_a_folder_that_cannot_be_made_stops_nobody(tmp_path):
    (tmp_path / "file").touch()
    assert processed(tmp_path / "file")[0] == "None"


def test_the_oldest_programs_make_room(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "_MOST_BYTES", 1000)
    for age, name in enumerate("abcdef"):
        (tmp_path / name).write_bytes(bytes(200))
        os.utime(tmp_path / name, (age, age))
    compiled._make_room(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set("cdef")
    compiled._make_room(tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


def test_a_program_that_a_kill_left_half_written_goes(tmp_path):
    whole = zlib.compress(os.urandom(3000))
    for name, content in {
        "one-cache": whole,
        "torn-cache": whole[:1000],
        "empty-cache": b"",
        "one-atime": b"1",
    }.items():
        (tmp_path / name).write_bytes(content)
    compiled._drop_torn(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"one-cache", "one-atime", "looked-at"}
    old = tmp_path / "old-cache"  # which was there at the last look is not read again
    old.write_bytes(b"torn")
    os.utime(old, (0, 0))
    compiled._drop_torn(tmp_path)
    assert old.exists()
