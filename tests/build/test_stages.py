"""Building a zoo, at toy size: every artifact is there, and a killed build ends with the same bytes."""

from __future__ import annotations

import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from nnit_zoo import tasks
from nnit_zoo.architecture import Architecture
from nnit_zoo.build import distill, expert, stages
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.errors import UserError
from nnit_zoo.materialise import materialise
from nnit_zoo.tasks import task as task_module
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.zoo import Zoo

TINY_EXPERT = ExpertConfig(total_steps=200, environments=2, hidden=16, epochs=1, minibatch=50, evaluate_every=1)
TINY_DISTILL = DistillConfig(rounds=2, episodes_per_round=2, round_steps=2, steps=3, architectures_per_step=2)
FEW = {"seen": ("16-32-64-16", "64-64-64-64"), "unseen": ("16-16-16-32",), "excluded": ("32-16-16-16",)}


@pytest.fixture
def builder(monkeypatch):
    """A function that makes a toy builder whose package data go to a folder of the test's."""
    monkeypatch.setattr(expert, "EVALUATION_SEEDS", range(2))
    monkeypatch.setattr(stages, "SCORING_SEEDS", range(2))
    monkeypatch.setattr(stages, "architectures", few_architectures)

    def make(folder):
        monkeypatch.setattr(stages, "data_folder", lambda name: folder / "data")
        monkeypatch.setattr(task_module, "data_folder", lambda name: folder / "data")
        built = stages.Builder(PickCube(), folder / "work", seeds=2, workers=1)
        built.expert_config, built.distill_config = TINY_EXPERT, TINY_DISTILL
        return built

    return make


def few_architectures(split, inputs, outputs):
    return tuple(Architecture.parse(text, inputs, outputs) for text in FEW[split])


def run_all(builder):
    for stage in stages.STAGES:
        getattr(builder, stage)()


def artifacts(folder):
    return {path.name: path.read_bytes() for path in (folder / "data").iterdir() if path.name != "task.json"}


def test_a_build_that_was_killed_in_every_stage_ends_with_the_same_bytes(builder, tmp_path, monkeypatch):
    run_all(builder(tmp_path / "whole"))
    whole = artifacts(tmp_path / "whole")
    assert set(whole) == {
        "expert.safetensors",
        "ghns.safetensors",
        "index.parquet",
        "manifest.json",
        "scores.parquet",
        "selection.parquet",
    }
    for module, name in (
        (expert.Training, "iterate"),
        (distill.Regression, "run"),
        (distill, "train_ghn"),
        (PickCube, "evaluate"),
        (stages, "write_manifest"),
    ):
        with monkeypatch.context() as killing:
            kill_second_call(killing, module, name)
            with pytest.raises(KeyboardInterrupt):
                run_all(builder(tmp_path / "killed"))
                run_all(builder(tmp_path / "killed"))  # the last stage calls once a build
    run_all(builder(tmp_path / "killed"))
    assert artifacts(tmp_path / "killed") == whole

    materialise(tmp_path / "killed" / "data", tmp_path / "zoo")
    zoo = Zoo.open(tmp_path / "zoo")
    assert {split: len(zoo.architectures(split)) for split in ("seen", "unseen", "excluded")} == {
        "seen": 0,  # nothing passes after so little training
        "unseen": 1,
        "excluded": 1,
    }
    record = json.loads((tmp_path / "killed" / "data" / "task.json").read_text())
    assert record["build"]["expert"]["config"]["hidden"] == 16
    assert record["build"]["distill"]["states"] == 2 * 2 * 50


def kill_second_call(monkeypatch, module, name):
    original, calls = getattr(module, name), []

    def wrapped(*args, **kwargs):
        calls.append(name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    monkeypatch.setattr(module, name, wrapped)


def test_a_stage_without_the_one_before_says_which_to_run(builder, tmp_path):
    with pytest.raises(UserError, match="stage 'expert' first"):
        builder(tmp_path).states()
    with pytest.raises(UserError, match="stage 'scores' first"):
        builder(tmp_path).pack()


def scores_of(means):
    rows = [
        {"architecture": "x", "ghn_seed": seed, "seed": episode, "return": returns, "success_once": True}
        | {"success_at_end": episode < round(success * 10)}
        for seed, (success, returns) in enumerate(means)
        for episode in range(10)
    ]
    return pa.Table.from_pylist(rows)


def test_selection_keeps_the_best_that_reach_both_thresholds():
    task = tasks.get("PickCube-v1")
    scores = scores_of([(0.9, 36.0), (1.0, 34.0), (0.8, 40.0), (1.0, 35.0)])
    rows = list(stages.select(task, "seen", "x", scores))
    assert [row["kept"] for row in rows] == [True, False, False, True]
    assert [row["success_at_end"] for row in rows] == [0.9, 1.0, 0.8, 1.0]
    assert all(row["kept"] for row in stages.select(task, "unseen", "x", scores))

    many = scores_of([(0.9 + 0.1 * (seed % 2), 36.0) for seed in range(120)])
    kept = [row["ghn_seed"] for row in stages.select(task, "seen", "x", many) if row["kept"]]
    assert len(kept) == 100 and set(range(1, 120, 2)) <= set(kept)


def test_advantages_follow_their_definition():
    draws = torch.Generator().manual_seed(0)
    rewards, values = torch.rand((5, 2), generator=draws), torch.rand((6, 2), generator=draws)
    ours = expert.generalised_advantages(rewards, values, 0.9, 0.8)
    deltas = rewards + 0.9 * values[1:] - values[:-1]
    for start in range(5):
        sums = sum((0.9 * 0.8) ** later * deltas[start + later] for later in range(5 - start))
        torch.testing.assert_close(ours[start], sums)


def test_the_scores_of_a_candidate_do_not_depend_on_which_stage_run_made_them(builder, tmp_path):
    run_all(builder(tmp_path))
    path = tmp_path / "work" / "scores" / "16-16-16-32.parquet"
    before = pq.read_table(path)
    path.unlink()
    builder(tmp_path).scores()
    assert pq.read_table(path).equals(before)
