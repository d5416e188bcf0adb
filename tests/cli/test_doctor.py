"""The doctor: passes where all is well, and names what is not."""

import json
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import jax

from august_jax import UNFUSED_SUMS, pipeline
from august_jax.app import cli, doctor, sums
from august_jax.config import preset
from august_jax.data import bytes_of
from august_jax.memory import Memory, memory
from august_jax.tracking.predictors import lstm


def test_a_sound_installation_passes(capsys):
    status = cli.main(["doctor", "--json"])
    captured = capsys.readouterr()
    checks = {check["name"]: check for check in json.loads(captured.out)["checks"]}
    assert status == 0, captured.err
    assert {
        "python",
        "packages",
        "settings",
        "devices",
        "memory",
        "speed",
        "sums",
        "physics",
        "cache",
        "disk",
        "weights",
        "predictor",
    } <= set(checks)
    assert all(check["passed"] is not False and check["detail"] for check in checks.values())
    assert "load" in checks["weights"]["detail"] and "loads" in checks["predictor"]["detail"]


def test_what_is_broken_is_named(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(pipeline, "SHIPPED", tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path / "file" / "below"))
    status = cli.main(["doctor"])
    captured = capsys.readouterr()
    assert status == 2
    assert captured.err.splitlines() == ["august: failed: cache, weights; the lines above say why"]
    lines = {line.split()[1]: line for line in captured.out.splitlines()}
    assert lines["cache"].startswith("FAIL") and str(tmp_path) in lines["cache"]
    assert "weights.npz" in lines["weights"]


def test_shipped_weights_that_do_not_load_are_named(monkeypatch, tmp_path):
    """They are there, but not what they should be."""
    for place, name in ((pipeline.SHIPPED, "weights.npz"), (lstm.SHIPPED, "predictor.npz")):
        copy = tmp_path / place.name
        shutil.copytree(place, copy)
        (copy / name).write_bytes(b"torn")
    monkeypatch.setattr(pipeline, "SHIPPED", tmp_path / "laptop")
    monkeypatch.setattr(lstm, "SHIPPED", tmp_path / "predictor")
    lstm._shipped.cache_clear()
    for name, check, file in (
        ("weights", doctor._weights, "weights.npz"),
        ("predictor", doctor._predictor, "predictor.npz"),
    ):
        found = doctor._guarded(name, check)
        assert found.passed is False and file in found.detail


def test_sums_that_are_fused_wrongly_are_named_with_the_way_out(capsys, monkeypatch):
    monkeypatch.setattr(sums, "wrong_sums", lambda: ["sums are off by 2"])
    monkeypatch.setattr(sums, "many_axes_fault", lambda: "products end the process")
    mends = {"--a": f"set XLA_FLAGS={UNFUSED_SUMS}", "/my/flags": f"add the line {UNFUSED_SUMS} to /my/flags"}
    for flags, mend in mends.items():
        monkeypatch.setenv("XLA_FLAGS", flags)
        passed, detail = doctor._sums()
        assert not passed and "sums are off by 2; products end the process" in detail and mend in detail


def test_a_device_that_is_not_there_is_named():
    code = "from august_jax.app import cli; raise SystemExit(cli.main(['doctor']))"
    run = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"JAX_PLATFORMS": "abacus"}, text=True, capture_output=True
    )
    assert run.returncode == 2 and run.stderr.splitlines()[-1].startswith("august: failed: devices;")
    line = next(line for line in run.stdout.splitlines() if " devices " in line)
    assert line.startswith("FAIL") and "JAX_PLATFORMS: 'abacus'" in line and "set JAX_PLATFORMS=cpu" in line


def test_optimisation_turned_off_is_told(monkeypatch):
    wanted = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "True", "XLA_FLAGS": "--xla_backend_optimization_level=0"}
    for variable in wanted:
        for each, value in wanted.items():
            monkeypatch.setenv(each, value if each == variable else "")
        told = doctor._speed(False)[1]
        assert [each for each in wanted if f"{each} turns optimisation off: unset it" in told] == [variable]


def test_settings_of_jax_are_told(monkeypatch):
    for name in doctor.SETTINGS:
        monkeypatch.delenv(name, raising=False)
    assert doctor._settings() == (True, "JAX's own")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert doctor._settings() == (True, "JAX_PLATFORMS=cpu")
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    assert doctor._settings()[1].startswith("JAX_PLATFORMS=cpu, JAX_ENABLE_X64=1; stored samples come out the same")


def test_the_room_that_data_need_is_said(tmp_path, monkeypatch):
    free = 5 * 1024**3
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda place: SimpleNamespace(free=free))
    passed, detail = doctor._disk(tmp_path / "new" / "folder")
    assert passed and detail.startswith("5.0 GiB free; wanted 2")
    laptop = bytes_of(preset("laptop")) / 1024**3
    assert laptop > 5.0 and f"laptop {laptop:.1f} (more than there is)" in detail and "paper 2.1" in detail


def test_too_little_memory_is_a_fault_with_a_way_out(monkeypatch):
    monkeypatch.setattr(doctor, "memory", lambda: Memory(4 * 1024**3, 512 * 1024**2))
    passed, detail = doctor._memory()
    assert passed is False and "0.5 GiB free of 4.0; wanted 2.5, 1.2 at the least: end other programs" in detail
    monkeypatch.setattr(doctor, "memory", lambda: Memory(4 * 1024**3, 2 * 1024**3))
    passed, detail = doctor._memory()
    assert passed is None and "--search 0" in detail
    monkeypatch.setattr(doctor, "memory", lambda: None)
    assert doctor._memory() == (None, "the system does not tell")


def test_memory_of_this_machine_is_read():
    found = memory()
    assert found is None or (0 <= found.free <= found.total and found.total > 2**28)


def test_what_will_be_slow_is_said_with_the_way_out(monkeypatch, tmp_path):
    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path))
    monkeypatch.setattr(doctor, "_NVIDIA", (str(tmp_path),))
    passed, detail = doctor._speed(True)
    assert passed is None and "nothing is factored yet" in detail
    if jax.default_backend() == "cpu":
        assert "jax[cuda12]" in detail and "laptop" in detail
    (tmp_path / "body-1-x.npz").touch()
    assert "factored" not in doctor._speed(False)[1]


def test_the_cache_says_its_place_and_size(monkeypatch, tmp_path):
    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path))
    (tmp_path / "body-1-x.npz").write_bytes(bytes(3 * 1024**2))
    passed, detail = doctor._cache()
    assert passed and f"{tmp_path} can be written and holds 3 MiB" in detail and "AUGUST_CACHE" in detail
