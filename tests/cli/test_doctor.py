"""The doctor: passes where all is well, and names what is not."""

import json
import os
import subprocess
import sys

import pytest

from august_jax import pipeline
from august_jax.app import cli


def test_a_sound_installation_passes(capsys):
    status = cli.main(["doctor", "--json"])
    captured = capsys.readouterr()
    checks = {check["name"]: check for check in json.loads(captured.out)["checks"]}
    assert status == 0, captured.err
    assert {"python", "packages", "devices", "sums", "physics", "cache", "disk", "weights"} <= set(checks)
    assert all(check["passed"] is not False and check["detail"] for check in checks.values())


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


@pytest.mark.parametrize(("flags", "kept"), [("", ""), ("--xla_cpu_enable_fast_math=false", "fast_math=false")])
def test_the_package_leaves_out_the_fusion_that_sums_wrongly(flags, kept):
    code = "import august_jax, os; from august_jax.doctor import _sums; print(os.environ['XLA_FLAGS'], _sums())"
    run = subprocess.run([sys.executable, "-c", code], env=os.environ | {"XLA_FLAGS": flags}, text=True,
                         capture_output=True, check=True)
    assert kept in run.stdout and "(True, 'sums that are broadcast come out right')" in run.stdout
