"""Films of episodes: that they show what was scored, and what a machine that cannot render is told."""

from __future__ import annotations

import subprocess
import sys
from io import BytesIO
from types import SimpleNamespace

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from nnit_bench import cli, film
from nnit_bench.protocol import Protocol
from nnit_zoo import tasks
from nnit_zoo.architecture import Architecture
from nnit_zoo.display import Display
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.sim import render
from nnit_zoo.sim.render import SIZE
from nnit_zoo.sim.rollout import rollout


def random_policy():
    draws = torch.Generator().manual_seed(0)
    architecture = Architecture(42, (16, 32), 8)
    layers = [torch.randn((1, *shape), generator=draws) / shape[1] ** 0.5 for shape in architecture.block_shapes]
    return PolicyBatch(architecture, tuple(layers))


def test_the_filmed_episode_is_the_one_that_is_scored():
    task, policy, taken = tasks.get("PickCube-v1"), random_policy(), {}

    def camera(seed, actions, rewards):
        taken.update(seed=seed, actions=actions, rewards=rewards)
        return np.zeros((51, SIZE, SIZE, 3), np.uint8)

    scene = film.shoot(task, policy, 7, "a title", camera)
    [row] = task.evaluate([policy], [7], workers=1).to_pylist()
    assert taken["seed"] == 7 and taken["actions"].shape == (50, 8)
    assert taken["rewards"].sum() == pytest.approx(row["return"], abs=1e-5)
    assert scene.title == "a title" and scene.outcome == f"no success\nreturn {row['return']:.1f}"


@pytest.mark.parametrize(
    ("count", "titles"),
    [
        (1, ["32-32-16-64", "16-16-16-32"]),
        (2, ["32-32-16-64 #0", "32-32-16-64 #1", "16-16-16-32 #0", "16-16-16-32 #1"]),
    ],
)
def test_the_first_policies_of_each_architecture_are_chosen_from_all_that_run_samples(count, titles):
    class Counting:
        """Its policies' first weight says which they are, and of how many."""

        def sample(self, request):
            layers = tuple(torch.zeros(request.policies, *shape) for shape in request.architecture.block_shapes)
            layers[0][:, 0, 0] = torch.arange(request.policies) + request.policies / 1000
            return PolicyBatch(request.architecture, layers)

    task = tasks.get("PickCube-v1")
    protocol = Protocol.of(task, "unseen", only=["32-32-16-64", "16-16-16-32"])
    entry = SimpleNamespace(method=SimpleNamespace(name="counting"), generator=Counting(), unsupported=None)
    chosen = film.choose(task, entry, protocol, count, Display(quiet=True).stage)
    assert [title for title, _ in chosen] == titles
    assert [float(policy.layers[0][0, 0, 0]) for _, policy in chosen] == pytest.approx([*np.arange(count) + 0.01] * 2)
    with pytest.raises(UserError, match="from 1 to 10, not 11"):
        film.choose(task, entry, protocol, 11, Display(quiet=True).stage)


def test_a_policy_that_cannot_play_is_not_filmed():
    broken = PolicyBatch(Architecture(42, (16, 32), 8), tuple(layer * np.nan for layer in random_policy().layers))
    with pytest.raises(UserError, match="not finite"):
        film.shoot(tasks.get("PickCube-v1"), broken, 0, "a title", lambda *_: pytest.fail("filmed"))


def plain_scenes(count):
    """Scenes whose picture after step t is filled with (40 times the scene's number, 255 - 5 t, 0)."""
    steps = np.arange(51)
    for number in range(count):
        frames = np.zeros((51, SIZE, SIZE, 3), np.uint8)
        frames[..., 0], frames[..., 1] = 40 * number, (255 - 5 * steps)[:, None, None]
        yield film.Scene(f"policy {number}", "success\nreturn 39.0", frames)


def test_the_strip_has_a_row_per_scene_and_a_snapshot_every_ten_steps():
    image = np.asarray(Image.open(BytesIO(film.strip(list(plain_scenes(3))))).convert("RGB")).astype(int)
    left, top = image.shape[1] - 6 * SIZE, image.shape[0] - (3 * SIZE + 2 * 10)
    assert (image[:, :left] < 100).any() and (image[:top, left:] < 100).any()  # titles, and the steps above
    for row in range(3):
        for column in range(6):
            pixel = image[top + row * (SIZE + 10) + SIZE // 2, left + column * SIZE + SIZE // 2]
            assert np.abs(pixel - (40 * row, 255 - 50 * column, 0)).max() <= 8, (row, column)


def test_the_video_shows_all_scenes_in_real_time():
    content = film.video(list(plain_scenes(5)))
    pictures = imageio.imread(content, extension=".mp4").astype(int)
    assert pictures.shape == (51, 2 * SIZE, 4 * SIZE, 3)
    assert imageio.immeta(content, extension=".mp4")["duration"] == pytest.approx(51 / 20, abs=0.02)
    for number in range(5):
        pixel = pictures[30, number // 4 * SIZE + SIZE // 2, number % 4 * SIZE + SIZE // 2]
        assert np.abs(pixel - (40 * number, 105, 0)).max() <= 12, number


def test_a_machine_that_cannot_render_says_what_to_run(monkeypatch):
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere.json")  # hides the system's drivers, and the fetched one
    with pytest.raises(UserError, match=rf"nothing here can render .* sh {render.SETUP}"), render.camera("PickCube-v1"):
        pytest.fail("a camera without a renderer")
    subprocess.run(["sh", "-n", render.SETUP], check=True)  # it is there, and a shell script


def test_a_task_without_a_robot_says_so(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["nnit-bench", "render", "--task", "MNIST-PCA32"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert "MNIST-PCA32 has no robot to film" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(not render.driver().is_file(), reason="no software driver: make render-setup fetches it")
@pytest.mark.parametrize("name", ["PickCube-v1", "PushCube-v1", "StackCubeEasy-v1"])
def test_pictures_show_the_episode_and_only_if_maniskill_agrees(name, scripted):
    task = tasks.get(name)
    episode = rollout(task, [3], scripted(task, 1))
    actions, rewards = episode.actions[:, 0], episode.rewards[:, 0]
    assert rewards.max() == 1  # the script moved what there is to move
    with render.camera(name) as camera:
        pictures = camera(3, actions, rewards)
        with pytest.raises(UserError, match="differently from step 40"):
            camera(3, actions, np.where(np.arange(50) == 40, 0, rewards))
        with pytest.raises(UserError, match="differently from step 0"):
            camera(4, actions, rewards)
    assert pictures.shape == (51, SIZE, SIZE, 3)
    assert pictures[0].std() > 30  # a scene and not a plain
    vivid = pictures.max(axis=3).astype(int) - pictures.min(axis=3) > 120  # cubes and goals
    assert vivid.any(axis=(1, 2)).all()
    assert np.abs(pictures[-1].astype(int) - pictures[0]).mean() > 3  # the arm has moved
