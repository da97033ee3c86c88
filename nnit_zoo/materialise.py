"""Make a zoo's shards from its embedded GHNs: the same bytes on every machine, proved by the manifest.

The GHNs decode in float64 and every parameter is rounded once to float16. Thread counts, processors and versions of
BLAS sum in different orders, which moves a float64 parameter by about 1e-16; its float16 bytes only change if that
carries it across a rounding tie. `write_manifest` refuses a zoo with a parameter that close to one, so none does.
"""

from __future__ import annotations

import errno
import io
import json
import struct
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from safetensors import SafetensorError, safe_open

from nnit_zoo import files
from nnit_zoo.architecture import Architecture
from nnit_zoo.build.files import write_atomically
from nnit_zoo.build.ghn import GHN
from nnit_zoo.errors import UserError
from nnit_zoo.files import Entry, Manifest
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.zoo import HELDOUT_SEEDS_FROM, SPLITS, policy_hashes

GHNS = "ghns.safetensors"
SELECTION = "selection.parquet"
TIE_MARGIN = 1e-14


def materialise(data_folder: Path, target: Path, progress: Callable[[int], None] | None = None) -> None:
    """Write the zoo that `data_folder` embeds to `target`; shards that are there already are kept.

    `progress` is called with the number of newly finished shards. May be killed and run again, also by two processes
    at once. Raises UserError if the disk is full, the folder cannot be written, or a shard comes out different from
    the manifest.
    """
    manifest = Manifest.read(data_folder)
    index = (data_folder / files.INDEX).read_bytes()
    tell = progress or (lambda shards: None)
    missing = manifest.shards.keys() & manifest.missing(target).keys()
    tell(len(manifest.shards) - len(missing))
    source = _Source(data_folder)
    for architecture in source.rows:
        name = _shard_name(architecture)
        if name in missing:
            content = _serialise(_round(source.decode(architecture)), source.task)
            _check_promised(content, manifest.shards[name], target / name)
            _write(target / name, content, manifest)
            tell(1)
    _write(target / files.INDEX, index, manifest)
    _write(target / files.MANIFEST, manifest.to_bytes(), manifest)  # last: it says that the zoo is complete


def write_manifest(data_folder: Path) -> None:
    """Write index.parquet and manifest.json beside the GHNs and the selection table that they follow from.

    Raises UserError if a kept policy has a parameter that is not finite in float16, or within TIE_MARGIN of a rounding
    tie, where machines could disagree.
    """
    source = _Source(data_folder)
    shards, index = {}, []
    for architecture, rows in source.rows.items():
        exact, ids = source.decode(architecture), source.ids(architecture)
        batch = _round(exact)
        _check_faithful(exact, batch, ids)
        name = _shard_name(architecture)
        shards[name] = Entry.of(_serialise(batch, source.task))
        stored = zip(rows, ids, policy_hashes(batch), strict=True)
        index += [
            {**row, "id": id_, "task": source.task, "shard": name, "row": number, "sha256": sha256}
            for number, (row, id_, sha256) in enumerate(stored)
        ]
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(index, files.INDEX_SCHEMA), buffer, compression="zstd")
    manifest = Manifest(
        task=source.task,
        inputs=source.inputs,
        outputs=source.outputs,
        index=Entry.of(buffer.getvalue()),
        shards=shards,
    )
    _put(data_folder / files.INDEX, buffer.getvalue())
    _put(data_folder / files.MANIFEST, manifest.to_bytes())


def stored(ghn: GHN, architecture: Architecture) -> PolicyBatch:
    """The GHN's policy as a zoo stores it: the GHN in float16, decoded in float64, rounded once to float16."""
    return _round(deepcopy(ghn).half().double().emit(architecture))


class _Source:
    """The GHNs of a data folder and the rows of the policies to be kept, per architecture and by GHN seed."""

    def __init__(self, data_folder: Path) -> None:
        try:
            with safe_open(data_folder / GHNS, framework="pt") as file:
                metadata = json.loads(file.metadata()["nnit"])
                stacked = {name: file.get_tensor(name).double() for name in sorted(file.keys())}
        except (SafetensorError, OSError) as error:
            raise UserError(f"{data_folder / GHNS} is missing or damaged ({error}); install nnit again") from None
        self.task: str = metadata["task"]
        self.inputs: int = metadata["inputs"]
        self.outputs: int = metadata["outputs"]
        self._ghns = {}
        for number, seed in enumerate(metadata["ghn_seeds"]):
            state = {name: tensor[number] for name, tensor in stacked.items()}
            self._ghns[seed] = GHN.from_state(self.inputs, self.outputs, state).double()
        self.rows = self._kept_rows(data_folder / SELECTION)

    def _kept_rows(self, selection: Path) -> dict[Architecture, list[dict[str, Any]]]:
        candidates = pq.ParquetFile(selection).read().to_pylist()
        kept = [row for row in candidates if row["kept"]]
        kept.sort(key=lambda row: (SPLITS.index(row["split"]), row["architecture"], row["ghn_seed"]))
        grouped: dict[Architecture, list[dict[str, Any]]] = {}
        for row in kept:
            if row["ghn_seed"] >= HELDOUT_SEEDS_FROM:
                row["split"] = "heldout_seed"
            architecture = Architecture.parse(row["architecture"], self.inputs, self.outputs)
            grouped.setdefault(architecture, []).append(row)
        return grouped

    def ids(self, architecture: Architecture) -> list[str]:
        return [f"{self.task}/{architecture}/{row['ghn_seed']:03d}" for row in self.rows[architecture]]

    def decode(self, architecture: Architecture) -> PolicyBatch:
        """The kept policies of an architecture in float64."""
        return concatenate(self._ghns[row["ghn_seed"]].emit(architecture) for row in self.rows[architecture])


def _round(exact: PolicyBatch) -> PolicyBatch:
    """The nearest float16 parameters; by numpy, as torch would go by way of float32 and round twice."""
    with np.errstate(over="ignore"):
        layers = tuple(torch.from_numpy(layer.numpy().astype(np.float16)) for layer in exact.layers)
    return PolicyBatch(exact.architecture, layers)


def _check_faithful(exact: PolicyBatch, batch: PolicyBatch, ids: list[str]) -> None:
    """Raise UserError for a policy that is not finite in float16, or that machines could round differently."""
    if not batch.finite().all():
        raise UserError(f"{ids[int(batch.finite().int().argmin())]} is not finite in float16: do not keep it")
    values, nearest = exact.flat().numpy(), batch.flat().numpy()
    for side in (np.inf, -np.inf):
        neighbour = np.nextafter(nearest, np.float16(side)).astype(np.float64)
        close = np.abs((nearest + neighbour) / 2 - values).min(axis=1) < TIE_MARGIN
        if close.any():
            raise UserError(f"{ids[int(close.argmax())]} has a parameter on a rounding tie of float16: do not keep it")


def _serialise(batch: PolicyBatch, task: str) -> bytes:
    """A shard's bytes in the safetensors format; written here because safetensors' own order of metadata is random."""
    architecture = batch.architecture
    sizes = {"inputs": str(architecture.inputs), "outputs": str(architecture.outputs)}
    header: dict[str, Any] = {"__metadata__": {"task": task, "architecture": str(architecture), **sizes}}
    content = b""
    for depth, layer in enumerate(batch.layers):
        start, content = len(content), content + layer.contiguous().numpy().tobytes()
        place = {"dtype": "F16", "shape": list(layer.shape), "data_offsets": [start, len(content)]}
        header[f"layers.{depth}"] = place
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # so that the tensors are aligned when the file is mapped
    return struct.pack("<Q", len(text)) + text + content


def _shard_name(architecture: Architecture) -> str:
    return f"{architecture}.safetensors"


def _check_promised(content: bytes, promised: Entry, path: Path) -> None:
    if Entry.of(content) != promised:
        raise UserError(
            f"{path.name} comes out different from the manifest on this machine (torch {torch.__version__}): "
            "the embedded GHNs are damaged, so install nnit again; if that does not help, please report it"
        )


def _put(path: Path, content: bytes) -> None:
    def fill(temporary: Path) -> None:
        temporary.write_bytes(content)

    write_atomically(path, fill)


def _write(path: Path, content: bytes, manifest: Manifest) -> None:
    folder = path.parent
    try:
        _put(path, content)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            needed = sum(entry.size for entry in manifest.missing(folder).values())
            raise UserError(
                f"no space left in {folder}: {needed} bytes ({files.readable(needed)}) are still to be written; "
                "make room and run the same command again, or choose another folder with --folder"
            ) from None
        raise UserError(f"cannot write in {folder} ({error.strerror}); choose another folder with --folder") from None
