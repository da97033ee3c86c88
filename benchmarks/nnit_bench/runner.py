"""One run: a generator makes its policies, the task scores them, and a record is left behind."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch

from nnit_baselines import registry
from nnit_baselines.generator import WEIGHTS, Capabilities, Generator, SampleRequest, check_batch
from nnit_bench import novelty, records, scores
from nnit_bench.execution import Execution, Overwrite
from nnit_bench.protocol import Protocol
from nnit_bench.provenance import OUR_PACKAGES, Code, numeric_packages, this_code
from nnit_bench.records import Identity, Method, RunRecord, Timings, ZooVersion
from nnit_bench.scores import Scores
from nnit_bench.statistics import Estimate, Floats, Ints
from nnit_zoo.architecture import SPLITS, Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.files import MANIFEST, sha256_of
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.task import Task
from nnit_zoo.zoo import Zoo

Stage = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Shows a stage of work: called with its name and size, gives a context that takes the number of newly done items."""
UNITS = "units"
"""Folder in a run's folder that keeps finished work until the run is finished."""


@dataclass(frozen=True)
class Entry:
    """A method's entry in a run: a generator that is ready to sample, and how it got there."""

    method: Method
    code: Code
    """What was loaded to make it; later changes to the files do not count."""
    generator: Generator | None
    """None if it is of no use for what is asked."""
    unsupported: str | None
    """Why the generator cannot make what the protocol asks for, in words."""
    seconds: float
    """Wall-clock time that loading or fitting it took."""


@dataclass(frozen=True)
class Outcome:
    """A run's record, and whether it had been run before."""

    record: RunRecord
    folder: Path
    reused: bool
    zeroed: dict[str, int]
    """Why policies scored 0 without an episode, and how many of them."""


@dataclass(frozen=True)
class ZooRow:
    """The zoo's own row: column -> `mean`, `top`, `worst`, over `policies` policies scored by `episodes` episodes."""

    estimates: dict[str, dict[str, Estimate]]
    worst: str
    policies: int
    episodes: int


def enter(
    name: str, zoo: Zoo, protocol: Protocol, *, checkpoint: str | None = None, sampling_steps: int | None = None
) -> Entry:
    """The entry of the method `name`, with what identifies it; raises UserError if it cannot be loaded or fitted."""
    start = time.perf_counter()
    kind = registry.get(name)
    code = code_of(kind)
    options = {"checkpoint": checkpoint, "sampling_steps": sampling_steps}
    given = {key: value for key, value in options.items() if value is not None}
    able = kind.capabilities
    reason = None
    if protocol.is_joint and not able.joint:
        reason = "does not choose architectures"
    elif able.oracle and protocol.split not in SPLITS:
        reason = f"the zoo has no policies of the split {protocol.split}"
    if reason:
        return Entry(_without_checkpoint(name, able, given), code, None, reason, 0.0)
    with _one_thread():
        generator = registry.prepare(name, zoo, protocol.split, checkpoint, protocol.seed)
    if sampling_steps is not None:
        set_sampling_steps(name, generator, sampling_steps)
    method = describe(name, generator, given)
    return Entry(method, code, generator, _lacks(generator, zoo, protocol), time.perf_counter() - start)


def code_of(kind: type[Generator]) -> Code:
    """The code of a loaded method, as it was when this was first asked."""
    ours = kind.__module__.partition(".")[0] in OUR_PACKAGES
    return this_code(None if ours else kind.__module__)


def describe(name: str, generator: Generator, given: dict[str, Any]) -> Method:
    """What identifies a generator; `given` is what the command set on top of its defaults."""
    if not generator.capabilities.checkpoint:
        return _without_checkpoint(name, generator.capabilities, given)
    with TemporaryDirectory() as folder:  # also a checkpoint from the Hub is identified by what it is, not by its name
        generator.save_pretrained(folder)
        sha256 = sha256_of(Path(folder) / WEIGHTS)
    return Method(
        name=name,
        config=generator.config(),
        given=given,
        training=dict(generator.training_facts),
        parameters=sum(tensor.numel() for tensor in generator.tensors().values()),
        checkpoint_sha256=sha256,
        oracle=generator.capabilities.oracle,
    )


def _without_checkpoint(name: str, able: Capabilities, given: dict[str, Any]) -> Method:
    """What identifies a generator that is fitted at every run."""
    return Method(
        name=name, config={}, given=given, training={}, parameters=None, checkpoint_sha256=None, oracle=able.oracle
    )


def _lacks(generator: Generator, zoo: Zoo, protocol: Protocol) -> str | None:
    """What the protocol asks for that the generator does not support, in words."""
    if protocol.is_joint:
        return None if generator.capabilities.joint else "was not trained to choose architectures"
    sizes = zoo.manifest.inputs, zoo.manifest.outputs
    lacking = [name for name in protocol.policies if not generator.supports(Architecture.parse(name, *sizes))]
    if len(lacking) == len(protocol.policies):
        return f"supports no architecture of the split {protocol.split}"
    return f"does not support {', '.join(lacking)}" if lacking else None


def set_sampling_steps(name: str, generator: Generator, steps: int) -> None:
    """Make the generator sample in this number of steps; raises UserError if it does not sample in steps."""
    if generator.sampling_steps is None:
        raise UserError(f"{name} does not sample in steps: leave --sampling-steps out")
    if steps < 1:
        raise UserError(f"--sampling-steps must be 1 or more, not {steps}")
    generator.sampling_steps = steps


def run(task: Task, zoo: Zoo, entry: Entry, protocol: Protocol, execution: Execution, stage: Stage) -> Outcome:
    """Sample, score and record one method, or find that it has been done.

    An interrupted run leaves a record with status `started` and its finished work; the same call goes on from there. A
    run that is to be repeated is replaced once its repetition is finished. Raises UserError if the method or the task
    cannot, after recording that.
    """
    sha256 = sha256_of(zoo.folder / MANIFEST)
    identity = Identity(
        protocol=protocol,
        method=entry.method,
        zoo_sha256=sha256,
        code_sha256=entry.code.sha256,
        packages=numeric_packages() | _gpu(),
    )
    folder = identity.folder(execution.output)
    kept = execution.overwrite == "always" and _cleared(folder)
    if execution.overwrite != "always" and (earlier := _earlier(folder, execution.overwrite)):
        return earlier
    seen = zoo.index.filter(pc.equal(zoo.index["split"], "seen"))
    version = ZooVersion(sha256=sha256, policies=len(seen), seeds=len(pc.unique(seen["ghn_seed"])))
    record = (None if kept else _begun(folder)) or RunRecord.start(identity, version, entry.code)
    if not kept:
        record.write(folder)
    if entry.unsupported:
        return Outcome(record.stop(folder, "unsupported", entry.unsupported), folder, reused=False, zeroed={})
    try:
        record = _carry_out(record, folder, task, zoo, entry, execution, stage)
    except Exception as error:
        if not kept:
            record.stop(folder, "failed", str(error) or type(error).__name__)
        raise
    return Outcome(record, folder, reused=False, zeroed=zeroed(records.read_episodes(folder)))


def _cleared(folder: Path) -> bool:
    """Whether a finished run is there, which stays until it has been repeated; what else is there goes."""
    with suppress(UserError):  # no record, or a damaged one
        if RunRecord.read(folder).status in records.FINISHED:
            shutil.rmtree(folder / UNITS, ignore_errors=True)
            return True
    shutil.rmtree(folder, ignore_errors=True)
    return False


def _gpu() -> dict[str, str]:
    """The GPU that a method may have sampled on, which rounds otherwise; empty without one."""
    return {"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}


def _earlier(folder: Path, overwrite: Overwrite) -> Outcome | None:
    """The outcome that is there already, if it stays; raises UserError for an unfinished one that must stay."""
    if not (folder / records.RECORD).is_file():
        return None
    record = RunRecord.read(folder)
    if record.status in records.FINISHED:
        shutil.rmtree(folder / UNITS, ignore_errors=True)  # left by a kill at the very end
        counts = zeroed(records.read_episodes(folder)) if record.status == "success" else {}
        return Outcome(record, folder, reused=True, zeroed=counts)
    if overwrite == "never":
        raise UserError(f"the run in {folder} has not finished; --overwrite missing goes on with it")
    return None


def _begun(folder: Path) -> RunRecord | None:
    """The record of the interrupted run that is there, which has kept finished work, taken up again."""
    if not ((folder / records.RECORD).is_file() and (folder / UNITS).is_dir()):
        return None
    return RunRecord.read(folder).model_copy(update={"status": "started", "error": None, "resumed": True})


def _carry_out(
    record: RunRecord, folder: Path, task: Task, zoo: Zoo, entry: Entry, execution: Execution, stage: Stage
) -> RunRecord:
    """Sample, measure and score; returns the finished record."""
    protocol = record.protocol
    start = time.perf_counter()
    batches = sample(task, entry, protocol, stage)
    sampled = time.perf_counter()
    new, policies = novelty.measure(task, zoo, batches)
    compared = time.perf_counter()
    episodes = score(task, batches, protocol, execution, stage, folder / UNITS)
    scored = time.perf_counter()
    labels = {
        "method": entry.method.name,
        "training_seed": entry.method.training.get("seed"),
        "sampling_seed": protocol.seed,
        "task": protocol.task,
        "task_version": protocol.task_version,
        "split": protocol.split,
    }
    for name, value in labels.items():
        kind = records.STORED_EPISODE_SCHEMA.field(name).type
        episodes = episodes.append_column(name, pa.array([value] * len(episodes), kind))
    episodes = episodes.select(records.STORED_EPISODE_SCHEMA.names)
    record = record.finish(
        folder,
        episodes,
        policies,
        timings=Timings(
            load_or_fit=entry.seconds,
            sample=sampled - start,
            novelty=compared - sampled,
            score=scored - compared,
        ),
        results=scores.summarise(episodes, protocol),
        novelty=new,
    )
    shutil.rmtree(folder / UNITS, ignore_errors=True)
    return record


def zeroed(episodes: pa.Table) -> dict[str, int]:
    """How many policies scored 0 without an episode, for each reason."""
    failed = episodes.filter(pc.is_valid(episodes["reason"])).group_by(["reason", "policy"]).aggregate([])
    return dict(Counter(failed["reason"].to_pylist()))


def sample(task: Task, entry: Entry, protocol: Protocol, stage: Stage) -> list[PolicyBatch]:
    """The generated policies, one batch per architecture; raises UserError if the generator gives something else.

    PyTorch has one thread meanwhile: how it splits a sum among several changes its last digits.
    """
    name, generator = entry.method.name, entry.generator
    assert generator is not None
    batches = []
    with _one_thread(), stage(f"{name}: sampling policies", protocol.size) as advance:
        for text, count in protocol.policies.items():
            seed = sample_seed(protocol.seed, text)
            if protocol.is_joint:
                batches += [check_batch(name, batch) for batch in generator.sample_joint(count, seed)]
                given = sum(map(len, batches))
                if given != count:
                    raise UserError(f"{name} was asked for {count} policies but gave {given}")
            else:
                architecture = Architecture.parse(text, task.inputs, task.outputs)
                batch = check_batch(name, generator.sample(SampleRequest(architecture, count, seed)))
                if batch.architecture != architecture or len(batch) != count:
                    gave = f"{len(batch)} of {batch.architecture}"
                    raise UserError(f"{name} was asked for {count} policies of {architecture} but gave {gave}")
                batches.append(batch)
            advance(count)
    return batches


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def sample_seed(seed: int, architecture: str) -> int:
    """The seed of one architecture's samples: they are the same whichever other architectures are asked for."""
    return int.from_bytes(hashlib.sha256(f"{seed} {architecture}".encode()).digest()[:4], "big") % 2**31


def score(
    task: Task, batches: Sequence[PolicyBatch], protocol: Protocol, execution: Execution, stage: Stage, store: Path
) -> pa.Table:
    """The episodes of all policies in phase `select`, then those of the best in phase `report`, if there is one."""
    policies = [policy for batch in batches for policy in batch]

    def phase(name: str, label: str, batches: Sequence[PolicyBatch], numbers: Ints, seeds: range) -> pa.Table:
        with stage(label, len(numbers) * len(seeds)) as advance:
            table = task.evaluate(
                batches,
                seeds,
                workers=execution.workers,
                parallel=execution.parallel,
                store=store,
                progress=advance,
            )
        # The task numbers what it is given from 0; a policy keeps its number through both phases.
        table = table.set_column(0, "policy", pc.take(pa.array(numbers, pa.int32()), table["policy"]))
        table = table.rename_columns({"seed": "episode_seed"})
        return table.append_column("phase", pa.array([name] * len(table)))

    label = f"{protocol.task}: scoring episodes"
    select = phase("select", label, batches, np.arange(len(policies)), protocol.select.seeds)
    if protocol.report is None:
        return select
    best = scores.ranked(scores.from_episodes(select, protocol.metrics), protocol.metrics)[: protocol.top]
    again, chosen = f"{protocol.task}: scoring the top {len(best)} again", [policies[number] for number in best]
    return pa.concat_tables([select, phase("report", again, chosen, best, protocol.report.seeds)])


def zoo_row(index: pa.Table, protocol: Protocol) -> ZooRow | None:
    """The scores of the zoo's own policies on the same architectures, on `joint` of the seen; None if it has none.

    They were measured when the zoo was built, on other episodes, of which the index has the means.
    """
    chosen = pc.equal(index["split"], "seen" if protocol.is_joint else protocol.split)
    if not protocol.is_joint:
        chosen = pc.and_(chosen, pc.is_in(index["architecture"], value_set=pa.array(list(protocol.policies))))
    rows = index.filter(chosen)
    if not len(rows):
        return None
    values: dict[str, Floats] = {
        each.column: rows[each.column].to_numpy().astype(np.float64)[:, None] for each in protocol.metrics
    }
    table = Scores(values, np.arange(len(rows)), np.array(rows["architecture"].to_pylist()), np.zeros(1, np.int64))
    estimates, worst = scores.of_means(table, protocol)
    return ZooRow(estimates, worst, len(rows), int(pc.min(rows["episodes"]).as_py()))
