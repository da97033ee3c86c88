"""A task that is scored by a formula, a generator that makes networks from its seed, and a small zoo: no simulator."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from pydantic import BaseModel

from nnit_baselines.generator import Capabilities, Generator, Run, SampleRequest
from nnit_bench.protocol import Protocol, policies_per_architecture
from nnit_zoo.files import INDEX_SCHEMA
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.task import EPISODE_SCHEMA, Task
from nnit_zoo.zoo import TrainingView


class Formula(Task):
    """A policy succeeds in an episode if its first bias exceeds a number drawn from the episode's seed."""

    name = "Formula-v1"
    version = 1
    inputs = 3
    outputs = 2
    success_threshold = 0.5
    return_threshold = 0.5

    def __init__(self) -> None:
        self.calls: list[tuple[int, list[int]]] = []

    def evaluate(
        self,
        policies: Sequence[PolicyBatch],
        seeds: Sequence[int],
        *,
        workers: int = 2,
        progress: Callable[[int], None] | None = None,
    ) -> pa.Table:
        self.check(policies, seeds)
        self.calls.append((sum(map(len, policies)), list(seeds)))
        hurdles = [np.random.default_rng(seed).random() for seed in seeds]
        rows = []
        for number, policy in enumerate(one for batch in policies for one in batch):
            skill, finite = float(policy.layers[0][0, 0, -1]), bool(policy.finite())
            for seed, hurdle in zip(seeds, hurdles, strict=True):
                success = finite and skill > hurdle
                score = 40 * skill if finite else 0.0
                reason = None if finite else "not finite"
                rows.append((number, str(policy.architecture), seed, score, success, success, reason))
            if progress:
                progress(len(seeds))
        return pa.Table.from_pylist([dict(zip(EPISODE_SCHEMA.names, row, strict=True)) for row in rows], EPISODE_SCHEMA)


class Settings(BaseModel):
    sampling_steps: int = 4


class Seeded(Generator):
    """Networks whose first bias, their skill, is uniform in [0, 1] and follows from the request's seed alone."""

    capabilities = Capabilities()

    def __init__(self) -> None:
        super().__init__()
        self.settings = Settings()

    def fit(self, view: TrainingView, run: Run | None = None) -> None:
        pass

    def sample(self, request: SampleRequest) -> PolicyBatch:
        assert request.architecture is not None
        draws = torch.Generator().manual_seed(request.seed)
        layers = [torch.zeros(request.policies, *shape) for shape in request.architecture.block_shapes]
        layers[0][:, 0, -1] = torch.rand(request.policies, generator=draws)
        return PolicyBatch(request.architecture, tuple(layers))

    def config(self) -> dict[str, Any]:
        return self.settings.model_dump()

    def tensors(self) -> dict[str, torch.Tensor]:
        return {"weight": torch.ones(2)}


@pytest.fixture
def task() -> Formula:
    return Formula()


@pytest.fixture
def generator() -> Seeded:
    return Seeded()


@pytest.fixture
def protocol() -> Protocol:
    policies = policies_per_architecture("unseen", 3)
    return Protocol(task="Formula-v1", task_version=1, split="unseen", policies=policies, episodes=6, top=4)


@pytest.fixture
def zoo_index() -> pa.Table:
    """Two policies of each of two unseen architectures, and one of a seen architecture."""
    architectures = ["32-32-16-64", "32-32-16-64", "16-16-16-32", "16-16-16-32", "64-64-64-64"]
    count = len(architectures)
    return pa.table(
        {
            "id": [f"Formula-v1/{name}/{row:03d}" for row, name in enumerate(architectures)],
            "task": ["Formula-v1"] * count,
            "architecture": architectures,
            "ghn_seed": [0, 1, 0, 1, 0],
            "split": ["unseen"] * 4 + ["seen"],
            "success_once": [1.0, 1.0, 0.75, 0.75, 0.0],
            "success_at_end": [1.0, 0.75, 0.5, 0.75, 0.0],
            "return": [40.0, 30.0, 20.0, 30.0, 0.0],
            "episodes": [64] * count,
            "shard": [f"{name}.safetensors" for name in architectures],
            "row": [0, 1, 0, 1, 0],
            "sha256": [""] * count,
        },
        INDEX_SCHEMA,
    )


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    """A file with a generator in it, as a user would write one."""
    path = tmp_path / "my_method.py"
    path.write_text(
        "import torch\n"
        "from nnit_baselines.generator import Capabilities, Generator\n"
        "from nnit_zoo.policy import PolicyBatch\n\n\n"
        "class Zeros(Generator):\n"
        "    capabilities = Capabilities(checkpoint=False)\n\n"
        "    def fit(self, view, run=None):\n"
        "        self.task = view.task\n\n"
        "    def sample(self, request):\n"
        "        shapes = request.architecture.block_shapes\n"
        "        layers = tuple(torch.zeros(request.policies, *shape) for shape in shapes)\n"
        "        return PolicyBatch(request.architecture, layers)\n"
    )
    return path
