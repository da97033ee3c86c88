"""StackCubeEasy-v1 as a ManiSkill environment: `gymnasium.make("nnit_zoo.envs:StackCubeEasy-v1")`.

Needs the extra `sim`. Without a Vulkan device, call `nnit_zoo.sim.headless.enable()` first, as for any of ManiSkill's.
"""

from __future__ import annotations

from typing import Any, ClassVar

import sapien
import torch
from mani_skill.envs.tasks.tabletop.stack_cube import StackCubeEnv
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder


@register_env("StackCubeEasy-v1", max_episode_steps=50)
class StackCubeEasyEnv(StackCubeEnv):  # type: ignore[misc]
    """StackCube-v1 with a lower cube that cannot move, PickCube-v1's observations and a tolerance of 0.02 m.

    Starts and dense reward are StackCube-v1's. Success: cubeA within 0.02 m of its place on cubeB, static and released.
    """

    SUPPORTED_ROBOTS: ClassVar = ["panda"]
    goal_thresh = 0.02

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any) -> None:
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def goal_pos(self) -> torch.Tensor:
        """Where cubeA's centre belongs [n, 3], on top of cubeB."""
        goal: torch.Tensor = self.cubeB.pose.p.clone()
        goal[:, 2] += 2 * self.cube_half_size[2]
        return goal

    def _load_scene(self, options: dict[str, Any]) -> None:
        self.cube_half_size = torch.full((3,), 0.02, device=self.device)
        self.table_scene = TableSceneBuilder(self, robot_init_qpos_noise=self.robot_init_qpos_noise)
        self.table_scene.build()
        self.cubeA = actors.build_cube(
            self.scene,
            half_size=0.02,
            color=[1, 0, 0, 1],
            name="cubeA",
            initial_pose=sapien.Pose([0, 0, 0.1]),
        )
        self.cubeB = actors.build_cube(
            self.scene,
            half_size=0.02,
            color=[0, 1, 0, 1],
            name="cubeB",
            body_type="kinematic",
            initial_pose=sapien.Pose([1, 0, 0.1]),
        )

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Success [n] and what it is made of, each [n]."""
        is_placed = torch.linalg.norm(self.goal_pos - self.cubeA.pose.p, dim=1) <= self.goal_thresh
        is_static = self.cubeA.is_static(lin_thresh=1e-2, ang_thresh=0.5)
        is_grasped = self.agent.is_grasping(self.cubeA)
        return {
            "is_cubeA_grasped": is_grasped,
            "is_cubeA_on_cubeB": is_placed,
            "is_cubeA_static": is_static,
            "success": is_placed & is_static & ~is_grasped,
        }

    def _get_obs_extra(self, info: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        tcp, cube = self.agent.tcp.pose, self.cubeA.pose
        extra = {"is_grasped": info["is_cubeA_grasped"], "tcp_pose": tcp.raw_pose, "goal_pos": self.goal_pos}
        if "state" in self.obs_mode:
            extra |= {
                "obj_pose": cube.raw_pose,
                "tcp_to_obj_pos": cube.p - tcp.p,
                "obj_to_goal_pos": self.goal_pos - cube.p,
            }
        return extra
