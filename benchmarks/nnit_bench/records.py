"""What a run leaves behind, in a folder of its own; imports no torch, so that results are read anywhere.

    results/<task>/<split>/<method>/<run id>/
        run.json          what was done and what came out
        episodes.parquet  a row per episode, from which every score follows
        policies.parquet  a row per generated policy: its hash, and how far it is from the zoo's

The run id is a hash of everything that determines the episodes, so the same command finds its finished run again. The
record is written as `started` before any work; a run that was cut off stays so until it is taken up again.
"""

from __future__ import annotations

import errno
import hashlib
import json
import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, ValidationError

from nnit_bench.protocol import Protocol
from nnit_bench.provenance import Code, Hardware, installed_packages, this_machine
from nnit_bench.scores import Summary
from nnit_zoo.atomic import write_atomically
from nnit_zoo.errors import UserError

EPISODES, POLICIES, RECORD = "episodes.parquet", "policies.parquet", "run.json"
FINISHED = ("success", "unsupported")
"""The statuses of runs that have nothing left to do."""
STORED_EPISODE_SCHEMA = pa.schema(
    [
        ("method", pa.string()),
        ("training_seed", pa.int64()),  # null for a method that is not trained
        ("sampling_seed", pa.int64()),
        ("task", pa.string()),
        ("task_version", pa.int32()),
        ("split", pa.string()),
        ("architecture", pa.string()),
        ("policy", pa.int32()),
        ("phase", pa.string()),
        ("episode_seed", pa.int64()),
        ("return", pa.float32()),
        ("success_once", pa.bool_()),  # null, like the next, where a task has no notion of success
        ("success_at_end", pa.bool_()),
        ("reason", pa.string()),  # why a policy scored 0 without an episode
    ]
)
"""The columns of episodes.parquet."""


class _Strict(BaseModel):
    """A part of run.json; a field that it does not know is an error."""

    model_config = ConfigDict(extra="forbid")


class Method(_Strict):
    """The generator that was scored."""

    name: str
    config: dict[str, Any]
    """The generator's own settings, as config.json holds them; empty for one that has no checkpoint."""
    given: dict[str, Any]
    """What the command set, on top of the method's defaults: `checkpoint`, `sampling_steps`."""
    training: dict[str, Any]
    """Facts about its training, such as seed, seconds and machine; empty for a method that is not trained."""
    parameters: int | None
    """Numbers in its checkpoint, scales of quantised ones among them."""
    checkpoint_sha256: str | None
    """Of the checkpoint's model.safetensors; null for a generator that is fitted at every run."""
    oracle: bool = False
    """Fitted on the reference policies of the evaluated split: a yardstick, not a method."""

    @property
    def label(self) -> str:
        """The name as tables show it: of a plug-in, its file without the folders."""
        return self.name.rpartition("/")[2]


class ZooVersion(_Strict):
    """The zoo that the generator learned from and is measured against."""

    sha256: str
    """Of its manifest.json, which holds the hash of every shard."""
    policies: int
    """Policies of seen architectures and training seeds: what a generator may learn from."""
    seeds: int
    """Hypernetworks that these come from."""


class Timings(_Strict):
    """Wall-clock seconds of a run's parts."""

    load_or_fit: float
    """Reading the method's checkpoint, or fitting it."""
    sample: float
    novelty: float
    """Comparing the policies with the zoo's."""
    score: float
    """Playing all episodes."""


class Distance(_Strict):
    """How far generated policies are from known ones, and how far policies of held-out seeds are."""

    median: float
    """Over the generated policies: distance to the nearest known one."""
    heldout: float | None
    """Over policies of held-out seeds of the same architectures, the yardstick; null if the zoo has none."""
    ratio: float | None
    """`median` / `heldout`: near 0 for copies, near 1 for policies as new as those of another seed."""


class Novelty(_Strict):
    """Whether the generated policies are new; the distances of each are in policies.parquet."""

    same_architecture: Distance | None
    """Relative L2 to the nearest policy of the same architecture by a corpus seed: a training policy on `seen`,
    elsewhere what a known seed would have been there. Null if the zoo has no policies of these architectures."""
    any_architecture: Distance | None
    """Relative L2, over the blocks that both have, to the nearest training policy of any architecture, with weights in
    units of the root of their fan-in. Null if the zoo has no policies of that depth."""
    actions: Distance | None
    """Root mean square difference of what the policies do on the task's probe states, to the nearest policy of the same
    architecture by a corpus seed. Null if there are none, or the task has no probe states."""
    copies: int
    """Generated policies within 0.1 % (relative L2) of a known one of the same architecture or a training policy."""
    pairwise_l2: float | None
    """Mean L2 distance between generated policies of one architecture; null if no architecture has two."""
    pairwise_cosine: float | None
    """Mean cosine similarity between generated policies of one architecture."""


HISTORY: Any = {"method": {"training": True, "given": {"checkpoint"}}}
"""What an identity leaves out: how a method came to be what it is; its checkpoint's hash says what it is."""


class Identity(BaseModel):
    """Everything that determines a run's episodes; the number of worker processes does not."""

    protocol: Protocol
    method: Method
    zoo_sha256: str
    code_sha256: str
    packages: dict[str, str]

    @property
    def run_id(self) -> str:
        """The first 12 hexadecimal digits of the hash of all fields, but for HISTORY."""
        text = json.dumps(self.model_dump(mode="json", exclude=HISTORY), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def folder(self, output: Path) -> Path:
        """Where the run belongs under the results folder."""
        return output / self.protocol.task / self.protocol.split / folder_name(self.method.name) / self.run_id


class RunRecord(_Strict):
    """The content of run.json."""

    schema_version: Literal[1] = 1
    run_id: str
    status: Literal["started", "success", "failed", "unsupported"] = "started"
    """`unsupported`: the method cannot make what the split asks for; that is no failure, and no row of zeros."""
    error: str | None = None
    """In words, why there are no results."""
    started: datetime
    finished: datetime | None = None
    protocol: Protocol
    method: Method
    zoo: ZooVersion
    code: Code
    packages: dict[str, str]
    """Name and version of everything installed."""
    hardware: Hardware
    resumed: bool = False
    """Whether it was interrupted: `timings` are then of what was left to do."""
    timings: Timings | None = None
    results: Summary | None = None
    """Computed from the episodes."""
    novelty: Novelty | None = None

    @classmethod
    def start(cls, identity: Identity, zoo: ZooVersion, code: Code) -> RunRecord:
        """The record of a run that begins now, on this machine."""
        return cls(
            run_id=identity.run_id,
            started=datetime.now(UTC),
            protocol=identity.protocol,
            method=identity.method,
            zoo=zoo,
            code=code,
            packages=installed_packages(),
            hardware=this_machine(),
        )

    @classmethod
    def read(cls, folder: Path) -> RunRecord:
        """The record in a run folder; raises UserError if it is missing or damaged."""
        try:
            return cls.model_validate_json((folder / RECORD).read_text())
        except (FileNotFoundError, NotADirectoryError):
            raise UserError(f"no {RECORD} in {folder}") from None
        except (ValidationError, UnicodeDecodeError) as error:
            problem = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
            raise UserError(f"{folder / RECORD} is damaged, or from another version of nnit: {problem}") from None

    def write(self, folder: Path) -> None:
        """Write run.json; the file is either the old one or the new one at any moment."""
        content = self.model_dump_json(indent=2) + "\n"
        _write(folder / RECORD, lambda path: path.write_text(content))

    def finish(
        self,
        folder: Path,
        episodes: pa.Table,
        policies: pa.Table,
        *,
        timings: Timings,
        results: Summary,
        novelty: Novelty,
    ) -> RunRecord:
        """Write the tables, then the record with status `success`; returns that record."""
        _write_table(folder / EPISODES, episodes.cast(STORED_EPISODE_SCHEMA))
        _write_table(folder / POLICIES, policies)
        return self._close(folder, status="success", timings=timings, results=results, novelty=novelty)

    def stop(self, folder: Path, status: Literal["failed", "unsupported"], reason: str) -> RunRecord:
        """Write the record with a status that has no results, and why; returns that record."""
        return self._close(folder, status=status, error=reason)

    def _close(self, folder: Path, **changes: Any) -> RunRecord:
        record = self.model_copy(update={"finished": datetime.now(UTC), **changes})
        record.write(folder)
        return record


def json_schema() -> str:
    """The JSON Schema of run.json, as committed in schema/run.schema.json."""
    return json.dumps(RunRecord.model_json_schema(mode="serialization"), indent=2) + "\n"


def folder_name(method: str) -> str:
    """A method's name as part of a path: a plug-in's is an address, such as path/to/file.py:Class."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", method).strip("-.")


def _write(path: Path, write: Callable[[Path], object]) -> None:
    try:
        write_atomically(path, write)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        problem = "no space left" if full else f"cannot write ({error.strerror})"
        advice = "make room, or choose another folder with --output"
        raise UserError(f"{problem} in {path.parent}; {advice}") from None


def _write_table(path: Path, table: pa.Table) -> None:
    _write(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))


def read_episodes(folder: Path) -> pa.Table:
    """The episode table in a run folder; raises UserError if it is missing or damaged."""
    try:
        return pq.ParquetFile(folder / EPISODES).read()
    except (OSError, pa.ArrowInvalid) as error:
        raise UserError(f"{folder / EPISODES} is missing or damaged: {error}") from None
