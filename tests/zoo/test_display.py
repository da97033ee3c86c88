"""Progress, in a log or on a terminal: how much is done, how fast, and how long it will take."""

from __future__ import annotations

import pytest

from nnit_zoo import display


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: now[0])
    return now


def advance(clock, stage, *steps):
    for seconds, done in steps:
        clock[0] += seconds
        stage(done)


def test_a_log_gets_rate_and_time_left(clock, capsys):
    with display.Display(quiet=False).stage("episodes", 2000) as stage:
        advance(clock, stage, (0, 200), (20, 300), (1, 0), (20, 210), (0, 1290))
    assert capsys.readouterr().err.splitlines() == [
        "episodes: 2000",
        "episodes: 500 of 2000, 15/s, 100 s left",
        "episodes: 710 of 2000, 10/s, 129 s left",
        "episodes: 2000 of 2000 in 41 s",
    ]


def test_a_terminal_gets_a_bar(monkeypatch, capsys):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    with display.Display(quiet=False).stage("episodes", 4) as stage:
        stage(3)
    assert "3/4" in capsys.readouterr().err


def test_slow_work_is_told_in_minutes_and_hours(clock, capsys):
    with display.Display(quiet=False).stage("networks", 100) as stage:
        advance(clock, stage, (30, 1), (90, 1))
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:] == ["networks: 1 of 100, 2/min, 0:49:30 left", "networks: 2 of 100, 40/h, 2:27:00 left"]


def test_quiet_work_and_no_work_say_nothing(capsys):
    for quiet, total in ((True, 5), (False, 0)):
        with display.Display(quiet).stage("episodes", total) as stage:
            stage(total)
    assert capsys.readouterr().err == ""
