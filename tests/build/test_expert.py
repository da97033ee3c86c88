"""Training an expert: its advantages, and which of its states is kept."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from nnit_zoo.build import expert
from nnit_zoo.build.expert import ExpertConfig, Release
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.tasks.stack_cube_easy import StackCubeEasy

TINY_EXPERT = ExpertConfig(total_steps=300, environments=2, hidden=16, epochs=1, minibatch=50, evaluate_every=1)


def test_the_best_expert_is_kept_and_not_the_last(tmp_path, monkeypatch):
    scores = iter([1.0, 3.0, 2.0])
    best = {"success_once": 0.0, "success_at_end": 0.0, "episodes": 2}
    monkeypatch.setattr(expert, "EVALUATION_SEEDS", range(1))
    monkeypatch.setattr(expert, "summarise", lambda episodes: {"return": next(scores), **best})
    networks = []
    monkeypatch.setattr(expert, "save", lambda network, path: networks.append(network))
    record = expert.train(PickCube(), TINY_EXPERT, tmp_path, 1, print)
    assert (record["return"], record["steps"], len(networks)) == (3, 200, 2)
    assert json.loads((tmp_path / "record.json").read_text()) == record


def test_an_expert_that_reaches_both_scores_is_kept_though_another_had_a_higher_return(tmp_path, monkeypatch):
    scores = iter([(3.0, 0.5), (2.5, 1.0), (9.0, 1.0)])
    monkeypatch.setattr(expert, "EVALUATION_SEEDS", range(1))
    monkeypatch.setattr(
        expert, "summarise", lambda episodes: dict(zip(("return", "success_at_end"), next(scores), strict=True))
    )
    config = TINY_EXPERT.model_copy(update={"stop_return": 2.0, "stop_success": 0.9})
    record = expert.train(PickCube(), config, tmp_path, 1, print)
    assert (record["return"], record["steps"]) == (2.5, 200)
    assert json.loads((tmp_path / "record.json").read_text()) == record


def test_advantages_follow_their_definition():
    draws = torch.Generator().manual_seed(0)
    rewards, values = torch.rand((5, 2), generator=draws), torch.rand((6, 2), generator=draws)
    ours = expert.generalised_advantages(rewards, values, 0.9, 0.8)
    deltas = rewards + 0.9 * values[1:] - values[:-1]
    for start in range(5):
        sums = sum((0.9 * 0.8) ** later * deltas[start + later] for later in range(5 - start))
        torch.testing.assert_close(ours[start], sums)


def test_letting_go_is_shown_from_when_the_cube_is_held_in_place(monkeypatch):
    task = StackCubeEasy()
    network = expert.network_of(expert.Training(task, TINY_EXPERT).model.actor)
    observations = np.zeros((4, task.inputs), np.float32)
    observations[:, 18] = [1, 1, 0, 1]  # is_grasped
    observations[:, 39:] = np.array([0.0, 0.011, 0.0, 0.013])[:, None] * [1, 0, 0]  # obj_to_goal_pos
    assert expert._holds_at_goal(task, observations).tolist() == [True, True, False, False]

    calls = iter(range(task.episode_steps))
    monkeypatch.setattr(expert, "_holds_at_goal", lambda task, observations: np.array([next(calls) == 20, False]))
    std, seeds = np.full(task.outputs, 0.1, np.float32), range(2)
    shown = expert.explore(task, network, seeds, std, 5, 1.0).actions[..., -1]
    plain = expert.explore(task, network, seeds, std, 5, 0.0).actions[..., -1]
    assert (shown[20:, 0] >= 0.4).all() and (shown[20:, 0] <= 1).all()
    assert (shown[:20, 0] == plain[:20, 0]).all() and (shown[:, 1] == plain[:, 1]).all()
    assert abs(plain).max() < 0.6


def test_letting_go_is_taught_from_when_it_is_told(monkeypatch):
    """Until then, the training is that without it, to the bit."""
    release = Release(after_steps=200, share=1.0, bound_weight=1.0, least_std=0.9)
    shares = []
    explore = expert.explore
    monkeypatch.setattr(expert, "explore", lambda *given: shares.append(given[-1]) or explore(*given))
    taught, plain = (
        expert.Training(PickCube(), TINY_EXPERT.model_copy(update={"release": each})) for each in (release, None)
    )
    for _ in range(2):
        assert taught.iterate(1) == plain.iterate(1)
    assert all(torch.equal(*pair) for pair in zip(taught.model.parameters(), plain.model.parameters(), strict=True))
    taught.iterate(1)
    assert shares == [0.0] * 4 + [1.0]
    taught_std, plain_std = (training.model.log_std[-1].exp().item() for training in (taught, plain))
    assert taught_std == pytest.approx(0.9, abs=0.01) and plain_std < 0.7


@pytest.mark.parametrize(("weight", "low", "high"), [(0.0, 2.9, 3.1), (1.0, 0.5, 1.1)])
def test_mean_actions_are_held_within_what_the_robot_takes(weight, low, high):
    """A gripper whose mean is far outside is out of reach of its noise, and could never learn to open."""
    release = Release(after_steps=0, share=0.0, bound_weight=weight, least_std=0.1)
    config = TINY_EXPERT.model_copy(update={"release": release, "learning_rate": 1e-3, "total_steps": 10**6})
    training = expert.Training(PickCube(), config)
    with torch.no_grad():
        training.model.actor[-1].bias.fill_(3.0)
    observations = torch.zeros(26, 4, PickCube().inputs)
    for _ in range(100):
        training._update(observations, torch.full((25, 4, PickCube().outputs), 3.0), torch.zeros(25, 4))
    means = training.model.actor(observations[0]).abs()
    assert ((means > low) & (means < high)).all()
