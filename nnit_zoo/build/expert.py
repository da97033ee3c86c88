"""The expert: PPO on a CPU, 3 x 256 Tanh, whose mean action the GHNs are distilled from (NNiT appendix D)."""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors.torch
import torch
from pydantic import BaseModel, ConfigDict
from safetensors.torch import load_file
from torch import Tensor, nn

from nnit_zoo.atomic import write_bytes, write_json
from nnit_zoo.files import EXPERT
from nnit_zoo.parallel import in_chunks
from nnit_zoo.sim.rollout import Episodes, rollout
from nnit_zoo.sim.tabletop import Array
from nnit_zoo.tasks.robot import RobotPolicyTask

TRAINING_SEEDS = 100_000_000  # episode seeds of training count up from here
EVALUATION_SEEDS = range(90_000_000, 90_000_200)
UNIT = 32  # training episodes that a worker plays in lockstep
RELEASE_WITHIN = 0.012  # metres of its goal at which a held object is let go, where that is shown
OPEN = (0.4, 1.0)  # range of the gripper's action then

Network = list[tuple[Array, Array]]  # (weight [out, in], bias [out]) of each layer


class Release(BaseModel):
    """How an expert is taught to let go of a cube.

    A gripper that holds a cube learns to close far beyond what counts, where no noise opens it, and one step open does
    not let go: without help, the cube is held in place for ever. With it from the start, the place is shunned.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    after_steps: int
    """When this begins: once cubes are held in place."""
    share: float
    """Of the training episodes: in these the gripper opens, for good, once it holds the cube in place."""
    bound_weight: float
    """Of the square by which mean actions leave [-1, 1], in the loss."""
    least_std: float
    """Of the gripper's action."""


class ExpertConfig(BaseModel):
    """PPO's settings; ManiSkill's baseline with fewer environments and a longer horizon (gamma 0.9 for its 0.8)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = 0
    total_steps: int = 4_000_000
    environments: int = 64
    hidden: int = 256
    log_std: float = -0.5
    learning_rate: float = 3e-4
    gamma: float = 0.9
    gae_lambda: float = 0.9
    epochs: int = 6
    minibatch: int = 400
    clip: float = 0.2
    value_weight: float = 0.5
    target_kl: float = 0.1
    max_grad_norm: float = 0.5
    evaluate_every: int = 40
    stop_success: float = 0.99
    stop_return: float = 39.0
    release: Release | None = None


CONFIG_BY_TASK = {
    "PushCube-v1": ExpertConfig(stop_success=0.98, stop_return=42.0),
    "StackCubeEasy-v1": ExpertConfig(
        stop_success=0.95,
        stop_return=38.0,
        total_steps=12_000_000,
        release=Release(after_steps=1_800_000, share=0.5, bound_weight=0.3, least_std=0.6),
    ),
}
"""For tasks whose expert stops at other scores than PickCube-v1's, or learns otherwise, or for longer."""


class ActorCritic(nn.Module):
    """Separate 3-layer Tanh networks for the mean action and the value, and one log standard deviation per action."""

    def __init__(self, inputs: int, outputs: int, hidden: int, log_std: float) -> None:
        super().__init__()
        self.actor = _mlp(inputs, hidden, outputs, last_gain=0.01 * 2**0.5)
        self.critic = _mlp(inputs, hidden, 1, last_gain=1.0)
        self.log_std = nn.Parameter(torch.full((outputs,), log_std))

    def log_prob(self, means: Tensor, actions: Tensor) -> Tensor:
        """Log density [b] of actions [b, outputs] around the actor's means [b, outputs]."""
        deviations = (actions - means) / self.log_std.exp()
        negative: Tensor = 0.5 * deviations.square() + self.log_std + 0.5 * math.log(2 * math.pi)
        return -negative.sum(1)


def _mlp(inputs: int, hidden: int, outputs: int, last_gain: float) -> nn.Sequential:
    widths = (inputs, hidden, hidden, hidden, outputs)
    modules: list[nn.Module] = []
    for level, (into, out) in enumerate(pairwise(widths)):
        linear = nn.Linear(into, out)
        nn.init.orthogonal_(linear.weight, last_gain if level == 3 else 2**0.5)
        nn.init.zeros_(linear.bias)
        modules += [linear, nn.Tanh()]
    return nn.Sequential(*modules[:-1])


def network_of(actor: nn.Sequential) -> Network:
    """The actor's layers as arrays, for use without torch in the simulator's processes."""
    linears = [module for module in actor if isinstance(module, nn.Linear)]
    return [(linear.weight.detach().numpy().copy(), linear.bias.detach().numpy().copy()) for linear in linears]


def mean_action(network: Network, observations: Array) -> Array:
    """The expert's mean actions [n, outputs], not clipped, on raw observations [n, inputs]."""
    hidden = observations
    for weight, bias in network[:-1]:
        hidden = np.tanh(hidden @ weight.T + bias)
    weight, bias = network[-1]
    return np.asarray(hidden @ weight.T + bias)


def load(path: Path) -> Network:
    """The expert stored as safetensors with tensors `0.weight`, `0.bias`, `1.weight` and so on."""
    tensors = load_file(path)
    return [
        (tensors[f"{level}.weight"].numpy(), tensors[f"{level}.bias"].numpy()) for level in range(len(tensors) // 2)
    ]


def save(network: Network, path: Path) -> None:
    """Store an expert for `load`."""
    tensors: dict[str, Tensor] = {}
    for level, (weight, bias) in enumerate(network):
        tensors |= {f"{level}.weight": torch.from_numpy(weight), f"{level}.bias": torch.from_numpy(bias)}
    write_bytes(path, safetensors.torch.save(tensors))


def play(task: RobotPolicyTask, network: Network, seeds: range) -> Episodes:
    """Episodes of the expert, one for each seed, in lockstep."""
    return rollout(task, seeds, partial(mean_action, network))


def explore(
    task: RobotPolicyTask, network: Network, seeds: range, std: Array, noise_seed: int, release_share: float
) -> Episodes:
    """Training episodes: Gaussian noise of this standard deviation [outputs] on the actions.

    In a share `release_share` of them the gripper opens, for good, once it holds the object where it belongs.
    """
    noise, shown = np.random.default_rng(noise_seed), np.random.default_rng((noise_seed, 1))
    chosen = shown.random(len(seeds)) < release_share
    opened = np.zeros(len(seeds), bool)

    def act(observations: Array) -> Array:
        actions = mean_action(network, observations)
        actions = actions + std * noise.standard_normal(actions.shape, np.float32)
        if chosen.any():
            opened[chosen] |= _holds_at_goal(task, observations[chosen])
            actions[opened, -1] = shown.uniform(*OPEN, opened.sum())
        return actions

    return rollout(task, seeds, act)


def _holds_at_goal(task: RobotPolicyTask, observations: Array) -> npt.NDArray[np.bool_]:
    """Whether the gripper holds the object within 12 mm of its goal, [n]."""
    parts = np.split(observations, np.cumsum(list(task.layout.values()))[:-1], axis=1)
    seen = dict(zip(task.layout, parts, strict=True))
    near: npt.NDArray[np.bool_] = np.linalg.norm(seen["obj_to_goal_pos"], axis=1) < RELEASE_WITHIN
    return near & (seen["is_grasped"][:, 0] > 0)


class Training:
    """PPO's state: everything that a resumed run needs to go on as if it had not stopped."""

    def __init__(self, task: RobotPolicyTask, config: ExpertConfig) -> None:
        self.config = config
        self.task = task
        self.generator = torch.Generator().manual_seed(config.seed)
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            self.model = ActorCritic(task.inputs, task.outputs, config.hidden, config.log_std)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=config.learning_rate, eps=1e-5)
        self.iteration = 0
        self.best_return = 0.0

    @property
    def steps(self) -> int:
        """Environment steps taken so far."""
        return self.iteration * self.config.environments * self.task.episode_steps

    def save(self, path: Path) -> None:
        """Write the state for `restore`, atomically."""
        state = {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "iteration": self.iteration,
            "best_return": self.best_return,
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_bytes(path, buffer.getvalue())

    def restore(self, path: Path) -> None:
        """Take up the state that `save` wrote."""
        state = torch.load(path, weights_only=True)
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.iteration, self.best_return = state["iteration"], state["best_return"]

    @property
    def release(self) -> Release | None:
        """How letting go is taught, once it is."""
        release = self.config.release
        return release if release and self.steps >= release.after_steps else None

    def iterate(self, workers: int) -> float:
        """Roll out one episode per environment, update, and return the mean undiscounted return."""
        task, network, release = self.task, network_of(self.model.actor), self.release
        if release:
            with torch.no_grad():
                self.model.log_std[-1].clamp_(min=math.log(release.least_std))
        std = self.model.log_std.detach().exp().numpy()
        first = TRAINING_SEEDS + self.iteration * self.config.environments

        def unit_episodes(unit: range) -> Episodes:
            noise_seed = first + (unit.start - first) // UNIT
            return explore(task, network, unit, std, noise_seed, release.share if release else 0.0)

        # Units of a fixed size, each with noise of its own: the number of workers changes no number.
        episodes = in_chunks(unit_episodes, range(first, first + self.config.environments), UNIT, workers)
        observations = torch.from_numpy(np.concatenate([part.observations for part in episodes], axis=1))
        actions = torch.from_numpy(np.concatenate([part.actions for part in episodes], axis=1))
        rewards = torch.from_numpy(np.concatenate([part.rewards for part in episodes], axis=1))
        self._update(observations, actions, rewards)
        self.iteration += 1
        return float(rewards.sum(0).mean())

    def _update(self, observations: Tensor, actions: Tensor, rewards: Tensor) -> None:
        config, release = self.config, self.release
        rate = config.learning_rate * max(1 - self.steps / config.total_steps, 0.05)
        self.optimizer.param_groups[0]["lr"] = rate
        with torch.no_grad():
            values = self.model.critic(observations)[..., 0]
            advantages = generalised_advantages(rewards, values, config.gamma, config.gae_lambda).flatten()
            targets = advantages + values[:-1].flatten()
            states, taken = observations[:-1].flatten(0, 1), actions.flatten(0, 1)
            old = self.model.log_prob(self.model.actor(states), taken)
        for _ in range(config.epochs):
            for rows in torch.split(torch.randperm(len(states), generator=self.generator), config.minibatch):
                means = self.model.actor(states[rows])
                ratio_log = self.model.log_prob(means, taken[rows]) - old[rows]
                ratio = ratio_log.exp()
                if ((ratio - 1) - ratio_log).mean() > config.target_kl:
                    return
                advantage = advantages[rows]
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
                policy_loss = -torch.minimum(ratio * advantage, clipped * advantage).mean()
                value_loss = 0.5 * (self.model.critic(states[rows])[:, 0] - targets[rows]).square().mean()
                loss = policy_loss + config.value_weight * value_loss
                if release:
                    excess = (means.abs() - 1).clamp(min=0).square().sum(1).mean()
                    loss = loss + release.bound_weight * excess
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.model.parameters(), config.max_grad_norm)
                self.optimizer.step()


def generalised_advantages(rewards: Tensor, values: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """GAE advantages [T, n] from rewards [T, n] and values [T + 1, n]; the end is a time limit, so it bootstraps."""
    advantages = torch.zeros_like(rewards)
    running = torch.zeros_like(rewards[0])
    for step in reversed(range(len(rewards))):
        delta = rewards[step] + gamma * values[step + 1] - values[step]
        running = delta + gamma * gae_lambda * running
        advantages[step] = running
    return advantages


def train(
    task: RobotPolicyTask, config: ExpertConfig, folder: Path, workers: int, log: Callable[[str], None]
) -> dict[str, Any]:
    """Train until the stopping scores or `total_steps`; `folder` gets the state, a log and the best expert.

    Returns the record of the best expert, which reaches these scores or else has the highest return: its deterministic
    scores over 200 episodes, and steps.
    """
    folder.mkdir(parents=True, exist_ok=True)
    training = Training(task, config)
    if (folder / "state.pt").exists():
        training.restore(folder / "state.pt")
        log(f"resuming the expert at {training.steps:,} steps")
    record: dict[str, Any] = json.loads((folder / "record.json").read_text()) if training.best_return else {}
    while training.steps < config.total_steps and not good_enough(config, record):
        started = time.monotonic()
        mean_return = training.iterate(workers)
        if training.iteration % config.evaluate_every:
            continue
        network = network_of(training.model.actor)
        scores = summarise(in_chunks(partial(play, task, network), EVALUATION_SEEDS, 50, workers))
        entry = {"steps": training.steps, "training_return": mean_return, **scores}
        log(f"expert {json.dumps(entry)} ({time.monotonic() - started:.1f} s)")
        with (folder / "log.jsonl").open("a") as lines:
            lines.write(json.dumps(entry) + "\n")
        if good_enough(config, entry) or scores["return"] > training.best_return:
            training.best_return = scores["return"]
            save(network, folder / EXPERT)
            record = entry
            write_json(folder / "record.json", record)
        training.save(folder / "state.pt")
    return record


def good_enough(config: ExpertConfig, record: dict[str, Any]) -> bool:
    """Whether an expert with this record, which may be empty, reaches the scores to stop at."""
    return bool(record) and record["success_at_end"] >= config.stop_success and record["return"] >= config.stop_return


def summarise(episodes: list[Episodes]) -> dict[str, float]:
    """Mean return, success_once and success_at_end over episodes."""
    success = np.concatenate([part.success for part in episodes], axis=1)
    rewards = np.concatenate([part.rewards for part in episodes], axis=1)
    return {
        "return": float(rewards.sum(0).mean()),
        "success_once": float(success.any(0).mean()),
        "success_at_end": float(success[-1].mean()),
        "episodes": success.shape[1],
    }
