"""One run: a generator makes its policies, the task scores them, and a record is left behind."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nnit_baselines.generator import WEIGHTS, Generator, SampleRequest
from nnit_bench import records, statistics
from nnit_bench.protocol import Protocol
from nnit_bench.records import Code, Identity, Method, RunRecord, Timings
from nnit_bench.statistics import METRICS, Ints, Scores, Summary
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.files import sha256_of
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.task import Task

Stage = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Shows a stage of work: called with its name and size, gives a context that takes the number of newly done items."""


@dataclass(frozen=True)
class Contestant:
    """A generator that is ready to sample, and how it got there."""

    method: Method
    generator: Generator
    seconds: float
    """Wall-clock time that loading or fitting it took."""


@dataclass(frozen=True)
class Outcome:
    """A finished run: its record, its table row, and whether it had been run before."""

    record: RunRecord
    summary: Summary
    folder: Path
    reused: bool
    zeroed: dict[str, int]
    """Why policies scored 0 without an episode, and how many of them."""


class ZooRow(NamedTuple):
    """The zoo's own row of the table: `policies` policies, scored by `episodes` episodes each."""

    summary: Summary
    policies: int
    episodes: int


def contestant(name: str, generator: Generator, seconds: float) -> Contestant:
    """The contestant called `name`, with the settings and the checkpoint hash that identify it."""
    if not generator.capabilities.checkpoint:
        return Contestant(Method(name=name, config={}, checkpoint_sha256=None), generator, seconds)
    with TemporaryDirectory() as folder:  # also a checkpoint from the Hub is identified by what it is, not by its name
        generator.save_pretrained(folder)
        sha256 = sha256_of(Path(folder) / WEIGHTS)
    return Contestant(Method(name=name, config=generator.config(), checkpoint_sha256=sha256), generator, seconds)


def set_steps(name: str, generator: Generator, steps: int) -> None:
    """Make the generator sample in this number of steps: such a one has `settings.sampling_steps`, a pydantic model's.

    Raises UserError if it does not sample in steps.
    """
    settings: Any = getattr(generator, "settings", None)
    if not hasattr(settings, "sampling_steps"):
        raise UserError(f"{name} does not sample in steps: leave --steps out")
    if steps < 1:
        raise UserError(f"--steps must be 1 or more, not {steps}")
    vars(generator)["settings"] = settings.model_copy(update={"sampling_steps": steps})


def run(
    task: Task, entrant: Contestant, identity: Identity, code: Code, output: Path, *, workers: int, stage: Stage
) -> Outcome:
    """Sample, score and record one method; raises UserError if the method or the task cannot, after recording that.

    An interrupted run leaves a record with status `started`, and is repeated from its beginning.
    """
    protocol = identity.protocol
    record = RunRecord.start(identity, code)
    record.write(output)
    try:
        start = time.perf_counter()
        batches = sample(task, entrant, protocol, stage)
        sampled = time.perf_counter()
        episodes = score(task, batches, protocol, workers, stage)
        scored = time.perf_counter()
    except Exception as error:
        record.fail(output, error)
        raise
    labels = {"method": entrant.method.name, "task": protocol.task, "split": protocol.split}
    for name, value in labels.items():
        episodes = episodes.append_column(name, pa.array([value] * len(episodes)))
    episodes = episodes.select(records.EPISODE_SCHEMA.names)
    timings = Timings(load_or_fit=entrant.seconds, sample=sampled - start, score=scored - sampled)
    summary = summarise(episodes, protocol.top)
    record = record.finish(output, episodes, timings, summary)
    return Outcome(record, summary, record.folder(output), reused=False, zeroed=zeroed(episodes))


def finished(identity: Identity, output: Path) -> Outcome | None:
    """The outcome of an identical run that has been finished before, if there is one."""
    folder = identity.folder(output)
    if not (folder / records.RECORD).is_file():
        return None
    record = RunRecord.read(folder)
    if record.status != "success":
        return None
    episodes = records.read_episodes(folder)
    summary = summarise(episodes, identity.protocol.top)
    return Outcome(record, summary, folder, reused=True, zeroed=zeroed(episodes))


def zeroed(episodes: pa.Table) -> dict[str, int]:
    """How many policies scored 0 without an episode, for each reason."""
    failed = episodes.filter(pc.is_valid(episodes["reason"])).group_by(["reason", "policy"]).aggregate([])
    return dict(Counter(failed["reason"].to_pylist()))


def sample(task: Task, entrant: Contestant, protocol: Protocol, stage: Stage) -> list[PolicyBatch]:
    """The generated policies, one batch per architecture; raises UserError if the generator gives something else."""
    name, generator = entrant.method.name, entrant.generator
    if not generator.capabilities.conditional:
        raise UserError(f"{name} cannot be asked for an architecture, so it has no row on the {protocol.split} split")
    batches = []
    with stage(f"{name}: sampling policies", sum(protocol.policies.values())) as advance:
        for text, count in protocol.policies.items():
            architecture = Architecture.parse(text, task.inputs, task.outputs)
            batch = generator.sample(SampleRequest(architecture, count, sample_seed(protocol.seed, text)))
            if batch.architecture != architecture or len(batch) != count:
                given = f"{len(batch)} of {batch.architecture}"
                raise UserError(f"{name} was asked for {count} policies of {architecture} but gave {given}")
            batches.append(batch)
            advance(count)
    return batches


def sample_seed(seed: int, architecture: str) -> int:
    """The seed of one architecture's samples: they are the same whichever other architectures are asked for."""
    return int.from_bytes(hashlib.sha256(f"{seed} {architecture}".encode()).digest()[:4], "big") % 2**31


def score(task: Task, batches: Sequence[PolicyBatch], protocol: Protocol, workers: int, stage: Stage) -> pa.Table:
    """The episodes of all policies in phase `select`, then those of the top ones in phase `report`."""
    policies = [policy for batch in batches for policy in batch]

    def phase(name: str, label: str, batches: Sequence[PolicyBatch], numbers: Ints) -> pa.Table:
        seeds = protocol.seeds(name)
        with stage(label, len(numbers) * len(seeds)) as advance:
            table = task.evaluate(batches, seeds, workers=workers, progress=advance)
        # The task numbers what it is given from 0; a policy keeps its number through both phases.
        table = table.set_column(0, "policy", pc.take(pa.array(numbers, pa.int32()), table["policy"]))
        return table.append_column("phase", pa.array([name] * len(table)))

    select = phase("select", f"{protocol.task}: scoring episodes", batches, np.arange(len(policies)))
    best = statistics.best(statistics.scores(select), protocol.top)
    again = f"{protocol.task}: scoring the top {len(best)} again"
    return pa.concat_tables([select, phase("report", again, [policies[number] for number in best], best)])


def summarise(episodes: pa.Table, top: int) -> Summary:
    """The table row of a finished run."""
    select, report = (
        statistics.scores(episodes.filter(pc.equal(episodes["phase"], phase))) for phase in ("select", "report")
    )
    return statistics.summarise(select, report, top)


def zoo_row(index: pa.Table, protocol: Protocol) -> ZooRow | None:
    """The scores of the zoo's own policies on the same architectures; None if it has none.

    They were measured when the zoo was built, on other episodes.
    """
    wanted = pa.array(list(protocol.policies))
    rows = index.filter(
        pc.and_(pc.equal(index["split"], protocol.split), pc.is_in(index["architecture"], value_set=wanted))
    )
    if not len(rows):
        return None
    values = {metric: rows[metric].to_numpy().astype(np.float64)[:, None] for metric in METRICS}
    table = Scores(values, np.arange(len(rows)), np.array(rows["architecture"].to_pylist()))
    summary = statistics.summarise(table, None, protocol.top)
    return ZooRow(summary, len(rows), int(pc.min(rows["episodes"]).as_py()))
