"""Loading never executes what is in a file: no loader unpickles, and none takes objects."""

import ast
import os
from pathlib import Path

import numpy as np
import pytest

import august_jax
from august_jax import config as configuration
from august_jax import data, pipeline
from august_jax.app.cli import export
from august_jax.config import override, preset
from august_jax.data.shards import write_array
from august_jax.files import read_json, read_npz, sha256_of, write_json
from august_jax.physics.body import cache
from august_jax.tracking import KalmanLSTM
from august_jax.training import load_weights

ROOT = Path(august_jax.__file__).parents[1]
SOURCES = [path for part in ("august_jax", "experiments", "benchmarks") for path in sorted((ROOT / part).rglob("*.py"))]
UNSAFE = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
SMOKE = preset("smoke")


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_loads_what_could_be_code(path):
    text = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            assert not UNSAFE & {name.split(".")[0] for name in names}
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        given = {each.arg: ast.unparse(each.value) for each in node.keywords}
        assert called not in ("eval", "exec", "yaml.unsafe_load", "yaml.full_load")
        if called == "yaml.load":  # by a loader that is made of the safe one
            assert len(node.args) + len(node.keywords) == 2
            assert "yaml.SafeLoader)" in text and text.count("Loader)") == text.count("yaml.SafeLoader)")
        assert given.get("allow_pickle", "False") == "False"
        if called in ("np.load", "numpy.load") and "august_jax" in path.parts:
            assert given.get("allow_pickle") == "False", f"{path.name}:{node.lineno}"


class Evil:
    """Who unpickles it runs a command."""

    def __init__(self, mark):
        self._mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self._mark}",)


def npz_of(arrays, mark):
    """Like these arrays, but each an object."""
    return {name: np.array([Evil(mark)], object) for name in arrays}


def weights(folder, mark):
    np.savez(folder / "weights.npz", **npz_of(["denoiser.kernel"], mark))
    load_weights(folder / "weights.npz", SMOKE)


def run(folder, mark):
    configuration.to_yaml(SMOKE)
    (folder / "config.yaml").write_text(configuration.to_yaml(SMOKE))
    np.savez(folder / "weights.npz", **npz_of(["denoiser.kernel"], mark))
    pipeline.load_networks(folder)


def predictor(folder, mark):
    (folder / "config.yaml").write_text(configuration.to_yaml(SMOKE))
    np.savez(folder / "predictor.npz", **npz_of(["kernel"], mark))
    KalmanLSTM.for_flight(SMOKE.flight, folder)


def result(folder, mark):
    np.savez(folder / "clouds.npz", **npz_of(["time_s", "points"], mark))
    export._source(folder, -1)


def shard(folder, mark):
    config = override(SMOKE, ["data.count=2", "data.shard_rows=2"])
    data.simulate(config, folder)
    file = folder / "shard-00000" / "snr_db.npy"
    file = file if file.exists() else folder / "shard-00000" / "position.npy"
    np.save(file, np.array([Evil(mark)] * 2, object), allow_pickle=True)
    meta = read_json(folder / "shard-00000" / "meta.json")  # with a description that fits
    meta["arrays"][file.stem] |= {"sha256": sha256_of(file), "shape": [2], "dtype": "object"}
    write_json(folder / "shard-00000" / "meta.json", meta)
    data.Dataset(folder).read(np.arange(2))


def settings(folder, mark):
    (folder / "config.yaml").write_text(f"train: !!python/object/apply:os.system ['touch {mark}']\n")
    configuration.read(folder / "config.yaml")


@pytest.mark.parametrize("door", [weights, run, predictor, result, shard, settings])
def test_objects_are_refused_at_every_door(tmp_path, door):
    mark = tmp_path / "executed"
    with pytest.raises(ValueError, match=str(tmp_path)):
        door(tmp_path, mark)
    assert not mark.exists()


def test_a_cached_body_that_holds_objects_is_made_again(tmp_path, monkeypatch):
    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path))
    mark = tmp_path / "executed"

    def body():
        return cache.cached([np.arange(3)], ("modes",), lambda: {"modes": np.arange(4.0)})

    body()
    (path,) = tmp_path.glob("*.npz")
    np.savez(path, **npz_of(["modes"], mark))
    np.testing.assert_array_equal(body()["modes"], np.arange(4.0))
    np.testing.assert_array_equal(read_npz(path)["modes"], np.arange(4.0))
    assert not mark.exists()


def test_objects_are_not_written_either(tmp_path):
    with pytest.raises(ValueError, match="pickle"):
        write_array(tmp_path / "one.npy", np.array([Evil(tmp_path / "executed")], object))
