"""What a run leaves behind: `run.json`, which says what was done, and `episodes.parquet`, with a row per episode.

    results/<task>/<split>/<method>/<run id>/

The run id is a hash of everything that determines the episodes, so the same command finds its finished run again. The
record is written as `started` before any work; a run that was cut off stays so until it is repeated.
"""

from __future__ import annotations

import errno
import hashlib
import inspect
import json
import os
import platform
import re
import subprocess
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, ValidationError

from nnit_baselines.generator import Generator
from nnit_bench.protocol import Protocol
from nnit_bench.statistics import Summary
from nnit_zoo.build.files import write_atomically
from nnit_zoo.errors import UserError
from nnit_zoo.files import sha256_of

EPISODES = "episodes.parquet"
RECORD = "run.json"
EPISODE_SCHEMA = pa.schema(
    [
        ("method", pa.string()),
        ("task", pa.string()),
        ("split", pa.string()),
        ("architecture", pa.string()),
        ("policy", pa.int32()),
        ("phase", pa.string()),
        ("seed", pa.int64()),
        ("return", pa.float32()),
        ("success_once", pa.bool_()),
        ("success_at_end", pa.bool_()),
        ("reason", pa.string()),
    ]
)
OUR_PACKAGES = ("nnit_zoo", "nnit_baselines", "nnit_bench")
# The packages whose versions can change a number; the record lists all that are installed.
NUMERIC_PACKAGES = ("torch", "numpy", "mani_skill", "sapien")


class Method(BaseModel):
    """The generator that was scored."""

    model_config = ConfigDict(extra="forbid")

    name: str
    config: dict[str, Any]
    """The generator's own settings, as config.json holds them; empty for one that has no checkpoint."""
    checkpoint_sha256: str | None
    """Of the checkpoint's model.safetensors; null for a generator that is fitted at every run."""


class Code(BaseModel):
    """The code that ran."""

    sha256: str
    """Of the source files of nnit_zoo, nnit_baselines and nnit_bench, and of a method given as a file."""
    commit: str | None
    dirty: bool | None
    """Whether the checkout had changes that are not in `commit`; both are null outside a checkout."""


class Hardware(BaseModel):
    """The machine that ran it."""

    machine: str
    processor: str
    cores: int
    memory_gib: float


class Timings(BaseModel):
    """Wall-clock seconds of a run's parts."""

    load_or_fit: float
    sample: float
    score: float


class Identity(BaseModel):
    """Everything that determines a run's episodes; the number of worker processes does not."""

    protocol: Protocol
    method: Method
    zoo_sha256: str
    code_sha256: str
    packages: dict[str, str]

    @property
    def run_id(self) -> str:
        """The first 12 hexadecimal digits of the hash of all fields."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def folder(self, output: Path) -> Path:
        """Where the run belongs under the results folder."""
        return _folder(output, self.protocol, self.method.name, self.run_id)


class RunRecord(BaseModel):
    """The content of run.json."""

    model_config = ConfigDict(extra="forbid")

    schema_version: Literal[1] = 1
    run_id: str
    status: Literal["started", "success", "failed"] = "started"
    error: str | None = None
    """In words, if the status is `failed`."""
    started: datetime
    finished: datetime | None = None
    protocol: Protocol
    method: Method
    zoo_sha256: str
    """Of the zoo's manifest.json, which holds the hash of every shard."""
    code: Code
    packages: dict[str, str]
    hardware: Hardware
    timings: Timings | None = None
    results: dict[str, Any] | None = None
    """The table row, computed from the episodes: estimates[metric][statistic] = {value, low, high}."""

    @classmethod
    def start(cls, identity: Identity, code: Code) -> RunRecord:
        """The record of a run that begins now, on this machine."""
        return cls(
            run_id=identity.run_id,
            started=datetime.now(UTC),
            protocol=identity.protocol,
            method=identity.method,
            zoo_sha256=identity.zoo_sha256,
            code=code,
            packages=installed_packages(),
            hardware=this_machine(),
        )

    @classmethod
    def read(cls, folder: Path) -> RunRecord:
        """The record in a run folder; raises UserError if it is missing or damaged."""
        try:
            return cls.model_validate_json((folder / RECORD).read_text())
        except FileNotFoundError:
            raise UserError(f"no {RECORD} in {folder}") from None
        except (ValidationError, UnicodeDecodeError) as error:
            raise UserError(f"{folder / RECORD} is damaged, or from another version of nnit: {error}") from None

    def folder(self, output: Path) -> Path:
        """Where the run belongs under the results folder."""
        return _folder(output, self.protocol, self.method.name, self.run_id)

    def write(self, output: Path) -> None:
        """Write run.json; the file is either the old one or the new one at any moment."""
        content = self.model_dump_json(indent=2) + "\n"
        _write(self.folder(output) / RECORD, lambda path: path.write_text(content))

    def finish(self, output: Path, episodes: pa.Table, timings: Timings, summary: Summary) -> RunRecord:
        """Write the episodes, then the record with status `success`; returns that record."""
        table = episodes.cast(EPISODE_SCHEMA)
        _write(self.folder(output) / EPISODES, lambda path: pq.write_table(table, path, compression="zstd"))
        changes = {
            "status": "success",
            "finished": datetime.now(UTC),
            "timings": timings,
            "results": plain(summary),
        }
        record = self.model_copy(update=changes)
        record.write(output)
        return record

    def fail(self, output: Path, error: BaseException) -> None:
        """Write the record with status `failed` and what went wrong."""
        text = str(error) or type(error).__name__
        changes = {"status": "failed", "finished": datetime.now(UTC), "error": text}
        self.model_copy(update=changes).write(output)


def _folder(output: Path, protocol: Protocol, method: str, run_id: str) -> Path:
    return output / protocol.task / protocol.split / folder_name(method) / run_id


def folder_name(method: str) -> str:
    """A method's name as part of a path: a plug-in's is an address, such as path/to/file.py:Class."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", method).strip("-.")


def _write(path: Path, write: Callable[[Path], object]) -> None:
    def fill(temporary: Path) -> None:
        write(temporary)

    try:
        write_atomically(path, fill)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        problem = "no space left" if full else f"cannot write ({error.strerror})"
        advice = "make room, or choose another folder with --output"
        raise UserError(f"{problem} in {path.parent}; {advice}") from None


def plain(summary: Summary) -> dict[str, Any]:
    """A table row as JSON holds it: estimates[metric][statistic] = {value, low, high}."""
    estimates = {
        metric: {name: estimate._asdict() for name, estimate in statistics.items()}
        for metric, statistics in summary.estimates.items()
    }
    return {**summary._asdict(), "estimates": estimates}


def read_episodes(folder: Path) -> pa.Table:
    """The episode table in a run folder."""
    return pq.ParquetFile(folder / EPISODES).read()


def installed_packages() -> dict[str, str]:
    """Name and version of every installed package."""
    versions = {each.metadata["Name"]: each.version for each in distributions()}
    return dict(sorted(versions.items(), key=lambda item: item[0].lower()))


def numeric_packages() -> dict[str, str]:
    """Name and version of the installed packages that can change a number."""
    found: dict[str, str] = {}
    for name in NUMERIC_PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def hash_files(files: Mapping[str, Path]) -> str:
    """SHA-256 over names and contents, in the order of the names."""
    total = hashlib.sha256()
    for name in sorted(files):
        total.update(f"{name} {sha256_of(files[name])}\n".encode())
    return total.hexdigest()


def this_code(method: type[Generator]) -> Code:
    """The code that is running, with the file of a method if that is not one of ours."""
    files: dict[str, Path] = {}
    if method.__module__.partition(".")[0] not in OUR_PACKAGES:
        files["method"] = Path(inspect.getfile(method.sample))
    for package in OUR_PACKAGES:
        spec = find_spec(package)
        assert spec is not None and spec.origin is not None
        root = Path(spec.origin).parent
        files |= {f"{package}/{path.relative_to(root)}": path for path in root.rglob("*.py")}
    code = Code(sha256=hash_files(files), commit=None, dirty=None)
    # A package installed inside somebody else's checkout is not that checkout's code: ask whether git tracks this file.
    if _git("ls-files", "--error-unmatch", __file__) is None:
        return code
    return code.model_copy(update={"commit": _git("rev-parse", "HEAD"), "dirty": bool(_git("status", "--porcelain"))})


def _git(*arguments: str) -> str | None:
    """What git says in the folder of this file; None if that is not a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  fixed words
    except FileNotFoundError:
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None


def this_machine() -> Hardware:
    """What this process runs on; memory in GiB."""
    processor = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        match = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text())
        processor = match.group(1) if match else processor
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return Hardware(
        machine=f"{platform.system()} {platform.machine()}",
        processor=processor,
        cores=os.cpu_count() or 1,
        memory_gib=round(memory, 1),
    )
