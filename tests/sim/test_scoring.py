"""Scoring policies on the robot tasks: the table of episodes, and that nothing but the episode decides its row."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nnit_zoo import tasks
from nnit_zoo.architecture import Architecture, architectures
from nnit_zoo.build import expert
from nnit_zoo.errors import UserError
from nnit_zoo.places import data_folder
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.sim.control import Controller
from nnit_zoo.tasks import robot

TASK = tasks.get("PickCube-v1")


NETWORK = expert.load(data_folder("PickCube-v1") / "expert.safetensors")


def noisy_policies(count, inputs=42):
    """Policies of three architectures, with random weights."""
    generator = torch.Generator().manual_seed(0)
    batches = []
    for architecture in architectures("seen", inputs, 8)[:: 64 // 3][:3]:
        shapes = [(count, *shape) for shape in architecture.block_shapes]
        layers = tuple(torch.randn(shape, generator=generator) / shape[2] ** 0.5 for shape in shapes)
        batches.append(PolicyBatch(architecture, layers))
    return batches


def expert_policy(noise, copies):
    """The expert itself as a policy on standardised observations, with some weight noise, `copies` times."""
    generator = torch.Generator().manual_seed(0)
    architecture = Architecture(42, (256, 256, 256), 8)
    layers = []
    for level, (weight, bias) in enumerate(NETWORK):
        block = torch.from_numpy(np.concatenate([weight, bias[:, None]], axis=1)).double()
        if level == 0:
            mean, std = (torch.from_numpy(each).double() for each in (TASK.observation_mean, TASK.observation_std))
            block = torch.cat([block[:, :-1] * std, block[:, -1:] + (block[:, :-1] @ mean)[:, None]], dim=1)
        block = block * (1 + noise * torch.randn((copies, *block.shape), generator=generator, dtype=torch.float64))
        layers.append(block.float())
    return PolicyBatch(architecture, tuple(layers))


def test_episodes_do_not_depend_on_order_company_or_processes():
    policies = [expert_policy(0.05, 2), *noisy_policies(1)]
    seeds = [5, 8]
    table = TASK.evaluate(policies, seeds, workers=1).to_pylist()
    backward = TASK.evaluate(policies[::-1], seeds[::-1], workers=1).to_pylist()
    parallel = TASK.evaluate(policies, seeds, workers=2).to_pylist()
    alone = TASK.evaluate([policies[0][1]], [8], workers=1).to_pylist()
    assert table == parallel
    scores = {(row["architecture"], row["seed"], row["return"], row["success_at_end"]) for row in table}
    assert scores == {(row["architecture"], row["seed"], row["return"], row["success_at_end"]) for row in backward}
    last = next(row for row in table if row["policy"] == 1 and row["seed"] == 8)
    assert {**alone[0], "policy": 1} == last
    assert max(row["return"] for row in table) > 20  # some of these episodes grasp the cube


@pytest.mark.parametrize("name", ["PickCube-v1", "PushCube-v1", "StackCubeEasy-v1"])
def test_rows_are_complete_and_ordered_and_progress_counts_every_episode(name):
    task = type(tasks.get(name))()
    task.record = {"observation_mean": [0.0] * task.inputs, "observation_std": [1.0] * task.inputs}
    counts = []
    table = task.evaluate(noisy_policies(2, task.inputs), [3, 1], workers=1, progress=counts.append)
    assert table["policy"].to_pylist() == [index for index in range(6) for _ in range(2)]
    assert table["seed"].to_pylist() == [3, 1] * 6
    assert sum(counts) == 12


def test_a_policy_that_is_not_finite_scores_zero_with_a_reason_and_does_not_touch_the_others():
    (batch, *_) = noisy_policies(2)
    broken = PolicyBatch(batch.architecture, tuple(layer.clone() for layer in batch.layers))
    broken.layers[2][0, 0, 0] = float("nan")
    rows = TASK.evaluate([broken], [4], workers=1).to_pylist()
    assert (rows[0]["return"], rows[0]["success_once"], rows[0]["reason"]) == (0, False, "not finite")
    assert {**rows[1], "policy": 0} == TASK.evaluate([batch[1]], [4], workers=1).to_pylist()[0]


def test_success_once_and_at_the_end_are_told_apart(monkeypatch):
    success = (np.arange(50) == 10)[:, None]
    played = SimpleNamespace(rewards=np.full((50, 1), 0.5, np.float32), success=success)
    monkeypatch.setattr(robot, "rollout", lambda *_: played)
    [row] = TASK.evaluate([noisy_policies(1)[0]], [0], workers=1).to_pylist()
    assert (row["return"], row["success_once"], row["success_at_end"]) == (25, True, False)


def test_controller_agrees_with_the_policy_batch():
    (batch, *_) = noisy_policies(5)
    observations = np.random.default_rng(0).normal(size=(5, 42)).astype(np.float32)
    networks = [[layer[index].numpy() for layer in batch.layers] for index in range(5)]
    ours = Controller(networks, np.zeros(42, np.float32), np.ones(42, np.float32))(observations)
    np.testing.assert_allclose(ours, batch(torch.from_numpy(observations)[:, None])[:, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("policies", "seeds", "message"),
    [
        ([], [1], "at least one policy"),
        (noisy_policies(1), [], "one episode"),
        (noisy_policies(1), [-1], "seeds of 0 or more"),
    ],
)
def test_nothing_to_score_is_said_in_words(policies, seeds, message):
    with pytest.raises(UserError, match=message):
        TASK.evaluate(policies, seeds)


def test_policies_of_other_sizes_are_refused():
    architecture = Architecture(35, (16, 16, 16, 16), 8)
    batch = PolicyBatch(architecture, tuple(torch.zeros(1, *shape) for shape in architecture.block_shapes))
    with pytest.raises(UserError, match="42 inputs"):
        TASK.evaluate([batch], [0])
