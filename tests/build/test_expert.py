"""Training an expert: its advantages, and which of its states is kept."""

from __future__ import annotations

import json

import torch

from nnit_zoo.build import expert
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.tasks.pick_cube import PickCube

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


def test_advantages_follow_their_definition():
    draws = torch.Generator().manual_seed(0)
    rewards, values = torch.rand((5, 2), generator=draws), torch.rand((6, 2), generator=draws)
    ours = expert.generalised_advantages(rewards, values, 0.9, 0.8)
    deltas = rewards + 0.9 * values[1:] - values[:-1]
    for start in range(5):
        sums = sum((0.9 * 0.8) ** later * deltas[start + later] for later in range(5 - start))
        torch.testing.assert_close(ours[start], sums)
