"""Pictures of episodes: the actions that our simulator computed, replayed in stock ManiSkill, which has looks.

SAPIEN renders through Vulkan: on a GPU or, with Mesa's lavapipe, on the CPU. It does so in a process of its own, since
this one's SAPIEN may be headless (nnit_zoo.sim.headless), and the driver must be chosen before SAPIEN is imported.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nnit_zoo.errors import UserError
from nnit_zoo.sim.tabletop import Array

SETUP = Path(__file__).with_name("lavapipe.sh")
SIZE = 256  # pixels
_SUPERSAMPLING = 2  # SAPIEN leaves edges jagged: it draws this much larger, and pixels are averaged
_EYE, _TARGET, _VIEW = (0.7, 0.75, 0.7), (-0.1, 0.01, 0.19), 0.68  # metres and radians: the robot and what it handles
_TOLERANCE = 1e-4  # of a reward; stock ManiSkill's differ in the last bits

Frames = npt.NDArray[np.uint8]
Film = Callable[[int, Array, Array], Frames]


@contextmanager
def camera(task: str) -> Iterator[Film]:
    """Start stock ManiSkill's `task` with a renderer; gives a function that films episodes.

    It takes an episode's seed, actions [T, 8] and rewards [T], and gives pictures [T + 1, SIZE, SIZE, 3]: of the start,
    and after each step. Raises UserError if nothing on this machine renders, or if stock ManiSkill's rewards are not
    those given, so that the pictures would show another episode.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as process:

        def call(function: Callable[..., Any], *arguments: Any) -> Any:
            try:
                return process.submit(function, *arguments).result()
            except BrokenProcessPool:  # a driver that is not up to it can take its process along
                raise _no_renderer("the process that renders died") from None

        call(_start, task)
        yield lambda seed, actions, rewards: call(_film, task, seed, actions, rewards)


def driver() -> Path:
    """The manifest of the driver that SETUP fetches, there or not."""
    folder = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(folder) / "nnit/lavapipe/lvp_icd.json"


def _start(task: str) -> None:
    """Make the environment, and nothing that would have to travel back."""
    _environment(task)


@cache
def _environment(task: str) -> Any:
    fetched = driver().is_file() and "VK_DRIVER_FILES" not in os.environ
    if fetched:
        os.environ["VK_DRIVER_FILES"] = str(driver())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gymnasium  # noqa: PLC0415  the simulator is an optional extra
        from mani_skill.utils.logging_utils import logger  # noqa: PLC0415
        from mani_skill.utils.sapien_utils import look_at  # noqa: PLC0415

        logger.setLevel(logging.ERROR)
        pixels = SIZE * _SUPERSAMPLING
        try:
            environment = gymnasium.make(
                f"nnit_zoo.envs:{task}",
                num_envs=1,
                obs_mode="none",
                control_mode="pd_joint_delta_pos",
                reward_mode="normalized_dense",
                sim_backend="physx_cpu",
                render_backend="cpu" if fetched else "gpu",  # without a CUDA GPU, ManiSkill takes "gpu" for "cpu"
                render_mode="rgb_array",
                human_render_camera_configs={
                    "width": pixels,
                    "height": pixels,
                    "pose": look_at(_EYE, _TARGET),
                    "fov": _VIEW,
                },
                reconfiguration_freq=1,
            )
            environment.reset(seed=0)
        except gymnasium.error.NameNotFound:
            raise UserError(f"ManiSkill has no environment named {task} to take pictures of") from None
        except RuntimeError as error:
            raise _no_renderer(error) from None
    return environment


def _no_renderer(reason: object) -> UserError:
    return UserError(
        f"nothing here can render ({reason}); install your GPU's Vulkan driver, or Mesa's lavapipe 24.3 or newer to "
        f"render on the CPU; on Debian, this fetches lavapipe without a change to the system: sh {SETUP}"
    )


def _film(task: str, seed: int, actions: Array, rewards: Array) -> Frames:
    environment = _environment(task)
    environment.reset(seed=seed)
    frames = [_picture(environment)]
    for step, (action, expected) in enumerate(zip(actions, rewards, strict=True)):
        _, reward, *_ = environment.step(action)
        if abs(float(reward) - expected) > _TOLERANCE:
            raise UserError(
                f"ManiSkill plays episode {seed} of {task} differently from step {step} on, so that its pictures would "
                "not show what was scored; install the version of ManiSkill that nnit[sim] asks for"
            )
        frames.append(_picture(environment))
    return np.stack(frames)


def _picture(environment: Any) -> Frames:
    large = environment.render()[0].numpy().reshape(SIZE, _SUPERSAMPLING, SIZE, _SUPERSAMPLING, 3)
    smooth: Frames = large.mean(axis=(1, 3)).round().astype(np.uint8)
    return smooth
