"""Stored runs: found in folders of results, read without torch."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated

import pyarrow as pa
from cyclopts import Parameter

from nnit_bench import scores
from nnit_bench.protocol import architectures, policies_per_architecture
from nnit_bench.records import FINISHED, RECORD, RunRecord, read_episodes
from nnit_bench.scores import Summary
from nnit_zoo import tasks
from nnit_zoo.errors import UserError, unknown_name

SHIPPED = Path(__file__).resolve().parents[2] / "leaderboard" / "results"
"""The runs that ship with the project, in a checkout; an installed package has none."""
FOLDERS = (Path("results"), SHIPPED)
"""Where runs are looked for: those made here, and those that ship with the project."""
Folders = Annotated[
    tuple[Path, ...],
    Parameter(
        name="--results",
        show_default=lambda paths: "results, and the project's" if paths == FOLDERS else ", ".join(map(str, paths)),
    ),
]


@dataclass(frozen=True)
class StoredRun:
    """A finished run in its folder."""

    record: RunRecord
    folder: Path

    @cached_property
    def episodes(self) -> pa.Table:
        """The run's episodes; raises UserError if they are missing or damaged."""
        return read_episodes(self.folder)

    @cached_property
    def summary(self) -> Summary | None:
        """The run's statistics, computed anew: runs of different versions of nnit are summarised alike.

        None if it has none; raises UserError as `episodes` does.
        """
        return scores.summarise(self.episodes, self.record.protocol) if self.record.results else None

    @property
    def is_shipped(self) -> bool:
        """Whether it ships with the project."""
        return self.folder.resolve().is_relative_to(SHIPPED)

    @property
    def is_whole(self) -> bool:
        """Whether it is of the split as the benchmark defines it, with all its policies."""
        protocol = self.record.protocol
        return protocol.policies == policies_per_architecture(protocol.split)

    @property
    def departures(self) -> tuple[str, ...]:
        """Which of its settings are not the benchmark's, in words; numbers of policies and episodes apart."""
        protocol, words = self.record.protocol, []
        if protocol.simulator not in (None, "fast"):
            words.append(f"on {protocol.simulator}")
        if protocol.selection != "heldout":
            words.append(f"protocol {protocol.selection}")
        if protocol.seed != 0:
            words.append(f"seed {protocol.seed}")
        if steps := self.record.method.given.get("sampling_steps"):
            words.append(f"{steps} sampling steps")
        return tuple(words)

    @property
    def given(self) -> tuple[str, ...]:
        """What the command gave it, in words: departures from the benchmark, and a checkpoint, which is none."""
        checkpoint = self.record.method.given.get("checkpoint")
        return (*self.departures, f"checkpoint {checkpoint}") if checkpoint else self.departures


def find(folders: Iterable[Path]) -> list[StoredRun]:
    """The finished runs below some folders, oldest first; a record that cannot be read is left out with a warning."""
    found = []
    for path in sorted({each.resolve() for folder in folders for each in folder.rglob(RECORD)}):
        try:
            record = RunRecord.read(path.parent)
        except UserError as error:
            sys.stderr.write(f"warning: left out: {error}\n")
            continue
        if record.status in FINISHED:
            found.append(StoredRun(record, path.parent))
    return sorted(found, key=lambda run: (run.record.started, str(run.folder)))


def latest(runs: Iterable[StoredRun]) -> dict[tuple[str, str, str], StoredRun]:
    """(task, split, method) -> its run.

    In this order: one with results, a whole one, with the benchmark's settings (whatever its checkpoint), of the newest
    version of the task, of the most episodes, the newest, one's own.
    """

    def rank(run: StoredRun) -> tuple[bool, bool, bool, int, int, datetime, bool]:
        protocol = run.record.protocol
        newest = protocol.task_version, protocol.select.count, run.record.started
        return run.record.results is not None, run.is_whole, not run.departures, *newest, not run.is_shipped

    ranked = sorted(runs, key=rank)
    return {(run.record.protocol.task, run.record.protocol.split, run.record.method.name): run for run in ranked}


def resolve(name: str, runs: Sequence[StoredRun], task: str, split: str) -> StoredRun:
    """The run in the folder `name`, or the latest one of the method `name`.

    Raises UserError, with the command that makes it, if there is none.
    """
    if (Path(name) / RECORD).is_file():
        record = RunRecord.read(Path(name))
        if record.status != "success":
            raise UserError(f"the run in {name} has no results: it is '{record.status}'")
        return StoredRun(record, Path(name))
    mine = [run for run in runs if run.record.method.name == name and run.record.status == "success"]
    found = latest(mine).get((task, split, name))
    if found is None:
        if "/" in name and ":" not in name:
            raise UserError(f"no run in {name}: there is no {RECORD}")
        if task not in {run.record.protocol.task for run in runs}:
            tasks.get(task)  # a wrong name is told
        architectures(split)
        methods = {run.record.method.name for run in runs}
        if name not in methods and "/" not in name and ":" not in name:
            raise UserError(
                f"{unknown_name('stored method', name, methods)}; make it with: {command(name, task, split)}"
            )
        raise UserError(f"no stored run of {name} on {task}, {split}; make one with: {command(name, task, split)}")
    return found


def command(method: str, task: str, split: str) -> str:
    """The command that makes the run of a method; two, if it has to be trained first."""
    from nnit_baselines import registry  # noqa: PLC0415  imports torch, which stored runs do not need

    run = f"nnit-bench run --method {method} --task {task} --split {split}"
    if method not in registry.BUILT_IN or registry.is_ready(method, task):
        return run
    return f"nnit-bench train --method {method} --task {task}, then {run} --checkpoint runs/{method}/{task}"
