"""Make a zoo's shards from its GHNs, which ship: the same bytes on every machine, proved by the manifest.

The GHNs decode in float64 and every parameter is rounded once to float16. Thread counts, processors and versions of
BLAS sum in different orders, which moves a float64 parameter by about 1e-16. Its float16 bytes change only if that
carries it across a rounding tie. Hardly any parameter is that close to one, and for those the index's hash of the
policy tells which side is the stored one.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
from collections.abc import Collection, Iterator, Sequence
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from nnit_zoo import files, ghn_file
from nnit_zoo.architecture import Architecture
from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError
from nnit_zoo.files import GHNS, SPLITS, Entry, Manifest, Progress, policy_split
from nnit_zoo.ghn import GHN
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.zoo import policy_hashes

TIE_MARGIN = 1e-14
_MOST_TIES = 8  # of one policy that are tried on both sides


def materialise(
    data_folder: Path, target: Path, progress: Progress | None = None, splits: Collection[str] = SPLITS
) -> None:
    """Write the shards of these splits of the zoo in a task's data folder to `target`, as `files.fill` does.

    Shards that are there already are kept. Raises UserError if the index is not the manifest's, or a shard comes out
    different from it.
    """
    manifest = Manifest.read(data_folder)
    index = (data_folder / files.INDEX).read_bytes()
    if Entry.of(index) != manifest.index:
        raise UserError(f"{data_folder / files.INDEX} is not what {files.MANIFEST} promises; install nnit again")

    def make(names: Collection[str]) -> Iterator[tuple[str, bytes]]:
        source = _Source(data_folder)
        for architecture in source.rows:
            if (name := _shard_name(architecture)) in names:
                exact = source.decode(architecture)
                content = _serialise(_round(exact), source.task)
                if Entry.of(content) != manifest.shards[name]:
                    rows = files.read_index(data_folder / files.INDEX, str(architecture))
                    content = _serialise(_turn_ties(exact, rows["sha256"].to_pylist()), source.task)
                yield name, content

    files.fill(
        target,
        manifest,
        index,
        make,
        splits=splits,
        progress=progress,
        advice=f"it came out different here (torch {torch.__version__}), so the GHNs that ship are damaged; install "
        "nnit again, and if that does not help, please report it",
    )


def write_manifest(data_folder: Path, standardisation: str | None) -> None:
    """Write index.parquet and manifest.json beside the GHNs and the selection table that they follow from.

    The manifest keeps `standardisation`, the hash of what the policies' observations are standardised by, or None.
    Raises UserError if a kept policy has a parameter that is not finite in float16.
    """
    source = _Source(data_folder)
    shards, index = {}, []
    for architecture, rows in source.rows.items():
        batch, ids = _round(source.decode(architecture)), source.ids(architecture)
        if not batch.finite().all():
            raise UserError(f"{ids[int(batch.finite().int().argmin())]} is not finite in float16: do not keep it")
        name = _shard_name(architecture)
        shards[name] = Entry.of(_serialise(batch, source.task))
        common = {"task": source.task, "shard": name, "n_params": architecture.parameters}
        stored = zip(rows, ids, policy_hashes(batch), _norms(batch), strict=True)
        index += [
            {**row, **common, "id": id_, "row": number, "sha256": sha256, "weight_norm": norm}
            for number, (row, id_, sha256, norm) in enumerate(stored)
        ]
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(index, files.INDEX_SCHEMA), buffer, compression="zstd")
    manifest = Manifest(
        task=source.task,
        inputs=source.inputs,
        outputs=source.outputs,
        index=Entry.of(buffer.getvalue()),
        shards=shards,
        standardisation=standardisation,
    )
    write_bytes(data_folder / files.INDEX, buffer.getvalue())
    write_bytes(data_folder / files.MANIFEST, manifest.to_bytes())


def stored(ghn: GHN, architecture: Architecture) -> PolicyBatch:
    """The GHN's policy as a zoo stores it: the GHN in float16, decoded in float64, rounded once to float16."""
    return _round(deepcopy(ghn).half().double().emit(architecture))


class _Source:
    """The GHNs of a data folder and the rows of the policies to be kept, per architecture and by GHN seed."""

    def __init__(self, data_folder: Path) -> None:
        made_by = ghn_file.read(data_folder / GHNS)
        self.task, self.inputs, self.outputs = made_by.task, made_by.inputs, made_by.outputs
        self._ghns = {
            seed: GHN.from_state(self.inputs, self.outputs, state).double() for seed, state in made_by.states.items()
        }
        self.rows = self._kept_rows(data_folder / files.SELECTION)

    def _kept_rows(self, selection: Path) -> dict[Architecture, list[dict[str, Any]]]:
        candidates = pq.ParquetFile(selection).read().to_pylist()
        kept = [row for row in candidates if row["kept"]]
        kept.sort(key=lambda row: (SPLITS.index(row["split"]), row["architecture"], row["ghn_seed"]))
        grouped: dict[Architecture, list[dict[str, Any]]] = {}
        for row in kept:
            row["split"] = policy_split(row["split"], row["ghn_seed"])
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


def _norms(batch: PolicyBatch) -> list[float]:
    """L2 norm of each policy's parameters, the same on every machine: squares of float16 are exact, and so is fsum."""
    return [math.sqrt(math.fsum(squares)) for squares in batch.flat().double().square().tolist()]


def _turn_ties(exact: PolicyBatch, hashes: Sequence[str]) -> PolicyBatch:
    """The rounded batch, with parameters on a tie turned to the other side where that gives a policy its hash."""
    values, nearest = exact.flat().numpy(), _round(exact).flat().numpy()
    other = np.nextafter(nearest, np.where(values > nearest, np.float16(np.inf), np.float16(-np.inf)))
    ties = np.abs((nearest.astype(np.float64) + other) / 2 - values) < TIE_MARGIN
    for policy, sha256 in enumerate(hashes):
        columns = np.flatnonzero(ties[policy])[:_MOST_TIES]
        sides = zip(nearest[policy, columns], other[policy, columns], strict=True)
        for chosen in product(*sides):
            nearest[policy, columns] = chosen
            if hashlib.sha256(nearest[policy].tobytes()).hexdigest() == sha256:
                break
    sizes = [rows * columns for rows, columns in exact.architecture.block_shapes]
    parts = torch.split(torch.from_numpy(nearest), sizes, dim=1)
    layers = (part.view(-1, *shape) for part, shape in zip(parts, exact.architecture.block_shapes, strict=True))
    return PolicyBatch(exact.architecture, tuple(layers))


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
