"""How tasks are found by name, what they declare, and which episodes belong to what."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from nnit_zoo import tasks
from nnit_zoo.errors import UserError
from nnit_zoo.tasks.task import EPISODE_SCHEMA, Task

PLUGIN = """
from nnit_zoo.tasks.task import Metric, Task

class Balance(Task):
    name = "Balance-v1"
    version = 1
    inputs, outputs = 4, 1
    metrics = (Metric("return", "seconds upright", ""),)
    thresholds = {"return": 10.0}

    def evaluate(self, policies, seeds, *, workers=2, progress=None):
        raise NotImplementedError

class Stranger:
    name = "Stranger-v1"
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package with tasks, good and bad."""
    (tmp_path / "balance_plugin.py").write_text(PLUGIN)
    (tmp_path / "broken_plugin.py").write_text("1 / 0")
    folder = tmp_path / "balance_plugin-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: balance-plugin\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[nnit.tasks]\n"
        "Balance-v1 = balance_plugin:Balance\n"
        "Balance-v2 = balance_plugin:Balance\n"
        "Stranger-v1 = balance_plugin:Stranger\n"
        "Nobody-v1 = balance_plugin:Nobody\n"
        "Broken-v1 = broken_plugin:Anything\n"
        "MNIST-PCA32 = balance_plugin:Balance\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "balance_plugin", raising=False)
    return tmp_path


def test_installed_tasks_are_listed_without_being_imported(plugin: Path) -> None:
    names = tasks.names()
    assert {"PickCube-v1", "MNIST-PCA32", "Balance-v1", "Broken-v1"} <= set(names)
    assert len(set(names)) == len(names)
    assert not {"balance_plugin", "broken_plugin"} & sys.modules.keys()


def test_an_installed_task_is_found_and_a_built_in_name_stays_built_in(plugin: Path) -> None:
    task = tasks.get("Balance-v1")
    assert (task.name, task.inputs, task.metrics[0].label) == ("Balance-v1", 4, "seconds upright")
    assert len(task.phase_seeds("select", 7)) == 7
    tasks.get.cache_clear()
    assert tasks.get("MNIST-PCA32").inputs == 32


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Balanc-v1", "did you mean Balance-v1"),
        ("Broken-v1", "'Broken-v1' cannot be loaded from broken_plugin:Anything: .*division by zero"),
        ("Nobody-v1", "'Nobody-v1' cannot be loaded .*Nobody"),
        ("Stranger-v1", "not a subclass"),
        ("Balance-v2", "with the name 'Balance-v2'"),
    ],
)
def test_a_wrong_name_or_a_broken_plugin_gets_an_answer(plugin: Path, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        tasks.get(name)
    assert tasks.get("Balance-v1").outputs == 1  # one bad task does not stop another


@pytest.mark.parametrize("name", tasks.BUILT_IN)
def test_built_in_tasks_say_what_they_measure(name: str) -> None:
    task = tasks.get(name)
    columns = [metric.column for metric in task.metrics]
    assert set(columns) <= set(EPISODE_SCHEMA.names)
    assert set(task.thresholds) <= set(columns)
    assert columns[0] == next(iter(task.thresholds))  # the headline decides first which policies are kept
    assert set(task.scoring_seeds) <= set(task.episode_seeds[: task.scoring_seeds.stop])


def test_robot_episodes_belong_to_building_or_to_one_phase() -> None:
    task = tasks.get("PickCube-v1")
    select, report = task.phase_seeds("select", 500_000_000), task.phase_seeds("report", 500_000_000)
    assert task.scoring_seeds[-1] < select[0] and select[-1] < report[0] and report[-1] in task.episode_seeds
    assert task.phase_seeds("select", task.episodes) == select[:50]
    for episodes in (0, 500_000_001):
        with pytest.raises(UserError, match="1 to 500000000 episodes"):
            task.phase_seeds("select", episodes)


def test_importing_the_registry_imports_no_task() -> None:
    code = "import sys; from nnit_zoo import tasks; tasks.names(); print([m for m in sys.modules if 'zoo.tasks.' in m])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_task_without_what_scoring_needs_cannot_be_made() -> None:
    class Half(Task):
        name = "Half-v1"

    with pytest.raises(TypeError, match="evaluate"):
        Half()  # type: ignore[abstract]
