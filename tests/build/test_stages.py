"""Building a zoo, at toy size: every artifact is there, and a killed build ends with the same bytes."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from nnit_zoo import files, places, stats, tasks
from nnit_zoo.architecture import Architecture
from nnit_zoo.build import builder as common
from nnit_zoo.build import command, distill, expert, mnist, robot, twins
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.build.fit import Fit
from nnit_zoo.build.twins import TwinsConfig
from nnit_zoo.cli import main
from nnit_zoo.errors import UserError
from nnit_zoo.materialise import materialise
from nnit_zoo.places import data_folder
from nnit_zoo.tasks.mnist import FEATURES, MNISTPCA32
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.verify import rescore
from nnit_zoo.zoo import Zoo

TINY_EXPERT = ExpertConfig(total_steps=200, environments=2, hidden=16, epochs=1, minibatch=50, evaluate_every=1)
TINY_DISTILL = DistillConfig(
    rounds=2, episodes_per_round=2, round_steps=2, own_episodes=2, steps=3, architectures_per_step=2
)
TINY_FIT = mnist.MNISTConfig(steps=3, states_per_architecture=8)
FEW = {"seen": ("16-32-64-16", "64-64-64-64"), "unseen": ("16-16-16-32",), "excluded": ("32-16-16-16",)}


@pytest.fixture
def builder(monkeypatch):
    """A function that makes a toy builder whose data folder is in a folder of the test's."""
    torch.set_num_threads(1)  # as `build` does; bits depend on it
    monkeypatch.setattr(expert, "EVALUATION_SEEDS", range(2))
    monkeypatch.setattr(PickCube, "scoring_seeds", range(2))
    monkeypatch.setattr(common, "architectures", few_architectures)
    shipped = data_folder("MNIST-PCA32")
    forget = tasks.get.cache_clear

    def make(folder, task="PickCube-v1", source=None):
        monkeypatch.setattr(places, "DATA", folder / "data")
        forget()  # a task keeps the record that it has read
        if task == "MNIST-PCA32":
            if not data_folder(task).exists():
                data_folder(task).mkdir(parents=True)
                for name in ("task.json", FEATURES):
                    shutil.copy(shipped / name, data_folder(task))
            built = mnist.MNISTBuilder(MNISTPCA32(), folder / "work", seeds=2, workers=1, source=source)
            built.config = TINY_FIT
        else:
            built = robot.RobotBuilder(PickCube(), folder / "work", seeds=2, workers=1)
            built.expert_config, built.distill_config = TINY_EXPERT, TINY_DISTILL
        return built

    yield make
    forget()


def few_architectures(split, inputs, outputs):
    return tuple(Architecture.parse(text, inputs, outputs) for text in FEW[split])


def run_all(builder):
    for stage in builder.stages:
        getattr(builder, stage)()


def artifacts(folder):
    given = ("task.json", FEATURES)
    return {path.name: path.read_bytes() for path in folder.glob("data/*/*") if path.name not in given}


def test_a_build_that_was_killed_in_every_stage_ends_with_the_same_bytes(builder, tmp_path, monkeypatch):
    run_all(builder(tmp_path / "whole"))
    whole = artifacts(tmp_path / "whole")
    assert set(whole) == {
        "expert.safetensors",
        "ghns.safetensors",
        "index.parquet",
        "manifest.json",
        "probe.safetensors",
        "scores.parquet",
        "selection.parquet",
    }
    for module, name in (
        (expert.Training, "iterate"),
        (Fit, "run"),
        (distill, "train_ghn"),
        (PickCube, "evaluate"),
        (common, "write_manifest"),
    ):
        with monkeypatch.context() as killing:
            kill_call(killing, module, name)
            with pytest.raises(KeyboardInterrupt):
                run_all(builder(tmp_path / "killed"))
                run_all(builder(tmp_path / "killed"))  # the last stage calls once a build
    run_all(builder(tmp_path / "killed"))
    assert artifacts(tmp_path / "killed") == whole

    materialise(data_folder("PickCube-v1"), tmp_path / "zoo")
    zoo = Zoo.open(tmp_path / "zoo")
    assert {split: len(zoo.architectures(split)) for split in ("seen", "unseen", "excluded")} == {
        "seen": 0,  # nothing passes after so little training
        "unseen": 1,
        "excluded": 1,
    }
    assert zoo.manifest.standardisation == PickCube().standardisation
    record = json.loads((data_folder("PickCube-v1") / "task.json").read_text())
    assert record["build"]["expert"]["config"]["hidden"] == 16
    assert record["build"]["ghns"]["states"] == 2 * 2 * 50
    assert record["build"]["states"]["rounds"] == 2 and record["build"]["states"]["commits"]


def test_a_killed_build_of_mnist_ends_with_the_same_bytes_and_a_zoo_with_accuracies(builder, tmp_path, monkeypatch):
    run_all(builder(tmp_path / "whole", "MNIST-PCA32"))
    whole = artifacts(tmp_path / "whole")
    assert set(whole) == {
        "ghns.safetensors",
        "index.parquet",
        "manifest.json",
        "scores.parquet",
        "selection.parquet",
    }
    for module, name in ((mnist, "train_ghn"), (MNISTPCA32, "evaluate"), (common, "write_manifest")):
        with monkeypatch.context() as killing:
            kill_call(killing, module, name)
            with pytest.raises(KeyboardInterrupt):
                run_all(builder(tmp_path / "killed", "MNIST-PCA32"))
                run_all(builder(tmp_path / "killed", "MNIST-PCA32"))
    run_all(builder(tmp_path / "killed", "MNIST-PCA32"))
    assert artifacts(tmp_path / "killed") == whole

    materialise(data_folder("MNIST-PCA32"), tmp_path / "zoo")
    zoo = Zoo.open(tmp_path / "zoo")
    assert len(zoo) == 4  # of the unseen and the excluded architecture; seen ones pass only when they are trained
    row = zoo.index.to_pylist()[0]
    assert row["success_at_end"] is None and row["episodes"] == 100
    table = MNISTPCA32().evaluate([zoo.batch(row["architecture"], row["split"])[0]], range(100))
    assert row["return"] == pytest.approx(np.mean(table["return"].to_numpy()))
    record = json.loads((data_folder("MNIST-PCA32") / "task.json").read_text())
    assert record["build"]["ghns"]["steps"] == 3 and record["build"]["features"]["train"] == 60_000


def test_networks_for_digits_are_scored_where_the_user_says(builder, tmp_path, monkeypatch):
    asked, evaluate = [], MNISTPCA32.evaluate

    def note(task, policies, seeds, *, workers, parallel, store, progress):
        asked.append((workers, parallel))
        return evaluate(task, policies, seeds, workers=1, store=store, progress=progress)

    monkeypatch.setattr(MNISTPCA32, "evaluate", note)
    monkeypatch.setattr(mnist, "MNISTConfig", lambda: TINY_FIT)
    builder(tmp_path, "MNIST-PCA32")  # gives the command below the toy's folder and architectures
    options = {"task": "MNIST-PCA32", "seeds": 1, "work": tmp_path}
    command.build(stage="ghns", workers=1, **options)
    command.build(stage="scores", workers=3, parallel="ray", **options)
    assert asked == [(3, "ray")] * 4


def test_a_build_that_goes_on_keeps_to_the_ghns_that_are_there(builder, tmp_path, monkeypatch):
    monkeypatch.setattr(mnist, "MNISTConfig", lambda: TINY_FIT)
    builder(tmp_path, "MNIST-PCA32")
    options = {"task": "MNIST-PCA32", "workers": 1, "work": tmp_path}
    command.build(stage="ghns", seeds=3, **options)
    command.build(stage="scores", **options)
    scores = tmp_path / "MNIST-PCA32" / "scores" / "16-16-16-32.parquet"
    assert set(pq.read_table(scores)["ghn_seed"].to_pylist()) == {0, 1, 2}
    with pytest.raises(UserError, match=r"is of 3 GHNs, and 2 would take their place; .* ghns, scores"):
        command.build(stage="scores", seeds=2, **options)


def test_features_are_made_from_the_named_source_and_keep_the_record_of_the_zoo(builder, tmp_path):
    sample = Path(__file__).parents[1] / "zoo" / "mnist"
    built = builder(tmp_path, "MNIST-PCA32", source=str(sample))
    task_json = data_folder("MNIST-PCA32") / "task.json"
    earlier = json.loads(task_json.read_text())
    earlier["build"]["ghns"] = {"steps": 3}
    task_json.write_text(json.dumps(earlier))
    built.features()
    record = json.loads(task_json.read_text())
    assert record["build"]["features"]["train"] == 16 and record["build"]["ghns"] == {"steps": 3}
    assert len(set(record["observation_std"])) == 1 and record["observation_std"] != earlier["observation_std"]
    task_json.unlink()
    with pytest.raises(UserError, match="--source a folder with its four IDX files"):
        builder(tmp_path, "MNIST-PCA32").features()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task", "MNIST-PCA32", "--stage", "expert"], "there are features, ghns, scores, pack"),
        (["--task", "PickCube-v1", "--source", "ylecun/mnist"], "--source is not for PickCube-v1"),
    ],
)
def test_a_build_that_cannot_be_says_why(options, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["nnit-zoo", "build", *options])
    with pytest.raises(SystemExit):
        main()
    assert message in capsys.readouterr().err


def kill_call(monkeypatch, module, name, number=2):
    original, calls = getattr(module, name), []

    def wrapped(*args, **kwargs):
        calls.append(name)
        if len(calls) == number:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    monkeypatch.setattr(module, name, wrapped)


def test_a_stage_without_the_one_before_says_which_to_run(builder, tmp_path):
    with pytest.raises(UserError, match="stage 'expert' first"):
        builder(tmp_path).states()
    built = builder(tmp_path)
    built.expert()
    with pytest.raises(UserError, match="stage 'states' first"):
        built.ghns()
    with pytest.raises(UserError, match="stage 'ghns' first"):
        builder(tmp_path).pack()


def test_twins_learn_the_same_from_seeds_of_their_own_and_go_on_after_a_kill(builder, tmp_path, monkeypatch):
    def prepare(folder):
        built = builder(folder)
        built.twins_config = TwinsConfig(networks=2, steps=3, sgd_steps=3, states_per_architecture=8)
        if not (folder / "work" / "states").exists():
            built.expert()
            built.states()
        return built

    monkeypatch.setattr(twins, "HIDDEN", (64, 64, 64))
    with pytest.raises(UserError, match="stage 'states' first"):
        builder(tmp_path / "none").twins()
    prepare(tmp_path / "whole").twins()
    networks = {path.parent.name + path.stem: path.read_bytes() for path in tmp_path.glob("whole/work/twins/*/*")}
    assert len(set(networks.values())) == 4 and set(networks) == {"GHN000", "GHN001", "SGD000", "SGD001"}
    for module, name in ((twins, "train"), (PickCube, "evaluate")):
        with monkeypatch.context() as killing:
            kill_call(killing, module, name)
            with pytest.raises(KeyboardInterrupt):
                prepare(tmp_path / "killed").twins()
    prepare(tmp_path / "killed").twins()
    made = [(tmp_path / name / "data" / "PickCube-v1" / "twins.json").read_bytes() for name in ("whole", "killed")]
    assert made[0] == made[1]
    content = json.loads(made[0])
    assert content["config"]["networks"] == 2 and content["episodes"] == 2
    assert content["populations"].keys() == {"GHN", "SGD"}
    for measures in content["populations"].values():
        assert set(stats.PAPER_TWINS["PickCube-v1"]) <= set(measures)


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


def test_a_build_does_not_go_on_with_other_settings(builder, tmp_path):
    builder(tmp_path, "MNIST-PCA32").ghns()
    other = builder(tmp_path, "MNIST-PCA32")
    other.config = TINY_FIT.model_copy(update={"steps": 30})
    with pytest.raises(UserError, match="made with other settings"):
        other.ghns()

    sample = Path(__file__).parents[1] / "zoo" / "mnist"
    builder(tmp_path, "MNIST-PCA32", source=str(sample)).features()
    with pytest.raises(UserError, match="made with other settings"):
        builder(tmp_path, "MNIST-PCA32").ghns()
    (tmp_path / "work" / "ghns" / "made.json").unlink()
    with pytest.raises(UserError, match=r"no made\.json that says how its files were made"):
        builder(tmp_path, "MNIST-PCA32").ghns()


def test_nothing_is_built_on_another_expert(builder, tmp_path):
    built = builder(tmp_path)
    built.expert()
    built.states()
    (data_folder("PickCube-v1") / "expert.safetensors").unlink()
    other = builder(tmp_path)
    other.expert_config = TINY_EXPERT.model_copy(update={"seed": 1})
    with pytest.raises(UserError, match="expert was made with other settings"):
        other.expert()
    shutil.rmtree(tmp_path / "work" / "expert")
    (data_folder("PickCube-v1") / stats.TWINS).touch()
    other.expert()
    assert not (data_folder("PickCube-v1") / stats.TWINS).exists()  # they were the old one's students
    with pytest.raises(UserError, match="states was made with other settings"):
        builder(tmp_path).states()


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
