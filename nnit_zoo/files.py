"""The files of a zoo: what they are called, what they promise, and whether they hold it; imports no torch.

A zoo folder holds `index.parquet` (a row per policy), one safetensors shard per architecture and `manifest.json` with
the size and SHA-256 of each of them. The data folder of a task, in the package, holds the same index and manifest
beside the GHNs from which the shards are made, and `selection.parquet`, a row per candidate.
"""

from __future__ import annotations

import errno
import hashlib
import io
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Annotated, Literal

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import BaseModel, Field, ValidationError
from rich.filesize import decimal

from nnit_zoo import architecture as known
from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError, unknown_name

SPLITS = (*known.SPLITS, "heldout_seed")
SCORES = ("success_at_end", "success_once", "return")
Progress = Callable[[int], None]
INDEX = "index.parquet"
MANIFEST = "manifest.json"
EXPERT = "expert.safetensors"
GHNS = "ghns.safetensors"
SELECTION = "selection.parquet"
CANDIDATE_EPISODES = "scores.parquet"
HELDOUT_SEEDS_FROM = 128
_ANEW = "download the zoo anew, or if it is nnit's own, install nnit again"
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


def policy_split(split: str, ghn_seed: int) -> str:
    """The split of the policy that a GHN makes for an architecture of `split`: `heldout_seed` for seeds from 128 on."""
    return "heldout_seed" if ghn_seed >= HELDOUT_SEEDS_FROM else split


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

    What is there already is not written again: the disk may be full, or read-only.
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
    for name, content in ((INDEX, index), (MANIFEST, manifest.to_bytes())):
        if not Entry.of(content).describes(target / name):
            _write(target / name, content, unwritten)


def _write(path: Path, content: bytes, needed: int) -> None:
    """Write a file of a zoo, with advice if that fails; `needed` is what remains to be written, in bytes."""
    try:
        write_bytes(path, content)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                f"no space left in {path.parent}: {needed} bytes ({decimal(needed)}) are still to be written; "
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
    """The rows of an index file, of one architecture if given; raises UserError if its columns are not INDEX_SCHEMA."""
    name = path if isinstance(path, Path) else INDEX
    try:
        table = pq.ParquetFile(path).read()
    except (pa.ArrowException, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise UserError(f"{name} is not a Parquet file, so no index of a zoo; {_ANEW}") from None
    if not table.schema.equals(INDEX_SCHEMA):
        raise UserError(f"{name} has other columns than {', '.join(INDEX_SCHEMA.names)}; {_ANEW}")
    return table if architecture is None else table.filter(pc.equal(table["architecture"], architecture))
