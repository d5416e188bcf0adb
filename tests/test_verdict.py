"""The verdict: numbers are those of the result files, to the places that are written."""

from __future__ import annotations

import importlib
import json

import numpy as np
import pytest
import scripts

CLAIM = """
- figure: position_error
  claim: errs least
  why: because
  laptop:
    verdict: agrees
    numbers:
      - {what: at 20 dB, column: mpe_m, where: {line: august, snr_db: 20}, value: %s, unit: m}
      - {what: the second power, column: wd_db, at: 1, value: -3.0, unit: dB}
      - {what: from slot 2 on, column: error_m, where: {style: smooth}, since: 1, value: 0.3, unit: m}
      - {what: one cloud, file: times.json, column: one_s, where: {sampler: dpm}, times: 1000, value: 12.5, unit: ms}
"""


@pytest.fixture
def verdict(monkeypatch):
    """The script as a module."""
    for folder in ("experiments/paper", "experiments"):
        monkeypatch.syspath_prepend(scripts.ROOT / folder)
    return importlib.import_module("verdict")


@pytest.fixture
def results(tmp_path):
    """Result files."""
    (tmp_path / "laptop").mkdir()
    np.savez(
        tmp_path / "laptop" / "position_error.npz",
        line=np.array(["august", "august", "polar"]),
        snr_db=np.array([10.0, 20.0, 20.0]),
        mpe_m=np.array([0.3, 0.1249, 0.5]),
        style=np.array(["smooth", "dynamic"]),
        error_m=np.array([[[9.0, 0.2, 0.4], [np.nan] * 3], [[9.0, 8.0, 7.0]] * 2]),  # nobody followed the second flight
        wd_db=np.array([[1.0, -2.0], [1.0, -3.0], [1.0, -4.0]]),
    )
    rows = [{"sampler": "ancestral", "one_s": 0.2}, {"sampler": "dpm", "one_s": 0.0125}]
    (tmp_path / "times.json").write_text(json.dumps({"rows": rows}))
    return tmp_path


def told(verdict, results, text, names=("position_error",)):
    """Claims of this text, and what is wrong with them."""
    path = results / "claims.yaml"
    path.write_text(text)
    found = verdict.claims(path)
    return found, verdict.faults(found, names, results)


def test_numbers_as_the_results_have_them_pass_and_are_told(verdict, results):
    found, wrong = told(verdict, results, CLAIM % "0.125")
    assert not wrong
    assert verdict.lines(found, results).splitlines()[2] == (
        "| errs least | laptop: at 20 dB 0.125 m; the second power -3.0 dB; from slot 2 on 0.3 m; one cloud 12.5 ms | "
        "laptop: **agrees**<br>paper: not run | because |"
    )


@pytest.mark.parametrize(
    "changed, by, message",
    [
        ("%s", "0.126", "position_error, laptop, at 20 dB: written 0.126, the results say 0.1249"),
        ("%s", "0.1250", "written 0.1250, the results say 0.1249"),
        ("snr_db: 20", "snr_db: 25", "no entry where"),
        ("mpe_m", "mpe", "has no column 'mpe'; there are error_m, line, mpe_m"),
        ("agrees", "maybe", "verdict 'maybe'; there are agrees, partly, not"),
        ("times.json", "none.json", "No such file"),
        ("figure: position_error", "figure: other", "position_error: no claim is about this figure"),
    ],
)
def test_what_the_results_do_not_say_is_told(verdict, results, changed, by, message):
    text = CLAIM.replace(changed, by)
    _, wrong = told(verdict, results, text if changed == "%s" else text % "0.125")
    assert any(message in line for line in wrong), wrong


def test_a_claim_without_a_reason_is_refused(verdict, results):
    with pytest.raises(ValueError, match="a claim has .*'claim', 'figure', 'laptop'.; give"):
        told(verdict, results, (CLAIM % "0.125").replace("  why: because\n", ""))


def test_the_table_stands_between_its_marks(verdict):
    first, last = verdict.MARKS
    text = f"before\n{first}\nold\n{last}\nafter\n"
    again = verdict.written(text, "new")
    assert again == f"before\n{first}\nnew\n{last}\nafter\n" == verdict.written(again, "new")
    with pytest.raises(ValueError, match="the marks .* put them back"):
        verdict.written("none", "new")


def test_the_verdict_holds_against_the_results_and_the_readme_has_it(verdict):
    from reproduce import PAPER

    found, results = verdict.claims(), scripts.ROOT / "experiments" / "results"
    assert not verdict.faults(found, PAPER, results)
    text = (scripts.ROOT / "experiments" / "README.md").read_text(encoding="utf-8")
    assert verdict.written(text, verdict.lines(found, results)) == text
