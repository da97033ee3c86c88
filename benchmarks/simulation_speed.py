"""Control steps a second on one core: this project's lockstep runner beside stock ManiSkill, on the same episodes.

Run: python benchmarks/simulation_speed.py [--episodes 50]
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable

import numpy as np
import torch

from nnit_zoo import tasks
from nnit_zoo.build import expert
from nnit_zoo.sim import headless
from nnit_zoo.sim.rollout import rollout
from nnit_zoo.sim.tabletop import Array
from nnit_zoo.tasks.robot import SCENES, RobotPolicyTask
from nnit_zoo.tasks.task import data_folder


def stock_episodes(task: RobotPolicyTask, seeds: range, act: Callable[[Array], Array], *, rebuild: bool) -> float:
    """Seconds of processor time that stock ManiSkill takes for one episode per seed, rebuilding its scene or not."""
    import gymnasium  # noqa: PLC0415  importing ManiSkill takes seconds and needs the shim first
    import mani_skill.envs  # noqa: F401, PLC0415

    frequency = 1 if rebuild else 0
    env = gymnasium.make(task.name, obs_mode="state", render_backend="none", reconfiguration_freq=frequency)
    env.reset(seed=0)
    start = time.process_time()
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        for _ in range(task.episode_steps):
            observation, *_ = env.step(act(observation.numpy())[0])
    seconds = time.process_time() - start
    env.close()
    return seconds


def our_episodes(task: RobotPolicyTask, seeds: range, act: Callable[[Array], Array]) -> float:
    """Seconds of processor time that the lockstep runner takes for the same."""
    rollout(task, seeds[:1], act)
    start = time.process_time()
    for first in range(0, len(seeds), SCENES):
        rollout(task, seeds[first : first + SCENES], act)
    return time.process_time() - start


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="PickCube-v1")
    parser.add_argument("--episodes", type=int, default=50)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    headless.enable()
    task = tasks.get(options.task)
    assert isinstance(task, RobotPolicyTask)
    network = expert.load(data_folder(task.name) / "expert.safetensors")
    seeds = range(options.episodes)

    def act(observations: Array) -> Array:
        return np.clip(expert.mean_action(network, observations), -1, 1).astype(np.float32)

    rows = {
        "stock, reset in place": stock_episodes(task, seeds, act, rebuild=False),
        "stock, rebuilt for each episode": stock_episodes(task, seeds, act, rebuild=True),
        "nnit, a fresh scene for each episode": our_episodes(task, seeds, act),
    }
    slowest = max(rows.values())
    for name, seconds in rows.items():
        rate = options.episodes * task.episode_steps / seconds
        sys.stdout.write(f"{name:38}{rate:8.0f} steps/s of processor time  {slowest / seconds:5.1f} x\n")


if __name__ == "__main__":
    main()
