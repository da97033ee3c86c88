"""NNiT's comparison of two populations: networks that GHNs emit, and twins of them trained by themselves (NNiT 6.1).

All have the expert's widths, 256-256-256, and learn from the same states and targets. Each network of the first comes
from a GHN of its own, each of the second from an initialisation of its own. The paper is silent on how both were
trained: the GHNs here know this one architecture, and neither plays episodes of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from safetensors.numpy import load_file as load_arrays
from safetensors.torch import load_file, save
from torch import Tensor, nn

from nnit_zoo.architecture import Architecture
from nnit_zoo.atomic import write_bytes
from nnit_zoo.build import expert as experts
from nnit_zoo.build.distill import labelled
from nnit_zoo.build.fit import Fit, FitConfig
from nnit_zoo.ghn import GHN
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.tasks.robot import RobotPolicyTask

Kind = Literal["GHN", "SGD"]
KINDS: tuple[Kind, ...] = get_args(Kind)
HIDDEN = (256, 256, 256)


class TwinsConfig(FitConfig):
    """Settings of a network's training; there is one architecture, and weight noise for the GHNs alone."""

    networks: int = 35
    """Of each kind; their seeds count up from 0."""
    steps: int = 1700
    learning_rate: float = 3e-3
    architectures_per_step: int = 1
    states_per_architecture: int = 512
    weight_noise: float = 0.05
    sgd_steps: int = 2000
    sgd_learning_rate: float = 1e-3


def train(
    task: RobotPolicyTask, config: TwinsConfig, network: experts.Network, states: Path, target: Path, kind: Kind
) -> str:
    """Train the network of `kind` whose seed is the name of `target`; stores it in float32; a log line."""
    torch.set_num_threads(1)
    inputs, labels = labelled(task, network, load_arrays(states)["states"])
    seed = int(target.stem)
    blocks, loss = (_emitted if kind == "GHN" else _trained)(task, config, inputs, labels, seed)
    tensors = {f"layers.{depth}": block.detach().contiguous() for depth, block in enumerate(blocks)}
    write_bytes(target, save(tensors))
    return f"{kind} {seed}: loss {loss:.4f}"


def _emitted(
    task: RobotPolicyTask, config: TwinsConfig, inputs: Tensor, labels: Tensor, seed: int
) -> tuple[Sequence[Tensor], float]:
    """The blocks [out, in + 1] of a GHN's network, and the last loss."""
    ghn = GHN(task.inputs, task.outputs, seed, widths=HIDDEN[:1], layers=len(HIDDEN) + 1)
    ghn.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a fifth faster
    architecture = Architecture(task.inputs, HIDDEN, task.outputs)
    fit = Fit(ghn, config, seed, chosen=[architecture])
    optimizer, schedule = _optimizer(ghn, config.learning_rate, config.steps)
    loss = fit.run(inputs, labels, config.steps, optimizer, schedule)
    return [layer[0] for layer in ghn.emit(architecture).layers], loss


def _trained(
    task: RobotPolicyTask, config: TwinsConfig, inputs: Tensor, labels: Tensor, seed: int
) -> tuple[Sequence[Tensor], float]:
    """The blocks of a network that learns by itself, and the last loss; it starts as the expert did."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        actor = experts.ActorCritic(task.inputs, task.outputs, HIDDEN[0], log_std=0.0).actor
    draw = torch.Generator().manual_seed(seed)
    optimizer, schedule = _optimizer(actor, config.sgd_learning_rate, config.sgd_steps)
    loss = torch.zeros(())
    for _ in range(config.sgd_steps):
        rows = torch.randint(len(inputs), (config.states_per_architecture,), generator=draw)
        loss = nn.functional.mse_loss(actor(inputs[rows]), labels[rows])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    layers = [module for module in actor if isinstance(module, nn.Linear)]
    return [torch.cat([layer.weight, layer.bias[:, None]], dim=1) for layer in layers], float(loss.detach())


def _optimizer(model: nn.Module, rate: float, steps: int) -> tuple[Any, Any]:
    optimizer = torch.optim.AdamW(model.parameters(), lr=rate)
    return optimizer, torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)


def load(task: RobotPolicyTask, paths: Sequence[Path]) -> PolicyBatch:
    """The networks that `train` stored."""
    architecture = Architecture(task.inputs, HIDDEN, task.outputs)
    tensors = [load_file(path) for path in paths]
    depths = range(len(architecture.block_shapes))
    return concatenate(
        PolicyBatch(architecture, tuple(each[f"layers.{depth}"][None] for depth in depths)) for each in tensors
    )
