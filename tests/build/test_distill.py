"""Distilling an expert: who acts when, what is seen and labelled, and that no episode is played twice."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
import torch

from nnit_zoo.architecture import Architecture
from nnit_zoo.build import distill, expert
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.fit import Fit
from nnit_zoo.ghn import GHN
from nnit_zoo.sim.control import Controller
from nnit_zoo.sim.rollout import rollout
from nnit_zoo.tasks.pick_cube import PickCube

TINY_DISTILL = DistillConfig(own_episodes=2, steps=3, architectures_per_step=2)


class Short(PickCube):
    episode_steps = 3


def toy_network():
    torch.manual_seed(0)
    network = expert.network_of(expert.ActorCritic(42, 8, 16, -0.5).actor)
    return [(weight * (30 if number == 3 else 1), bias) for number, (weight, bias) in enumerate(network)]


def test_teacher_and_students_act_as_often_as_they_should():
    task, network, seeds = Short(), toy_network(), range(2)
    student = [layer[0].numpy() for layer in GHN(42, 8, seed=0).emit(Architecture(42, (16, 16, 16, 16), 8)).layers]
    students = dict.fromkeys(seeds, student)
    controller = Controller([student] * 2, task.observation_mean, task.observation_std)
    teachers, theirs = expert.play(task, network, seeds), rollout(task, seeds, controller)
    for beta, episodes in ((1, teachers), (0, theirs)):
        states = distill.collect(task, network, students, beta, 0, seeds)
        np.testing.assert_array_equal(states, episodes.observations[:-1].reshape(-1, 42))
    assert not np.array_equal(teachers.observations, theirs.observations)


def test_teacher_and_students_share_the_steps_and_the_teachers_actions_are_noisy(monkeypatch):
    """The student opens the gripper wide, the teacher closes it: who has acted shows in the action."""
    seeds, acted = range(8), []

    def play(task, seeds, act):
        acted.extend(act(np.zeros((len(seeds), task.inputs), np.float32)) for _ in range(400))
        return rollout(Short(), range(1), lambda observations: np.zeros((1, 8), np.float32))

    monkeypatch.setattr(distill, "rollout", play)
    monkeypatch.setattr(distill, "Controller", lambda *_: lambda observations: np.full((len(seeds), 8), 3, np.float32))
    closing = [(np.zeros((8, 42), np.float32), np.full(8, -1, np.float32))]
    distill.collect(PickCube(), closing, {seed: [] for seed in seeds}, 0.3, 0.4, seeds)
    actions = np.array(acted)  # [steps, episodes, 8]
    teachers = (actions != 3).all(-1)
    assert teachers.mean() == pytest.approx(0.3, abs=0.03)
    scales = [actions[:, episode][teachers[:, episode]].std() for episode in range(8)]
    assert 0 < min(scales) < max(scales) <= 0.42 and max(scales) > 3 * min(scales)
    assert actions[teachers].mean() == pytest.approx(-1, abs=0.05)


def test_the_expert_labels_raw_observations_and_students_see_standardised_ones():
    task, network = PickCube(), toy_network()
    raw = np.random.default_rng(0).normal(size=(5, 42)).astype(np.float32)
    inputs, labels = distill.labelled(task, network, raw)
    np.testing.assert_allclose(labels, expert.mean_action(network, raw).clip(-1, 1), rtol=1e-6)
    np.testing.assert_allclose(inputs.numpy() * task.observation_std + task.observation_mean, raw, atol=1e-5)


def test_no_ghn_and_no_round_plays_the_episodes_of_another(tmp_path, monkeypatch):
    played = []

    def note(task, fit, seeds):
        played.extend(seeds)
        return np.zeros((8, 42), np.float32)

    monkeypatch.setattr(distill, "_own_states", note)
    distill._save_states(tmp_path / "states", np.zeros((8, 42), np.float32))
    for seed in (0, 1):
        distill.train_ghn(PickCube(), TINY_DISTILL, toy_network(), tmp_path / "states", tmp_path / str(seed), seed)
    assert len(played) == len(set(played)) == 2 * TINY_DISTILL.own_rounds * TINY_DISTILL.own_episodes


def test_a_ghns_own_states_get_their_share_of_every_batch():
    config = TINY_DISTILL.model_copy(update={"states_per_architecture": 100, "own_share": 0.25})
    taken = []

    def note(outputs, labels):
        taken.append(labels[:, 0])
        return outputs.square().mean()

    ghn = GHN(42, 8, 0)
    fit, optimizer = Fit(ghn, config, seed=0, loss=note), torch.optim.SGD(ghn.parameters(), lr=0.0)
    numbers = torch.arange(50.0)[:, None].expand(50, 8)
    fit.run(torch.zeros(50, 42), numbers, 3, optimizer, own=10)
    assert [int((rows >= 40).sum()) for rows in taken] == [25] * 3 * config.architectures_per_step
    taken.clear()
    fit.run(torch.zeros(40, 42), numbers[:40], 1, optimizer)
    assert len(taken[0]) == 100 and taken[0].max() < 40
    assert {int(row) for rows in taken for row in rows} > set(range(30))


def test_weight_noise_is_relative_to_each_block():
    fit = Fit(GHN(42, 8, 0), TINY_DISTILL, seed=0)
    block = 3 * torch.ones(50, 100)
    assert (fit.noisy(block) - block).std() == pytest.approx(3 * TINY_DISTILL.weight_noise, rel=0.05)


def test_a_worker_that_dies_costs_the_buffer_nothing(tmp_path):
    class Deadly(PickCube):  # here, so that worker processes get it whole
        episode_steps = 2

        def start(self, seed):
            if (tmp_path / "deadly").exists():
                (tmp_path / "deadly").unlink()
                os.kill(os.getpid(), signal.SIGKILL)
            return super().start(seed)

    config = DistillConfig(rounds=2, episodes_per_round=51, round_steps=2)
    network = expert.network_of(expert.ActorCritic(42, 8, 16, -0.5).actor)
    distill.gather_states(Deadly(), config, network, tmp_path / "alone", 1, print)
    (tmp_path / "deadly").touch()
    distill.gather_states(Deadly(), config, network, tmp_path / "killed", 2, print)
    assert not (tmp_path / "deadly").exists()
    whole, killed = (tmp_path / name / "states.safetensors" for name in ("alone", "killed"))
    assert killed.read_bytes() == whole.read_bytes()
