"""The doctor: passes where all is well, and names what is not."""

import json

from august_jax import cli, pipeline


def test_a_sound_installation_passes(capsys):
    status = cli.main(["doctor", "--json"])
    captured = capsys.readouterr()
    checks = {check["name"]: check for check in json.loads(captured.out)["checks"]}
    assert status == 0, captured.err
    assert {"python", "packages", "devices", "physics", "cache", "disk", "weights"} <= set(checks)
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
