"""The stages of a build, at toy size: every artifact is there, and a killed build ends with the same bytes."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from nnit_zoo import stats
from nnit_zoo.build import builder as common
from nnit_zoo.build import command, distill, expert, mnist, twins
from nnit_zoo.build.fit import Fit
from nnit_zoo.build.twins import TwinsConfig
from nnit_zoo.cli import main
from nnit_zoo.errors import UserError
from nnit_zoo.materialise import materialise
from nnit_zoo.places import data_folder
from nnit_zoo.tasks.mnist import MNISTPCA32
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.zoo import Zoo

from .conftest import TINY_EXPERT, TINY_FIT, artifacts, kill_call, run_all


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


def test_a_build_says_as_json_what_it_made(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mnist.MNISTBuilder, "features", lambda self: None)
    monkeypatch.chdir(tmp_path)
    options = ["--task", "MNIST-PCA32", "--stage", "features", "--seeds", "144", "--json"]
    monkeypatch.setattr(sys, "argv", ["nnit-zoo", "build", *options])
    main()
    made = json.loads(capsys.readouterr().out)
    assert (made["stages"], made["seeds"], made["work"]) == (["features"], 144, "runs/build/MNIST-PCA32")
    assert made["folder"] == str(data_folder("MNIST-PCA32"))


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
    (tmp_path / "work" / "twins").mkdir()
    (tmp_path / "work" / "twins" / ".made.json.0123").touch()  # left by a kill, and no reason to stop
    builder(tmp_path, "MNIST-PCA32")._sign("twins", {}, works=False)
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
    (data_folder("PickCube-v1") / "manifest.json").touch()
    with pytest.raises(UserError, match=r"made by another expert; .* move elsewhere, from there, .*manifest\.json"):
        other.expert()
    (data_folder("PickCube-v1") / "manifest.json").unlink()
    other.expert()
    assert not (data_folder("PickCube-v1") / stats.TWINS).exists()  # they were the old one's students
    with pytest.raises(UserError, match="states was made with other settings"):
        builder(tmp_path).states()
