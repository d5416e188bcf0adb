"""Mutated input: an error of at most six lines, or a right answer; never a traceback, a hang, or a wrong number.

Inputs are real ones (command lines, configurations, meshes, results, data sets, weights) in which bytes, words or lines
were flipped, cut out, doubled, swapped or put in; what they meet is called in this process, up to where the work would
begin. Each kind of input has a trial, which returns nothing where all is well. The ordinary suite draws a few of each,
the slow one more than ten thousand in all.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import signal
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from test_mesh_files import dae, gltf

from august_jax import config as configuration
from august_jax.app import cli
from august_jax.app.cli.common import chosen_config
from august_jax.app.cli.export import _source
from august_jax.app.cli.messages import told
from august_jax.app.cli.parser import UsageError, parser_of
from august_jax.config import preset
from august_jax.data import Dataset
from august_jax.models import create
from august_jax.scene import load_airframe
from august_jax.training.checkpoint import load_weights, save_weights

_PATIENCE_S = 60.0
"""No input of a few kilobytes may take longer, however busy the machine."""
_UNFORESEEN = re.compile(r"unexpected [A-Z]\w+:|Traceback")
"""What the command line says of an error that nobody foresaw."""
ODD = ["", "0", "-1", "nan", "inf", "1e308", "-0", "\u0661\u0662", "\x00", "[]", "[[", "{}", "null", "true", "~",
       "!!python/name:os.system", "*a", "&a", "9" * 40, "../..", "a b", "'", "=", "==", ".", "1e-400", "0x1F", "1_000",
       "--", "-", "%s", "\\", "\U0001f681"]  # fmt: skip


class Met(NamedTuple):
    """What an input met."""

    refused: bool
    lines: str


@contextlib.contextmanager
def in_time():
    """What hangs within is ended by a signal, and fails."""

    class Hung(BaseException):
        pass

    def ring(*_):
        raise Hung(f"after {_PATIENCE_S:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, _PATIENCE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def tried(action: Callable[[], object], *kinds: type[Exception]) -> Met:
    """An action on mutated input, which ends in time: well, or in an error that a user can read."""
    lines = ""
    with warnings.catch_warnings(), in_time():
        warnings.simplefilter("ignore")  # of odd input it may be warned
        try:
            action()
        except (ValueError, FloatingPointError, OSError, UsageError, *kinds) as error:
            lines = told(error)
            assert 1 <= len(lines.splitlines()) <= 6 and not _UNFORESEEN.search(lines), lines
    return Met(bool(lines), lines)


@st.composite
def bytes_of(draw, seed: bytes, most: int = 4) -> bytes:
    """``seed`` after a few mutations."""
    data = bytearray(seed)
    for _ in range(draw(st.integers(1, most))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        length = draw(st.integers(1, 40))
        kind = draw(st.sampled_from(["flip", "cut", "double", "put", "end", "word", "zero"]))
        if not data:
            break
        if kind == "flip":
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del data[at : at + length]
        elif kind == "double":
            data[at:at] = data[at : at + length]
        elif kind == "put":
            data[at:at] = draw(st.binary(min_size=1, max_size=8))
        elif kind == "end":
            del data[at:]
        elif kind == "zero":
            data[at : at + length] = bytes(min(length, len(data) - at))
        else:
            data[at : at + draw(st.integers(0, 6))] = draw(st.sampled_from(ODD)).encode()
    return bytes(data)


@st.composite
def lines_of(draw, seed: str) -> str:
    """A text after a few mutations of lines and of the words in them."""
    lines = seed.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        kind = draw(st.sampled_from(["value", "value", "value", "cut", "double", "swap", "indent", "key"]))
        name, colon, _ = lines[at].partition(":")
        if kind == "value":
            other = draw(st.sampled_from([each.partition(":")[2] for each in lines] + [f" {odd}" for odd in ODD]))
            lines[at] = f"{name}{colon or ':'}{other}"
        elif kind == "cut" and len(lines) > 1:
            del lines[at]
        elif kind == "double":
            lines.insert(at, lines[at])
        elif kind == "swap":
            there = draw(st.integers(0, len(lines) - 1))
            lines[at], lines[there] = lines[there], lines[at]
        elif kind == "indent":
            lines[at] = draw(st.sampled_from(["", " ", "  ", "\t", "- "])) + lines[at].strip()
        else:
            lines[at] = f"{draw(st.sampled_from(ODD))}{lines[at]}"
    return "\n".join(lines) + "\n"


# ---- command lines ------------------------------------------------------------------------------------------------


def _words() -> st.SearchStrategy[list[str]]:
    flags = sorted({flag for name, each in cli.COMMANDS.items() for action in parser_of(name, each)._actions
                    for flag in action.option_strings} - {"--debug"})  # fmt: skip
    fields = [f"{field.path}=" for field in configuration.describe()]
    values = st.sampled_from(
        [*ODD, "smoke", "laptop", "1", "20", "1/4", "5,6,3.5", "ply", "quad_x", "a.ply", "10:20:2"]
    )
    override = st.builds("".join, st.tuples(st.sampled_from([*fields, "a.b=", "x="]), values))
    word = st.one_of(st.sampled_from(flags), values, override, st.text(max_size=6))
    pair = st.tuples(st.sampled_from(flags), values).map(list)
    some = st.lists(st.one_of(word.map(lambda each: [each]), pair), max_size=6)
    command = st.one_of(st.sampled_from(sorted(cli.COMMANDS)), st.sampled_from([*ODD, "--version", "-h"]))
    return st.tuples(command, some).map(lambda both: [both[0], *(word for group in both[1] for word in group)])


def try_command_line(words: list[str], home: Path) -> Met:
    """By the whole command line, where instead of the work the configuration is made."""
    stubs = {
        name: each._replace(run=lambda args: {"made": bool(chosen_config(args))} if hasattr(args, "preset") else {})
        for name, each in cli.COMMANDS.items()
    }
    out, err, before = io.StringIO(), io.StringIO(), dict(cli.COMMANDS)
    cli.COMMANDS.update(stubs)
    try:
        with in_time(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = cli.main([word for word in words if word != "--debug"])
    finally:
        cli.COMMANDS.update(before)
    said = err.getvalue()
    assert status in (0, 2)
    if status:
        assert 1 <= len(said.strip().splitlines()) <= 6 and not _UNFORESEEN.search(said), said
    return Met(status == 2, said)


# ---- files --------------------------------------------------------------------------------------------------------


def try_configuration(text: str, home: Path) -> Met:
    """A configuration that is read is one that is written and read again as the same."""
    path = home / "config.yaml"
    path.write_text(text, encoding="utf-8")

    def read() -> None:
        found = configuration.read(path)
        assert configuration.from_yaml(configuration.to_yaml(found)) == found

    return tried(read)


def try_mesh(file: tuple[str, bytes], home: Path) -> Met:
    """A mesh that is read has finite corners, faces between them, and the size that was asked for."""
    kind, content = file
    path = home / f"craft.{kind}"
    path.write_bytes(content)

    def read() -> None:
        craft = load_airframe(path, half_wheelbase_m=0.25)
        corners = np.asarray(craft.mesh.vertices)
        assert (
            np.isfinite(corners).all() and len(craft.mesh.faces) and np.asarray(craft.mesh.faces).max() < len(corners)
        )
        assert np.isfinite(craft.radius_m) and craft.half_wheelbase_m == pytest.approx(0.25, rel=1e-5)

    return tried(read)


def try_result(content: bytes, home: Path) -> Met:
    """A result that is read is the one that was written: its check sums see to that."""
    folder = home / "result"
    folder.mkdir(exist_ok=True)
    (folder / "clouds.npz").write_bytes(content)

    def read() -> None:
        _, record, _ = _source(folder, 1)
        whole = _track()
        for name, value in record.items():
            np.testing.assert_array_equal(value, np.asarray(whole[name])[1] if np.ndim(whole[name]) else whole[name])

    return tried(read)


def try_data(files: dict[str, bytes], home: Path) -> Met:
    """A data set whose description, or an array of it, is mutated is refused, or read as it was made."""
    folder = home / "data"
    for name, content in files.items():
        (folder / name).write_bytes(content)

    def read() -> None:
        rows = Dataset(folder).read(np.arange(16))
        assert rows.true_channel.shape == (16, 1, 36)
        np.testing.assert_array_equal(rows.position, _positions())

    return tried(read)


def try_weights(content: bytes, home: Path) -> Met:
    """Weights that are read are those that were written."""
    path = home / "weights.npz"
    path.write_bytes(content)

    def read() -> None:
        _, state = load_weights(path, preset("smoke"))
        for found, true in zip(jax.tree.leaves(state), jax.tree.leaves(_networks()), strict=True):
            np.testing.assert_array_equal(found, true)

    return tried(read)


def _positions() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)


@cache
def _networks():
    """What the weights were written from."""
    return create(preset("smoke"), 0)[1]


def _track() -> dict[str, np.ndarray]:
    from made_up_track import made_up_track

    return made_up_track(2, 20).record()


def _packed(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _meshes() -> dict[str, bytes]:
    """A small body in each format, binary and as text."""
    box = trimesh.creation.box((0.4, 0.3, 0.1))
    corners, faces = np.asarray(box.vertices, np.float32), np.asarray(box.faces)
    found = {kind: box.export(file_type=kind) for kind in ("stl", "stl_ascii", "ply", "obj", "glb")}
    found["ply_ascii"] = box.export(file_type="ply", encoding="ascii")
    found["gltf"] = json.dumps(gltf(corners, faces))
    found["dae"] = dae(corners.tolist(), faces.tolist(), kind="triangles")
    return {kind: text.encode() if isinstance(text, str) else text for kind, text in found.items()}


@pytest.fixture(scope="module")
def small_data(tmp_path_factory):
    """A folder of data as ``august simulate`` leaves it, by the preset smoke, filled without its physics."""
    from august_jax.data import shards

    folder = tmp_path_factory.mktemp("small") / "data"
    config = configuration.override(preset("smoke"), ["data.count=16", "data.shard_rows=8"])

    def made_up(config, rows, targets, **_):
        from august_jax.data import Sample

        count, n = len(rows), config.array.count
        ones = np.ones(count, np.float32)
        return Sample(
            _positions()[rows], np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
            2 * ones, 0.01 * ones, np.zeros(count, np.int32), np.zeros(count, np.int32),
            np.arange(count, dtype=np.int32), np.zeros((count, config.target.points, 3), np.float32),
            np.ones((count, 1, n * (n + 1) // 2), np.complex64),
        )  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "generate", made_up)
        patch.setattr(shards, "prepare_targets", lambda *_: [])
        shards.simulate(config, folder)
    return folder


def _strategy(kind: str, small_data: Path) -> st.SearchStrategy:
    if kind == "command line":
        return _words()
    if kind == "configuration":
        texts = [configuration.to_yaml(preset(name)) for name in configuration.PRESETS]
        text = st.sampled_from(texts)
        return st.one_of(text.flatmap(lines_of), text.flatmap(lambda each: bytes_of(each.encode())).map(
            lambda each: each.decode("utf-8", "replace")))  # fmt: skip
    if kind == "mesh":
        seeds = _meshes()
        return st.sampled_from(sorted(seeds)).flatmap(
            lambda name: bytes_of(seeds[name]).map(lambda content: (name.partition("_")[0], content))
        )
    if kind == "result":
        return bytes_of(_packed(_track()))
    if kind == "weights":
        return bytes_of(_weights())
    names = [
        "manifest.json",
        "config.yaml",
        "shard-00000/meta.json",
        "shard-00001/meta.json",
        "shard-00000/position.npy",
    ]
    seeds = {name: (small_data / name).read_bytes() for name in names}
    return st.sampled_from(names).flatmap(lambda name: bytes_of(seeds[name], 2).map(lambda each: {**seeds, name: each}))


def _weights() -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        save_weights(Path(folder) / "weights.npz", _networks())
        return (Path(folder) / "weights.npz").read_bytes()


TRIALS = {
    "command line": (try_command_line, 200, 4000),
    "configuration": (try_configuration, 60, 2500),
    "mesh": (try_mesh, 80, 2500),
    "result": (try_result, 60, 1200),
    "data": (try_data, 50, 1000),
    "weights": (try_weights, 20, 300),
}
"""Kind of input -> its trial, and how many are tried, quickly and at length."""


def test_ten_thousand_inputs_are_tried_at_length():
    assert sum(many for _, _, many in TRIALS.values()) >= 10_000


def fuzz(kind: str, count: int, home: Path, small_data: Path) -> None:
    trial = TRIALS[kind][0]
    if kind == "data":
        shutil.copytree(small_data, home / "data", dirs_exist_ok=True)
    met: list[bool] = []

    # the same inputs each time: a test that may fail by chance says nothing of the change that it fails at
    @settings(max_examples=count, deadline=None, derandomize=True, database=None, phases=[Phase.generate, Phase.shrink],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(_strategy(kind, small_data))
    def trials(drawn) -> None:
        met.append(trial(drawn, home).refused)

    trials()
    assert len(met) >= 0.9 * count  # that is what was said to be tried
    assert 0.02 < np.mean(met)  # mutations that nothing notices try nothing


@pytest.mark.parametrize("kind", TRIALS)
def test_mutated_input_is_refused_or_right(kind, tmp_path, small_data, unchecked, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fuzz(kind, TRIALS[kind][1], tmp_path, small_data)


@pytest.mark.slow
@pytest.mark.parametrize("kind", TRIALS)
def test_much_mutated_input_is_refused_or_right(kind, tmp_path, small_data, unchecked, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fuzz(kind, TRIALS[kind][2], tmp_path, small_data)


def test_a_trial_that_lets_a_traceback_through_fails():
    """The test of the test: an error of a kind that no user is meant to see is none of those that pass."""

    def fails() -> None:
        raise KeyError("inside")

    with pytest.raises(KeyError):
        tried(fails)
    assert _UNFORESEEN.search(told(KeyError("inside"))) and not _UNFORESEEN.search(told(ValueError("unexpected word")))
