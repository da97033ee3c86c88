"""Where a zoo's files lie, what they promise, and whether they hold it; imports no torch.

A zoo folder holds `index.parquet` (a row per policy), one safetensors shard per architecture and `manifest.json` with
the size and SHA-256 of each of them. The embedded folder of a task, in the package, holds the same index and manifest
beside the GHNs from which the shards are made, and `selection.parquet`, a row per candidate.
"""

from __future__ import annotations

import errno
import hashlib
import io
import shlex
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from huggingface_hub import cached_assets_path
from pydantic import BaseModel, Field, ValidationError

from nnit_zoo import architecture as known
from nnit_zoo import tasks
from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError, unknown_name

SPLITS = (*known.SPLITS, "heldout_seed")
SCORES = ("success_at_end", "success_once", "return")
Progress = Callable[[int], None]
EMBEDDED = Path(__file__).parent / "data"
INDEX = "index.parquet"
MANIFEST = "manifest.json"
EXPERT = "expert.safetensors"
GHNS = "ghns.safetensors"
SELECTION = "selection.parquet"
CANDIDATE_EPISODES = "scores.parquet"
HELDOUT_SEEDS_FROM = 128
INDEX_SCHEMA = pa.schema(
    [
        ("id", pa.string()),
        ("task", pa.string()),
        ("architecture", pa.string()),
        ("ghn_seed", pa.int32()),
        ("split", pa.string()),
        ("success_once", pa.float64()),
        ("success_at_end", pa.float64()),
        ("return", pa.float64()),
        ("episodes", pa.int32()),
        ("shard", pa.string()),
        ("row", pa.int32()),
        ("sha256", pa.string()),
        ("n_params", pa.int32()),
        ("weight_norm", pa.float32()),
    ]
)
ADDED = ("n_params", "weight_norm")  # columns that the index of an older zoo may lack: they are null then


class Entry(BaseModel):
    """What the manifest promises of one file; `size` in bytes."""

    sha256: str
    size: int = Field(alias="bytes")

    @classmethod
    def of(cls, content: bytes) -> Entry:
        """The entry that `content` fulfils."""
        return cls(sha256=hashlib.sha256(content).hexdigest(), bytes=len(content))

    def describes(self, path: Path) -> bool:
        """Whether `path` is a file with this size and SHA-256."""
        return path.is_file() and path.stat().st_size == self.size and sha256_of(path) == self.sha256


class Manifest(BaseModel):
    """manifest.json of a zoo: its task, the network sizes, and an entry per file."""

    format: Literal[1] = 1
    task: str
    inputs: int
    outputs: int
    index: Entry
    shards: dict[Annotated[str, Field(pattern=r"^\d+(-\d+)*\.safetensors$")], Entry]
    standardisation: str | None = None
    """Hash of what the policies' observations are standardised by, `Task.standardisation`; an older zoo has none."""

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """The manifest in `folder`; raises UserError if there is none or it cannot be understood."""
        path = folder / MANIFEST
        try:
            return cls.model_validate_json(path.read_text())
        except (FileNotFoundError, NotADirectoryError):
            raise UserError(
                f"no zoo in {folder}; make one with: nnit-zoo download --task TASK --folder {folder}"
            ) from None
        except (ValidationError, UnicodeDecodeError):
            raise UserError(
                f"{path} is damaged, or of another version of nnit; nnit-zoo download makes it again"
            ) from None

    def to_bytes(self) -> bytes:
        """The content of manifest.json, the same bytes for the same manifest."""
        return (self.model_dump_json(indent=2, by_alias=True, exclude_none=True) + "\n").encode()

    def missing(self, folder: Path, names: Collection[str]) -> dict[str, Entry]:
        """Of these files, those that `folder` lacks or holds in another form."""
        wanted = ((name, entry) for name, entry in self.files.items() if name in names)
        return {name: entry for name, entry in wanted if not entry.describes(folder / name)}

    @property
    def files(self) -> dict[str, Entry]:
        """The entry of each file: the shards and the index."""
        return {**self.shards, INDEX: self.index}

    @property
    def size(self) -> int:
        """Size of all files that the manifest lists, in bytes."""
        return sum(entry.size for entry in self.files.values())


def fill(
    target: Path,
    manifest: Manifest,
    index: bytes,
    produce: Callable[[Collection[str]], Iterator[tuple[str, bytes]]],
    *,
    splits: Collection[str],
    progress: Progress | None,
    advice: str,
) -> None:
    """Write the shards of these splits that `target` lacks, then the index, then, as the mark of a zoo, the manifest.

    `produce` gives name and content of each shard that it is asked for. `progress` is called with the number of newly
    finished shards. May be killed and run again, also by two processes at once. Raises UserError if the disk is full,
    the folder cannot be written, or, with this `advice`, a content is not what the manifest promises.
    """
    wanted = shards_of(read_index(io.BytesIO(index)), splits)
    missing = manifest.missing(target, wanted)
    if progress:
        progress(len(wanted) - len(missing))
    unwritten = sum(entry.size for entry in missing.values()) + len(index)
    for name, content in produce(missing.keys()) if missing else ():
        if Entry.of(content) != missing[name]:
            raise UserError(f"{name} is not what the manifest promises: {advice}")
        _write(target / name, content, unwritten)
        unwritten -= len(content)
        if progress:
            progress(1)
    _write(target / INDEX, index, unwritten)
    _write(target / MANIFEST, manifest.to_bytes(), unwritten)


def _write(path: Path, content: bytes, needed: int) -> None:
    """Write a file of a zoo, with advice if that fails; `needed` is what remains to be written, in bytes."""
    try:
        write_bytes(path, content)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                f"no space left in {path.parent}: {needed} bytes ({readable(needed)}) are still to be written; "
                "make room and run the same command again, or choose another folder with --folder"
            ) from None
        raise UserError(
            f"cannot write in {path.parent} ({error.strerror}); choose another folder with --folder"
        ) from None


def shards_of(index: pa.Table, splits: Collection[str]) -> set[str]:
    """The names of the shards that hold policies of these splits; raises UserError for an unknown split."""
    for split in splits:
        if split not in SPLITS:
            raise unknown_name("split", split, SPLITS)
    rows = index.filter(pc.is_in(index["split"], pa.array(splits, pa.string())))
    return set(pc.unique(rows["shard"]).to_pylist())


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal text."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_index(path: Path | io.BytesIO, architecture: str | None = None) -> pa.Table:
    """The rows of an index file, of one architecture if given; columns as in INDEX_SCHEMA."""
    table = pq.ParquetFile(path).read()
    for name in ADDED:
        if name not in table.column_names:
            field = INDEX_SCHEMA.field(name)
            table = table.append_column(field, pa.nulls(len(table), field.type))
    return table if architecture is None else table.filter(pc.equal(table["architecture"], architecture))


def summary(index: pa.Table) -> dict[str, dict[str, Any]]:
    """Per split its numbers of architectures and policies and the mean scores of these, None where a task has none."""
    counts = [("architecture", "count_distinct"), ("id", "count"), *((score, "mean") for score in SCORES)]
    rows = index.group_by("split", use_threads=False).aggregate(counts).to_pylist()
    return {
        row["split"]: {
            "architectures": row["architecture_count_distinct"],
            "policies": row["id_count"],
            **{score: row[f"{score}_mean"] for score in SCORES},
        }
        for row in sorted(rows, key=lambda row: SPLITS.index(row["split"]))
    }


def pass_rates(selection: Path) -> dict[str, float]:
    """Per seen architecture, the share of its candidates for the corpus that reach the task's thresholds.

    Empty for an older zoo, which does not say.
    """
    table = pq.ParquetFile(selection).read()
    if "passed" not in table.column_names:
        return {}
    candidates = (pc.field("split") == "seen") & (pc.field("ghn_seed") < HELDOUT_SEEDS_FROM)
    rows = table.filter(candidates).group_by("architecture", use_threads=False).aggregate([("passed", "mean")])
    return dict(zip(rows["architecture"].to_pylist(), rows["passed_mean"].to_pylist(), strict=True))


def ghns_of(selection: Path) -> int:
    """The number of GHNs that made the candidates."""
    return len(pc.unique(pq.ParquetFile(selection).read(["ghn_seed"])["ghn_seed"]))


def tasks_with_zoo() -> tuple[str, ...]:
    """The tasks whose zoo is embedded in this package."""
    return tuple(sorted(path.parent.name for path in EMBEDDED.glob(f"*/{MANIFEST}")))


def embedded(task: str) -> Path:
    """The folder with the task's embedded zoo; raises UserError, with the command or near names, if there is none."""
    if task not in tasks_with_zoo():
        if task in tasks.names():
            raise UserError(f"{task} has no zoo yet; build it with: nnit-zoo build --task {task}")
        raise unknown_name("zoo", task, tasks_with_zoo())
    return EMBEDDED / task


def describe(task: str) -> dict[str, Any]:
    """What there is to say of an embedded zoo: sizes, where it lies, how much of it is there, and its summary."""
    manifest = Manifest.read(embedded(task))
    index = read_index(embedded(task) / INDEX)
    place = default_folder(task)
    ours = (place / MANIFEST).is_file() and Manifest.read(place) == manifest
    return {
        "task": task,
        "inputs": manifest.inputs,
        "outputs": manifest.outputs,
        "policies": index.num_rows,
        "bytes": manifest.size,
        "folder": str(place),
        "shards": len(manifest.shards),
        "shards_downloaded": sum((place / name).is_file() for name in manifest.shards) if ours else 0,
        "splits": summary(index),
        "pass_rates": pass_rates(embedded(task) / SELECTION),
    }


def default_folder(task: str) -> Path:
    """Where `nnit-zoo download` puts the task's zoo: in the assets cache of huggingface_hub (HF_HOME moves it).

    Raises UserError if that folder cannot be made.
    """
    try:
        return cached_assets_path("nnit", "zoo", task)
    except (OSError, ValueError) as error:
        raise UserError(f"no cache folder for zoos ({error}); set HF_HOME to a folder that you can write") from None


def download_command(task: str, folder: Path) -> str:
    """The command that makes the zoo in `folder`, or mends it."""
    where = "" if folder.resolve() == default_folder(task) else f" --folder {shlex.quote(str(folder))}"
    return f"nnit-zoo download --task {task}{where}"


def readable(size: int) -> str:
    """A number of bytes for people: `17.2 MB`."""
    value, unit = float(size), "B"
    for larger in ("kB", "MB", "GB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.1f} {unit}" if unit != "B" else f"{size} B"


def free_bytes(folder: Path) -> int:
    """Free space, in bytes, on the disk that holds `folder` or would hold it."""
    existing = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    return shutil.disk_usage(existing).free
