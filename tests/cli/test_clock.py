"""Time left: by the last time, stage by stage, and nothing promised before."""

import io
import re
import time

import pytest

from august_jax.app.cli import clock
from august_jax.app.cli.clock import Clock, told_s
from august_jax.app.cli.messages import note

USUAL = [("", 2.0), ("compiling", 10.0), ("flying # slots", 30.0), ("compiling", 5.0)]


def test_nothing_is_promised_before_the_first_time():
    fresh = Clock(now=0.0)
    fresh.heard("compiling", 1.0)
    assert fresh.left_s(20.0) is None and fresh.said(20.0) == "20 s so far"
    told = Clock(now=0.0, first="two minutes")
    assert told.said(20.0) == "20 s so far; for the first time it takes two minutes"
    assert "first time" not in Clock(USUAL, now=0.0, first="two minutes").said(1.0)


def test_time_left_is_what_the_last_time_took_from_here():
    again = Clock(USUAL, now=0.0)
    assert again.left_s(1.0) == pytest.approx(46.0)
    again.heard("compiling", 2.0)
    assert again.left_s(6.0) == pytest.approx(6.0 + 35.0)
    assert again.left_s(60.0) == pytest.approx(35.0)  # later than usual: nothing less than nothing
    again.heard("flying 12 slots", 12.0)
    assert again.left_s(22.0) == pytest.approx(20.0 + 5.0) and "about 25 s left" in again.said(22.0)
    again.heard("compiling", 42.0)  # the second stage of that name, not the first
    assert again.left_s(42.0) == pytest.approx(5.0)
    again.heard("what it never said", 50.0)
    assert again.left_s(51.0) is None
    assert again.stages(52.0) == [("", 2.0), ("compiling", 10.0), ("flying # slots", 30.0), ("compiling", 8.0),
                                  ("what it never said", 2.0)]  # fmt: skip


def test_a_command_remembers_how_long_it_took_and_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path))
    monkeypatch.setattr(clock, "_SILENT_S", 0.2)
    monkeypatch.setattr(clock, "_AGAIN_S", {True: 0.1, False: 0.2})

    def run():
        told = io.StringIO()
        monkeypatch.setattr("sys.stderr", told)
        with clock.watched("demo"):
            note("computing")
            time.sleep(1.6)
        return told.getvalue()

    assert re.search(r"\.\.\. \d s so far\n", run())
    assert re.search(r"\.\.\. \d s so far, about \d s left by the last time\n", run())
    (tmp_path / "durations.json").write_text("{torn")
    assert "left" not in run()


def test_a_terminal_keeps_one_line_that_goes_before_the_next(monkeypatch, tmp_path):
    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path))
    monkeypatch.setattr(clock, "_SILENT_S", 0.2)
    monkeypatch.setattr(clock, "_AGAIN_S", {True: 0.1, False: 9.0})
    told = io.StringIO()
    told.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", told)
    with clock.watched("demo"):
        note("computing")
        time.sleep(1.6)
        note("done")
    lines = told.getvalue().split("\n")
    assert lines[0] == "computing" and lines[1].endswith("\r\x1b[Kdone") and lines[2:] == [""]
    assert "\r  ... " in lines[1]


def test_seconds_and_minutes():
    assert [told_s(each) for each in (0.4, 99.0, 185.0)] == ["0 s", "99 s", "3:05 min"]
