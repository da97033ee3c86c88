"""Candidates are scored and packed into a zoo that is whole or not there, at toy size."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import pyarrow.parquet as pq
import pytest

from nnit_zoo import files, places, tasks
from nnit_zoo.build import builder as common
from nnit_zoo.build import command, mnist, robot
from nnit_zoo.errors import UserError
from nnit_zoo.materialise import materialise
from nnit_zoo.places import data_folder
from nnit_zoo.tasks.mnist import MNISTPCA32
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.verify import rescore
from nnit_zoo.zoo import Zoo

from .conftest import FEW, TINY_FIT, artifacts, kill_call, run_all


def test_policies_that_cannot_enter_the_corpus_play_fewer_episodes(builder, tmp_path, monkeypatch):
    monkeypatch.setattr(files, "HELDOUT_SEEDS_FROM", 1)
    monkeypatch.setattr(robot.RobotBuilder, "yardstick_episodes", 1)
    built = builder(tmp_path)
    run_all(built)
    rows = pq.read_table(data_folder("PickCube-v1") / "selection.parquet").to_pylist()
    played = {(row["architecture"], row["ghn_seed"]): row["episodes"] for row in rows}
    assert played == {
        (architecture, seed): 2 if split == "seen" and seed == 0 else 1
        for split, listed in FEW.items()
        for architecture in listed
        for seed in (0, 1)
    }
    scores = pq.read_table(data_folder("PickCube-v1") / "scores.parquet").to_pylist()
    first = [(row["ghn_seed"], row["seed"]) for row in scores if row["architecture"] == FEW["seen"][0]]
    assert first == [(0, 0), (0, 1), (1, 0)]

    monkeypatch.setattr(PickCube, "evaluate", None)
    builder(tmp_path).scores()  # nothing is missing
    monkeypatch.undo()

    monkeypatch.setattr(tasks, "get", lambda name: built.task)
    monkeypatch.setattr(PickCube, "scoring_seeds", range(2))
    materialise(tmp_path / "data" / "PickCube-v1", tmp_path / "zoo")
    episodes = []
    rescored = rescore(tmp_path / "zoo", 9, episodes.append)
    assert all(row["agrees"] and row["now_return"] == row["stored_return"] for row in rescored)
    assert sum(episodes) == len(rescored) == 6  # of seed 1, and seed 0's of the other two architectures


def test_scores_of_other_ghns_are_made_again(builder, tmp_path):
    run_all(builder(tmp_path, "MNIST-PCA32"))
    shutil.rmtree(tmp_path / "work" / "ghns")
    better = builder(tmp_path, "MNIST-PCA32")
    better.config = TINY_FIT.model_copy(update={"steps": 30})
    better.ghns()
    with pytest.raises(UserError, match="stage 'scores' first"):
        better.pack()
    better.scores()
    better.pack()
    materialise(data_folder("MNIST-PCA32"), tmp_path / "zoo")
    zoo = Zoo.open(tmp_path / "zoo")
    for row in zoo.index.to_pylist():
        policy = zoo.batch(row["architecture"], row["split"])[row["row"]]
        played = MNISTPCA32().evaluate([policy], range(100))["return"].to_numpy()
        assert row["return"] == pytest.approx(played.mean())
    assert json.loads((data_folder("MNIST-PCA32") / "task.json").read_text())["build"]["ghns"]["steps"] == 30


def test_a_zoo_is_in_place_until_another_is_whole_and_not_replaced_by_a_smaller_one(builder, tmp_path, monkeypatch):
    run_all(builder(tmp_path, "MNIST-PCA32"))
    before = artifacts(tmp_path)
    more = builder(tmp_path, "MNIST-PCA32")
    more.seeds = range(3)
    more.ghns()
    more.scores()
    with monkeypatch.context() as killing:
        killing.setattr(common, "write_manifest", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            more.pack()
    assert artifacts(tmp_path) == before
    sample = Path(__file__).parents[1] / "zoo" / "mnist"
    with pytest.raises(UserError, match="was made for other features"):
        builder(tmp_path, "MNIST-PCA32", source=str(sample)).features()
    monkeypatch.setattr(mnist, "MNISTConfig", lambda: TINY_FIT)
    with pytest.raises(UserError, match=r"is of 2 GHNs, and 1 would take their place; .* ghns\.safetensors, scores"):
        command.build(task="MNIST-PCA32", seeds=1, work=tmp_path)


def test_a_zoo_is_never_a_mixture_of_two(builder, tmp_path, monkeypatch):
    run_all(builder(tmp_path, "MNIST-PCA32"))
    more = builder(tmp_path, "MNIST-PCA32")
    more.seeds = range(3)
    more.ghns()
    more.scores()
    for number in range(1, len(common.ZOO) + 1):
        with monkeypatch.context() as killing:
            kill_call(killing, common, "write_atomically", number)
            with pytest.raises(KeyboardInterrupt):
                more.pack()
        assert places.tasks_with_zoo() == ()
    more.pack()
    assert places.tasks_with_zoo() == ("MNIST-PCA32",)
    materialise(data_folder("MNIST-PCA32"), tmp_path / "zoo")
    assert set(Zoo.open(tmp_path / "zoo").index["ghn_seed"].to_pylist()) == {0, 1, 2}


def test_scores_of_more_seeds_are_made_again(builder, tmp_path):
    run_all(builder(tmp_path, "MNIST-PCA32"))
    more = builder(tmp_path, "MNIST-PCA32")
    more.seeds = range(3)
    with pytest.raises(UserError, match="stage 'ghns' first"):
        more.pack()
    more.ghns()
    more.scores()
    more.pack()
    assert set(pq.read_table(data_folder("MNIST-PCA32") / "scores.parquet")["ghn_seed"].to_pylist()) == {0, 1, 2}


def test_the_scores_of_a_candidate_do_not_depend_on_which_stage_run_made_them(builder, tmp_path):
    run_all(builder(tmp_path))
    path = tmp_path / "work" / "scores" / "16-16-16-32.parquet"
    before = pq.read_table(path)
    path.unlink()
    builder(tmp_path).scores()
    assert pq.read_table(path).equals(before)
