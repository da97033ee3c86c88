"""Plain ManiSkill, as `gymnasium.make` gives it: the yardstick of our own simulation, and the way to a GPU."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch

from nnit_zoo.errors import UserError
from nnit_zoo.sim import headless
from nnit_zoo.sim.rollout import Act, Episodes, RobotTask, Start

Device = Literal["physx_cpu", "physx_cuda"]


def rollout(task: RobotTask, environment: str, seeds: Sequence[int], act: Act, device: Device) -> Episodes:
    """Run one episode for each seed in ManiSkill's environment of this name, rebuilt before; as `sim.rollout.rollout`.

    On physx_cpu one episode at a time, which ManiSkill itself starts from the seed. On physx_cuda any number at once,
    started where physx_cpu starts them; ManiSkill alone would draw the starts of all from the first seed. The latter
    has never been run, for want of a GPU, and PhysX does not promise the same bits there.
    """
    env = _environment(environment, len(seeds), device)
    options = {}
    if device == "physx_cuda":
        states = simulation_states(env, [task.start(seed) for seed in seeds])
        options = {"reset_to_env_states": {"env_states": states}}
    observation, _ = env.reset(seed=list(seeds), options=options)
    observations, actions, rewards, success = [observation.cpu().numpy()], [], [], []
    for _ in range(task.episode_steps):
        actions.append(act(observations[-1]))
        observation, reward, _, _, info = env.step(torch.from_numpy(actions[-1]))
        observations.append(observation.cpu().numpy())
        rewards.append(reward.cpu().numpy())
        success.append(info["success"].cpu().numpy())
    return Episodes(np.stack(observations), np.stack(actions), np.stack(rewards), np.stack(success))


def simulation_states(env: Any, starts: Sequence[Start]) -> dict[str, Any]:
    """The states (ManiSkill's `env_states`) of n scenes at these starts."""
    states: dict[str, Any] = env.unwrapped.get_state_dict()
    [robot] = states["articulations"].values()
    qpos = torch.tensor(np.stack([start.qpos for start in starts]), dtype=robot.dtype, device=robot.device)
    robot[:, 7:] = 0  # after the base's pose: its velocities, then angles and velocities of the joints
    robot[:, 13 : 13 + qpos.shape[1]] = qpos
    _table, *actors = states["actors"].values()
    poses = [
        np.stack([np.concatenate([cube.position, cube.quaternion]) for cube in cubes])
        for cubes in zip(*(start.cubes for start in starts), strict=True)
    ]
    poses.append(np.stack([start.goal for start in starts]))  # of the marker, if the environment has one
    for actor, pose in zip(actors, poses, strict=False):
        actor[:, : pose.shape[1]] = torch.from_numpy(pose)
        actor[:, 7:] = 0
    return states


@lru_cache(maxsize=1)
def _environment(name: str, count: int, device: Device) -> Any:
    headless.enable()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gymnasium  # noqa: PLC0415  the simulator is an optional extra
        import mani_skill.envs  # noqa: F401, PLC0415  registers ManiSkill's environments

        import nnit_zoo.envs  # noqa: F401, PLC0415  and ours
    if name not in gymnasium.registry:
        raise UserError(f"ManiSkill has no environment named {name}: leave --sim out")
    return gymnasium.make(
        name,
        num_envs=count,
        obs_mode="state",
        control_mode="pd_joint_delta_pos",
        reward_mode="normalized_dense",
        sim_backend=device,
        render_backend="none",
        reconfiguration_freq=1,
    )


def require_gpu() -> None:
    """Raise UserError unless PhysX can run on a GPU of this machine."""
    if not torch.cuda.is_available():
        raise UserError("--sim stock-gpu needs an NVIDIA GPU that torch can use, and there is none; use --sim stock")
