"""Builders of zoos at toy size."""

from __future__ import annotations

import shutil

import pytest
import torch

from nnit_zoo import places, tasks
from nnit_zoo.architecture import Architecture
from nnit_zoo.build import builder as common
from nnit_zoo.build import expert, mnist, robot
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.places import data_folder
from nnit_zoo.tasks.mnist import FEATURES, MNISTPCA32
from nnit_zoo.tasks.pick_cube import PickCube

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


def kill_call(monkeypatch, module, name, number=2):
    original, calls = getattr(module, name), []

    def wrapped(*args, **kwargs):
        calls.append(name)
        if len(calls) == number:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    monkeypatch.setattr(module, name, wrapped)
