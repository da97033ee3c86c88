"""How tasks are found by name, what they declare, and which episodes belong to what."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnit_zoo import tasks
from nnit_zoo.errors import UserError
from nnit_zoo.places import tasks_with_zoo
from nnit_zoo.tasks.task import EPISODE_SCHEMA, Task


def test_a_task_is_found_by_its_name_and_a_wrong_one_gets_an_answer() -> None:
    assert [tasks.get(name).name for name in tasks.names()] == list(tasks.names())
    with pytest.raises(UserError, match="no task named 'PickCub-v1': did you mean PickCube-v1"):
        tasks.get("PickCub-v1")


@pytest.mark.parametrize("name", tasks.names())
def test_tasks_say_what_they_measure(name: str) -> None:
    task = tasks.get(name)
    columns = [metric.column for metric in task.metrics]
    assert set(columns) <= set(EPISODE_SCHEMA.names)
    assert set(task.thresholds) <= set(columns)
    assert columns[0] == next(iter(task.thresholds))  # the headline decides first which policies are kept
    assert set(task.scoring_seeds) <= set(task.episode_seeds[: task.scoring_seeds.stop])


@pytest.mark.parametrize("name", tasks_with_zoo())
def test_behaviour_is_compared_on_standardised_observations(name: str) -> None:
    task = tasks.get(name)
    states = task.probe_states()
    assert states is not None and states.shape == (2000, task.inputs)
    np.testing.assert_allclose(states.mean(0), 0, atol=0.7)
    assert states.std() == pytest.approx(1, abs=0.1)


def test_what_counts_of_outputs_is_clipped_actions_and_probabilities() -> None:
    assert tasks.get("PickCube-v1").behaviour(torch.tensor([-3.0, 0.5, 2.0])).tolist() == [-1, 0.5, 1]
    likely = tasks.get("MNIST-PCA32").behaviour(torch.tensor([[1.0, 3.0], [6.0, 2.0]]).log())
    torch.testing.assert_close(likely, torch.tensor([[0.25, 0.75], [0.75, 0.25]]))


def test_robot_episodes_belong_to_building_or_to_one_phase() -> None:
    task = tasks.get("PickCube-v1")
    select, report = task.phase_seeds("select", 500_000_000), task.phase_seeds("report", 500_000_000)
    assert task.scoring_seeds[-1] < select[0] and select[-1] < report[0] and report[-1] in task.episode_seeds
    assert task.phase_seeds("select", task.episodes) == select[:50]
    for episodes in (0, 500_000_001):
        with pytest.raises(UserError, match="1 to 500000000 episodes"):
            task.phase_seeds("select", episodes)


def test_a_task_without_what_scoring_needs_cannot_be_made() -> None:
    class Half(Task):
        name = "Half-v1"

    with pytest.raises(TypeError, match="evaluate"):
        Half()  # type: ignore[abstract]
