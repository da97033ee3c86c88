"""Films of policies at work: a video of all side by side, and a strip of snapshots (NNiT, qualitative rollouts)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import imageio.v3 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nnit_bench import runner
from nnit_bench.protocol import Protocol
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.sim.control import Controller
from nnit_zoo.sim.render import SIZE, Film, Frames
from nnit_zoo.sim.rollout import rollout
from nnit_zoo.tasks.robot import RobotPolicyTask
from nnit_zoo.tasks.task import Task

STEPS_PER_SECOND = 20  # the robot's own pace
STEPS_PER_SNAPSHOT = 10
COLUMNS = 4  # of the video
_MARGIN = 10  # pixels, as are the sizes of letters
_STRIP_LETTERS, _VIDEO_LETTERS = 26, 15


@dataclass(frozen=True)
class Scene:
    """One policy's episode: what the policy is called, how it went, and pictures [T + 1, SIZE, SIZE, 3]."""

    title: str
    outcome: str
    frames: Frames


def robot_task(task: Task) -> RobotPolicyTask:
    """The task itself; raises UserError if there is nothing to see of it."""
    if not isinstance(task, RobotPolicyTask):
        raise UserError(f"{task.name} has no robot to film")
    return task


def choose(
    task: Task, entry: runner.Entry, protocol: Protocol, count: int, stage: runner.Stage
) -> list[tuple[str, PolicyBatch]]:
    """The first `count` policies of each architecture, or of all on `joint`, with a title each.

    All of the protocol's policies are sampled: what a generator gives as the first may depend on how many are wanted.
    Raises UserError if the generator cannot make them or there are not that many.
    """
    if entry.unsupported:
        raise UserError(f"{entry.method.name} {entry.unsupported}")
    most = max(protocol.policies.values())
    if not 1 <= count <= most:
        raise UserError(f"--policies must be from 1 to {most}, not {count}")
    batches = runner.sample(task, entry, protocol, stage)
    chosen = [
        (f"{batch.architecture}" + f" #{index}" * (count > 1), policy)
        for batch in batches
        for index, policy in enumerate(batch[:count])
    ]
    return chosen[:count] if protocol.is_joint else chosen


def shoot(task: RobotPolicyTask, policy: PolicyBatch, seed: int, title: str, film: Film) -> Scene:
    """Film the episode with this seed of a single policy.

    Raises UserError if there is no such episode, or if the policy's parameters are not finite.
    """
    task.check([policy], [seed])
    if not policy.finite().all():
        raise UserError(f"{title} has parameters that are not finite: it scores 0 without an episode")
    network = [layer[0].float().numpy() for layer in policy.layers]
    episode = rollout(task, [seed], Controller([network], task.observation_mean, task.observation_std))
    actions, rewards, success = episode.actions[:, 0], episode.rewards[:, 0], episode.success[:, 0]
    verdict = "success" if success[-1] else "lost again" if success.any() else "no success"
    return Scene(title, f"{verdict}\nreturn {rewards.sum(dtype=np.float64):.1f}", film(seed, actions, rewards))


def strip(scenes: Sequence[Scene]) -> bytes:
    """A PNG with a row for each scene: its title and outcome, then a snapshot every STEPS_PER_SNAPSHOT steps."""
    font = ImageFont.load_default(_STRIP_LETTERS)
    steps = range(0, len(scenes[0].frames), STEPS_PER_SNAPSHOT)
    measure = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    texts = [f"{scene.title}\n{scene.outcome}" for scene in scenes]
    left = round(max(measure.multiline_textbbox((0, 0), text, font)[2] for text in texts)) + 2 * _MARGIN
    top = _STRIP_LETTERS + 2 * _MARGIN
    height = SIZE + _MARGIN
    image = Image.new("RGB", (left + len(steps) * SIZE, top + len(scenes) * height - _MARGIN), "white")
    draw = ImageDraw.Draw(image)
    for column, step in enumerate(steps):
        draw.text((left + (column + 0.5) * SIZE, top / 2), f"step {step}", "black", font, anchor="mm")
    for row, (scene, text) in enumerate(zip(scenes, texts, strict=True)):
        middle = top + row * height + SIZE / 2
        draw.multiline_text((_MARGIN, middle), text, "black", font, anchor="lm", spacing=_MARGIN)
        for column, step in enumerate(steps):
            image.paste(Image.fromarray(scene.frames[step]), (left + column * SIZE, top + row * height))
    content = BytesIO()
    image.quantize(256, Image.Quantize.FASTOCTREE).save(content, "PNG", optimize=True)  # a quarter of the bytes
    return content.getvalue()


def video(scenes: Sequence[Scene]) -> bytes:
    """An MP4 in real time with all scenes side by side, in rows of COLUMNS."""
    font = ImageFont.load_default(_VIDEO_LETTERS)
    columns = min(COLUMNS, len(scenes))
    rows = -(-len(scenes) // columns)
    pictures = []
    for step in range(len(scenes[0].frames)):
        image = Image.new("RGB", (columns * SIZE, rows * SIZE), "white")
        draw = ImageDraw.Draw(image)
        for number, scene in enumerate(scenes):
            left, top = number % columns * SIZE, number // columns * SIZE
            image.paste(Image.fromarray(scene.frames[step]), (left, top))
            place = left + _MARGIN, top + _MARGIN
            draw.text(place, scene.title, "white", font, stroke_width=2, stroke_fill="black")
        pictures.append(np.asarray(image))
    content: bytes = imageio.imwrite("<bytes>", np.stack(pictures), extension=".mp4", fps=STEPS_PER_SECOND)
    return content
