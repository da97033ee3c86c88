"""From expert to GHNs: DAgger gathers a buffer of states once; every seed's GHN starts from it and adds its own.

NNiT appendix D distils each GHN with DAgger of its own. A shared buffer costs far less on a CPU (docs/deviations.md);
a few on-policy rounds then show each GHN the states that its own policies reach. The record says which came from where.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file as load_arrays
from safetensors.numpy import save as serialise
from torch import Tensor

from nnit_zoo.architecture import Architecture
from nnit_zoo.atomic import write_bytes
from nnit_zoo.build import expert as experts
from nnit_zoo.build.fit import Fit, FitConfig, save_ghn
from nnit_zoo.ghn import GHN
from nnit_zoo.parallel import in_chunks
from nnit_zoo.sim.control import Controller
from nnit_zoo.sim.rollout import rollout
from nnit_zoo.sim.tabletop import Array
from nnit_zoo.tasks.robot import RobotPolicyTask

COLLECTION_SEEDS = 200_000_000  # episode seeds of DAgger count up from here
OWN_SEEDS = 300_000_000  # those of a GHN's own rounds count up from here
_SEEDS_PER_GHN = 10_000
COLLECTOR = 1_000_000  # seed of the GHN that gathers the buffer; it is in no zoo


class DistillConfig(FitConfig):
    """Settings of the buffer's DAgger rounds and of each GHN's regression."""

    rounds: int = 10
    episodes_per_round: int = 750
    teacher_decay: float = 0.6
    action_noise: float = 0.4
    round_steps: int = 250
    round_learning_rate: float = 2e-3
    steps: int = 1500
    own_rounds: int = 2
    """Times, evenly spread over the steps, that a GHN's own policies play, with the weight noise of training."""
    own_episodes: int = 50
    own_share: float = 0.25
    learning_rate: float = 4e-3
    architectures_per_step: int = 3
    states_per_architecture: int = 512
    weight_noise: float = 0.05


# The hardest task has the longest training, as in NNiT appendix D: it raised success at end, over 8 architectures of
# each of two GHNs, from 92.0 to 94.5 %.
CONFIG_BY_TASK = {"StackCubeEasy-v1": DistillConfig(steps=3000, own_rounds=4)}


def standardise(task: RobotPolicyTask, observations: Array) -> Array:
    """Standardised observations [n, inputs], as every policy sees them."""
    return np.asarray((observations - task.observation_mean) / task.observation_std)


def collect(
    task: RobotPolicyTask,
    network: experts.Network,
    students: Mapping[int, Sequence[Array]],
    beta: float,
    noise: float,
    seeds: range,
) -> Array:
    """Raw observations [len(seeds) * steps, inputs] of episodes in which the teacher acts with probability `beta`.

    Otherwise the student of this seed does; without students, the teacher always acts. Its actions get Gaussian noise,
    of a scale drawn per episode up to `noise`.
    """
    generator = np.random.default_rng(seeds.start)
    scales = generator.uniform(0, noise, (len(seeds), 1)).astype(np.float32)
    controller = None
    if students:
        networks = [students[seed] for seed in seeds]
        controller = Controller(networks, task.observation_mean, task.observation_std)

    def act(observations: Array) -> Array:
        actions = np.clip(experts.mean_action(network, observations), -1, 1)
        actions += scales * generator.standard_normal(actions.shape, np.float32)
        if controller is None:
            return actions
        teacher = generator.random((len(seeds), 1)) < beta
        return np.where(teacher, actions, controller(observations))

    return rollout(task, seeds, act).observations[:-1].reshape(-1, task.inputs)


def gather_states(
    task: RobotPolicyTask,
    config: DistillConfig,
    network: experts.Network,
    folder: Path,
    workers: int,
    log: Callable[[str], None],
) -> None:
    """Make `folder`/states.safetensors, raw observations [s, inputs], with a file per DAgger round on the way."""
    ghn = GHN(task.inputs, task.outputs, COLLECTOR)
    fit = Fit(ghn, config, COLLECTOR)
    optimizer = torch.optim.AdamW(ghn.parameters(), lr=config.round_learning_rate)
    gathered: list[Array] = []
    for round_ in range(config.rounds):
        first = COLLECTION_SEEDS + round_ * config.episodes_per_round
        seeds = range(first, first + config.episodes_per_round)
        students = dict(zip(seeds, _students(ghn, fit, len(seeds)), strict=True)) if round_ else {}
        path = folder / f"round-{round_}.safetensors"
        if not path.exists():
            work = partial(collect, task, network, students, config.teacher_decay**round_, config.action_noise)
            _save_states(path, np.concatenate(in_chunks(work, seeds, 50, workers)))
        gathered.append(load_arrays(path)["states"])
        inputs, labels = labelled(task, network, np.concatenate(gathered))
        loss = fit.run(inputs, labels, config.round_steps, optimizer)
        log(f"states: round {round_ + 1} of {config.rounds}, {len(inputs):,} states, loss {loss:.4f}")
    _save_states(folder / "states.safetensors", np.concatenate(gathered))


def _save_states(path: Path, states: Array) -> None:
    write_bytes(path, serialise({"states": states}))


def _students(ghn: GHN, fit: Fit, count: int) -> list[list[Array]]:
    """The GHN's policies of `count` seen architectures drawn at random, as arrays."""
    chosen = torch.randint(len(fit.architectures), (count,), generator=fit.generator).tolist()
    cache: dict[Architecture, list[Array]] = {}
    for index in chosen:
        architecture = fit.architectures[index]
        if architecture not in cache:
            cache[architecture] = [layer[0].numpy() for layer in ghn.emit(architecture).layers]
    return [cache[fit.architectures[index]] for index in chosen]


def labelled(task: RobotPolicyTask, network: experts.Network, observations: Array) -> tuple[Tensor, Tensor]:
    """Standardised states and the expert's clipped mean actions for raw observations."""
    labels = np.clip(experts.mean_action(network, observations), -1, 1).astype(np.float32)
    return torch.from_numpy(standardise(task, observations)), torch.from_numpy(labels)


def train_ghn(
    task: RobotPolicyTask, config: DistillConfig, network: experts.Network, states: Path, target: Path, seed: int
) -> str:
    """Train one seed's GHN on the buffer and its own rounds; stores its state as float16 safetensors; a log line."""
    torch.set_num_threads(1)
    inputs, labels = labelled(task, network, load_arrays(states)["states"])
    shared = len(inputs)
    ghn = GHN(task.inputs, task.outputs, seed)
    ghn.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a fifth faster
    fit = Fit(ghn, config, seed)
    optimizer = torch.optim.AdamW(ghn.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=config.steps)
    bounds = np.linspace(0, config.steps, config.own_rounds + 2).astype(int)
    loss = 0.0
    for round_, (start, stop) in enumerate(pairwise(bounds)):
        if round_:
            first = OWN_SEEDS + seed * _SEEDS_PER_GHN + (round_ - 1) * config.own_episodes
            own = _own_states(task, fit, range(first, first + config.own_episodes))
            more = labelled(task, network, own)
            inputs, labels = torch.cat([inputs, more[0]]), torch.cat([labels, more[1]])
        loss = fit.run(inputs, labels, int(stop - start), optimizer, schedule, own=len(inputs) - shared)
    return save_ghn(ghn, target, seed=seed, loss=loss, own_states=len(inputs) - shared)


def _own_states(task: RobotPolicyTask, fit: Fit, seeds: range) -> Array:
    """Raw observations [len(seeds) * steps, inputs] of episodes played by the GHN's own policies, weights noisy."""
    students = [
        [fit.noisy(torch.from_numpy(block)).numpy() for block in network]
        for network in _students(fit.ghn, fit, len(seeds))
    ]
    controller = Controller(students, task.observation_mean, task.observation_std)
    return rollout(task, seeds, controller).observations[:-1].reshape(-1, task.inputs)
