"""A task that is scored by a formula, a generator that makes networks from its seed, and a small zoo: no simulator."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from nnit_baselines import Capabilities, FitOptions, Generator, SampleRequest
from nnit_bench import records
from nnit_bench.protocol import Protocol
from nnit_bench.provenance import Code
from nnit_bench.records import Identity, Method, RunRecord, ZooVersion
from nnit_bench.results import StoredRun
from nnit_bench.scores import summarise
from nnit_zoo import ghn_file
from nnit_zoo.architecture import Architecture, hidden_widths
from nnit_zoo.files import GHNS, INDEX_SCHEMA
from nnit_zoo.ghn import GHN
from nnit_zoo.materialise import materialise, write_manifest
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.metric import Metric
from nnit_zoo.tasks.task import EPISODE_SCHEMA, Task
from nnit_zoo.zoo import TrainingView, Zoo


class Formula(Task):
    """A policy succeeds in an episode if its first bias exceeds a number drawn from the episode's seed."""

    name = "Formula-v1"
    version = 1
    inputs = 3
    outputs = 2
    metrics = (
        Metric("success_at_end", "success at end", "%"),
        Metric("success_once", "success once", "%"),
        Metric("return", "return", ""),
    )
    thresholds = {"success_at_end": 0.5, "return": 0.5}  # noqa: RUF012

    def __init__(self) -> None:
        self.calls: list[tuple[int, list[int]]] = []

    def probe_states(self) -> torch.Tensor:
        return torch.randn(50, self.inputs, generator=torch.Generator().manual_seed(0))

    def evaluate(
        self,
        policies: Sequence[PolicyBatch],
        seeds: Sequence[int],
        *,
        workers: int = 2,
        parallel: str = "processes",
        store: Path | None = None,
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


class Digits(Formula):
    """A task like a test set: eight episodes, no notion of success, and a return between 0 and 1."""

    name = "Digits-v1"
    metrics = (Metric("return", "accuracy", "%"),)
    episodes = 8
    episode_seeds = range(8)

    def phase_seeds(self, phase: str, episodes: int) -> range:
        return range(episodes) if phase == "select" else range(0)

    def evaluate(self, *arguments: Any, **options: Any) -> pa.Table:
        table = super().evaluate(*arguments, **options)
        share = pa.compute.divide(table["return"], pa.scalar(40, pa.float32()))
        nothing = pa.nulls(len(table), pa.bool_())
        for name, values in (("return", share), ("success_once", nothing), ("success_at_end", nothing)):
            table = table.set_column(EPISODE_SCHEMA.get_field_index(name), EPISODE_SCHEMA.field(name), values)
        return table


class Seeded(Generator):
    """Networks whose first bias, their skill, is uniform in [0, 1] and follows from the request's seed alone."""

    capabilities = Capabilities(joint=True, depths=(4,))

    def __init__(self) -> None:
        super().__init__()
        self.sampling_steps = 4
        self.training_facts = {"seed": 7, "seconds": 1}

    def fit(self, view: TrainingView, options: FitOptions | None = None) -> None:
        pass

    def sample(self, request: SampleRequest) -> PolicyBatch:
        draws = torch.Generator().manual_seed(request.seed)
        layers = [
            0.1 * torch.randn(request.policies, *shape, generator=draws) for shape in request.architecture.block_shapes
        ]
        layers[0][:, 0, -1] = torch.rand(request.policies, generator=draws)
        return PolicyBatch(request.architecture, tuple(layers))

    def sample_joint(self, policies: int, seed: int) -> list[PolicyBatch]:
        names = [hidden_widths("seen")[0], hidden_widths("unseen")[0], "8-8-8-8"]
        counts = [policies - 3, 2, 1]
        return [
            self.sample(SampleRequest(Architecture.parse(name, 3, 2), count, seed))
            for name, count in zip(names, counts, strict=True)
        ]

    def config(self) -> dict[str, Any]:
        return {}

    def tensors(self) -> dict[str, torch.Tensor]:
        return {"weight": torch.ones(2)}


@pytest.fixture
def task() -> Formula:
    return Formula()


@pytest.fixture
def digits() -> Digits:
    return Digits()


@pytest.fixture
def generator() -> Seeded:
    return Seeded()


@pytest.fixture
def protocol(task: Formula) -> Protocol:
    return Protocol.of(task, "unseen", policies=3, episodes=6).model_copy(update={"top": 4})


def embed_zoo(folder: Path, task: Task, seeds: Sequence[int], splits: dict[str, Sequence[str]]) -> Path:
    """A folder like a task's in the package: random hypernetworks, of which every policy is kept."""
    folder.mkdir(parents=True)
    states = {seed: GHN(task.inputs, task.outputs, seed).state_dict() for seed in seeds}
    ghn_file.write(folder / GHNS, ghn_file.GHNs(task.name, task.inputs, task.outputs, states))
    scores = {"success_once": 1.0, "success_at_end": 0.9, "return": 36.0, "episodes": 64, "kept": True}
    rows = [
        {"architecture": name, "ghn_seed": seed, "split": split, **scores}
        for split, names in splits.items()
        for name in names
        for seed in seeds
    ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "selection.parquet")
    write_manifest(folder, None)
    return folder


@pytest.fixture(scope="session")
def zoo(tmp_path_factory: pytest.TempPathFactory) -> Zoo:
    """Two seeds of the corpus and two held-out ones, on two seen and all unseen architectures."""
    folder = tmp_path_factory.mktemp("zoo")
    splits = {"seen": ["64-64-64-64", "32-16-64-32"], "unseen": hidden_widths("unseen")}
    materialise(embed_zoo(folder / "embedded", Formula(), [0, 1, 128, 129], splits), folder / "zoo")
    return Zoo.open(folder / "zoo")


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
            "n_params": [1] * count,
            "weight_norm": [1.0] * count,
        },
        INDEX_SCHEMA,
    )


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    """A file with a generator in it, as a user would write one."""
    path = tmp_path / "my_method.py"
    path.write_text(
        "import torch\n"
        "from nnit_baselines import Capabilities, Generator\n"
        "from nnit_zoo import PolicyBatch\n\n\n"
        "class Zeros(Generator):\n"
        "    capabilities = Capabilities(checkpoint=False)\n\n"
        "    def fit(self, view, options=None):\n"
        "        self.task = view.task\n\n"
        "    def sample(self, request):\n"
        "        shapes = request.architecture.block_shapes\n"
        "        layers = tuple(torch.zeros(request.policies, *shape) for shape in shapes)\n"
        "        return PolicyBatch(request.architecture, layers)\n"
    )
    return path


def store_run(
    folder: Path, name: str, protocol: Protocol, success: np.ndarray, zoo: str = "z", given: Any = None
) -> StoredRun:
    """A finished run whose policies went as `success` [policies, episodes] says; those of `joint` are all alike."""
    names = [each for each, count in protocol.policies.items() for _ in range(count)]
    names = ["16-16-16-32" if protocol.is_joint else each for each in names]
    rows = []
    for (policy, column), value in np.ndenumerate(success):
        row = dict.fromkeys(records.STORED_EPISODE_SCHEMA.names) | {"policy": policy, "phase": "select"}
        row |= {"architecture": names[policy], "episode_seed": protocol.select.first + column}
        if "success_at_end" in [metric.column for metric in protocol.metrics]:
            row |= {"success_at_end": bool(value), "success_once": bool(value), "return": 40.0 * value}
        rows.append({"return": value} | {name: each for name, each in row.items() if each is not None})
    episodes = pa.Table.from_pylist(rows, records.STORED_EPISODE_SCHEMA)
    method = Method(name=name, config={}, given=given or {}, training={}, parameters=None, checkpoint_sha256=None)
    identity = Identity(protocol=protocol, method=method, zoo_sha256=zoo, code_sha256="c", packages={})
    code = Code(sha256="c", commit=None, dirty=None)
    place = identity.folder(folder)
    record = RunRecord.start(identity, ZooVersion(sha256=zoo, policies=1, seeds=1), code)
    timings = records.Timings(load_or_fit=0, sample=0, novelty=0, score=0)
    novelty = records.Novelty(
        same_architecture=records.Distance(median=0.02, heldout=1.2, ratio=0.02 / 1.2),
        any_architecture=None,
        actions=None,
        copies=0,
        pairwise_l2=None,
        pairwise_cosine=None,
    )
    results = summarise(episodes, protocol)
    record = record.finish(place, episodes, pa.table({}), timings=timings, results=results, novelty=novelty)
    return StoredRun(record, place)


@pytest.fixture
def store(tmp_path: Path) -> Callable[..., StoredRun]:
    """Stores finished runs below the test's folder."""
    return partial(store_run, tmp_path)


@pytest.fixture
def embed() -> Callable[..., Path]:
    """Makes a folder like a task's in the package."""
    return embed_zoo
