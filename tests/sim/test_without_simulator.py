"""What a user without the simulator's extra can do, and what they are told."""

from __future__ import annotations

import importlib.util
import sys

import pytest

from nnit_bench import cli
from nnit_zoo import tasks
from nnit_zoo.errors import UserError
from nnit_zoo.sim import tabletop


@pytest.fixture
def no_simulator(monkeypatch):
    find_spec = importlib.util.find_spec
    hidden = ("sapien", "mani_skill")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in hidden else find_spec(name))
    tabletop.require_simulator.cache_clear()
    yield
    tabletop.require_simulator.cache_clear()


def test_scoring_says_what_to_install(no_simulator, monkeypatch, capsys):
    with pytest.raises(UserError, match="pip install"):
        tasks.get("PickCube-v1").check_installed()
    monkeypatch.setattr(sys, "argv", ["nnit-bench", "run", "--method", "crop"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert "nnit[sim]" in capsys.readouterr().err
