"""Control steps a second on one core: this project's runner, stock ManiSkill and bare PhysX, on the same episodes.

Run: python benchmarks/simulation_speed.py [--task PickCube-v1] [--episodes 50]
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy and torch are imported

import numpy as np
import torch
from joblib import Parallel, delayed, parallel_config

from nnit_zoo import tasks
from nnit_zoo.build import expert
from nnit_zoo.places import data_folder
from nnit_zoo.sim import headless, tabletop
from nnit_zoo.sim.rollout import rollout
from nnit_zoo.sim.tabletop import Array
from nnit_zoo.tasks.robot import SCENES, RobotPolicyTask

Act = Callable[[Array], Array]


def actor(task: RobotPolicyTask) -> Act:
    """The task's expert if it has one, else random actions: the same in every scene and on every call."""
    path = data_folder(task.name) / "expert.safetensors"
    if path.exists():
        network = expert.load(path)
        return lambda observations: np.clip(expert.mean_action(network, observations), -1, 1).astype(np.float32)
    weights = np.random.default_rng(0).normal(size=(task.inputs, task.outputs)).astype(np.float32)
    return lambda observations: np.tanh(observations @ weights)


class Stock:
    """Stock ManiSkill with one environment, whose scene is rebuilt for every episode or reset in place."""

    def __init__(self, task: RobotPolicyTask, *, rebuild: bool) -> None:
        import gymnasium  # noqa: PLC0415  importing ManiSkill takes seconds and needs the shim first

        import nnit_zoo.envs  # noqa: F401, PLC0415

        self.steps = task.episode_steps
        self.env = gymnasium.make(
            task.name, obs_mode="state", robot_uids="panda", render_backend="none", reconfiguration_freq=int(rebuild)
        )
        self.env.reset(seed=0)

    def __call__(self, seeds: range, act: Act) -> float:
        """Seconds of processor time for one episode per seed."""
        start = time.process_time()
        for seed in seeds:
            observation, _ = self.env.reset(seed=seed)
            for _ in range(self.steps):
                observation, *_ = self.env.step(act(observation.numpy())[0])
        return time.process_time() - start


def ours(task: RobotPolicyTask, seeds: range, act: Act) -> tuple[float, float]:
    """Seconds of processor time that the lockstep runner takes for the same, and those of them in PhysX's step."""
    physics = 0.0
    step = tabletop.Tabletop.advance

    def timed(scene: tabletop.Tabletop) -> None:
        nonlocal physics
        start = time.process_time()
        step(scene)
        physics += time.process_time() - start

    tabletop.Tabletop.advance = timed  # type: ignore[method-assign, assignment]
    try:
        start = time.process_time()
        rollout(task, seeds, act)
        return time.process_time() - start, physics
    finally:
        tabletop.Tabletop.advance = step  # type: ignore[method-assign]


def resets(task: RobotPolicyTask, seeds: range) -> float:
    """Seconds of processor time to make the scenes that these episodes start in."""
    start = time.process_time()
    for seed in seeds:
        begin = task.start(seed)
        tabletop.Tabletop(begin.qpos, begin.cubes)
    return time.process_time() - start


def two_workers(name: str, count: int = 16) -> float:
    """Time by the clock that two processes take for `count` units of work, over the time that one takes."""
    seconds = {}
    for workers in (1, 2):
        with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1), Parallel() as pool:
            pool(delayed(_unit)(name, range(2)) for _ in range(workers))  # imports
            start = time.perf_counter()
            pool(delayed(_unit)(name, range(10 * unit, 10 * unit + 10)) for unit in range(count))
            seconds[workers] = time.perf_counter() - start
    return seconds[2] / seconds[1]


def _unit(name: str, seeds: range) -> None:
    task = tasks.get(name)
    assert isinstance(task, RobotPolicyTask)
    rollout(task, seeds, actor(task))


def units(seeds: range, size: int) -> Iterator[range]:
    """Seeds in runs of a unit's size."""
    return (seeds[first : first + size] for first in range(0, len(seeds), size))


def main() -> None:
    """Measure and print a table per task."""
    parser = argparse.ArgumentParser(description=__doc__)
    robots = [name for name in tasks.names() if isinstance(tasks.get(name), RobotPolicyTask)]
    parser.add_argument("--task", choices=robots, action="append")
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    headless.enable()
    for name in options.task or robots:
        task = tasks.get(name)
        assert isinstance(task, RobotPolicyTask)
        measure(task, options.episodes)


def measure(task: RobotPolicyTask, episodes: int) -> None:
    """Print one task's table; the candidates take turns, so that whatever else the machine does slows all of them."""
    act = actor(task)
    in_place, rebuilt = Stock(task, rebuild=False), Stock(task, rebuild=True)
    rollout(task, range(1), act)
    names = (
        "stock, reset in place",
        "stock, rebuilt for each episode",
        "nnit, fresh scenes",
        "bare px.step()",
        "reset",
    )
    turns = [
        (in_place(seeds, act), rebuilt(seeds, act), *ours(task, seeds, act), resets(task, seeds))
        for seeds in units(range(episodes), SCENES["fast"])
    ]
    seconds = dict(zip(names, np.sum(turns, axis=0), strict=True))
    reset = seconds.pop("reset")
    total = seconds["nnit, fresh scenes"]
    sys.stdout.write(f"{task.name}, {episodes} episodes, steps a second of processor time\n")
    for label, time_taken in seconds.items():
        rate = episodes * task.episode_steps / time_taken
        factor = seconds["stock, rebuilt for each episode"] / time_taken
        sys.stdout.write(f"  {label:36}{rate:8.0f}  {factor:5.1f} x stock rebuilt\n")
    sys.stdout.write(f"  of bare PhysX's speed, nnit has         {seconds['bare px.step()'] / total:6.1%}\n")
    sys.stdout.write(f"  of an episode, the fresh scene takes    {reset / total:6.1%}\n")
    sys.stdout.write(f"  two processes finish as many units in   {two_workers(task.name):6.1%} of one's time\n")


if __name__ == "__main__":
    main()
