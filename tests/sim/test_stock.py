"""Scoring through plain ManiSkill: its episodes are ours, and what it says if it cannot."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnit_zoo import tasks
from nnit_zoo.architecture import architectures
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.sim import stock
from nnit_zoo.sim.rollout import rollout

pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__")
ROBOT_TASKS = ("PickCube-v1", "PushCube-v1", "StackCubeEasy-v1")


@pytest.mark.parametrize("name", ROBOT_TASKS)
def test_stock_plays_our_episodes(scripted, name):
    task = tasks.get(name)
    for seed in (0, 4_000_000_000):
        ours = rollout(task, [seed], scripted(task, 1))
        theirs = stock.rollout(task, name, [seed], scripted(task, 1), "physx_cpu")
        np.testing.assert_allclose(theirs.rewards.sum(), ours.rewards.sum(), atol=1e-3)
        np.testing.assert_array_equal(theirs.success, ours.success)
        assert theirs.observations.shape == ours.observations.shape
        assert ours.success.any()


@pytest.mark.parametrize("name", ROBOT_TASKS)
def test_states_for_a_gpu_are_the_starts_of_the_seeds(name):
    task = tasks.get(name)
    env = stock._environment(name, 1, "physx_cpu")
    for seed in (3, 4):
        expected, _ = env.reset(seed=[seed])
        env.reset(seed=[5])
        states = stock.simulation_states(env, [task.start(seed)])
        observed, _ = env.reset(seed=[6], options={"reset_to_env_states": {"env_states": states}})
        torch.testing.assert_close(observed, expected)


def test_scores_through_stock_maniskill_are_ours():
    task = tasks.get("PickCube-v1")
    architecture = architectures("seen", task.inputs, task.outputs)[0]
    draws = torch.Generator().manual_seed(0)
    policies = PolicyBatch(
        architecture, tuple(torch.randn((2, *shape), generator=draws) for shape in architecture.block_shapes)
    )
    ours, theirs = (
        each.evaluate([policies], [7, 8], workers=1).to_pylist() for each in (task, task.simulated_by("stock"))
    )
    for our, their in zip(ours, theirs, strict=True):
        assert their == our | {"return": pytest.approx(our["return"], abs=1e-3)}


def test_a_missing_gpu_and_a_task_without_a_simulator_are_answered(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="--sim stock-gpu needs an NVIDIA GPU"):
        tasks.get("PickCube-v1").simulated_by("stock-gpu").check_installed()
    with pytest.raises(UserError, match="MNIST-PCA32 is not simulated"):
        tasks.get("MNIST-PCA32").simulated_by("stock")


def test_a_task_that_maniskill_does_not_have_is_answered():
    task = tasks.get("PickCube-v1")
    with pytest.raises(UserError, match="no environment named Juggling-v1"):
        stock.rollout(task, "Juggling-v1", [0], lambda observations: observations, "physx_cpu")
