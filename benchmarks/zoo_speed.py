"""Opening a zoo of 6,400 policies and stacking an architecture, beside torch.load and one safetensors file a policy.

The policies are random numbers; what is read is in the page cache. "checked" counts the shard's SHA-256, which the
others do not have; it is paid once for every shard and process.

Run: python benchmarks/zoo_speed.py
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from safetensors.torch import load_file, save_file

from nnit_zoo import files
from nnit_zoo.architecture import Architecture, architectures
from nnit_zoo.files import Entry, Manifest
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import Zoo, policy_hashes

TASK, INPUTS, OUTPUTS = "PickCube-v1", 42, 8
POLICIES = 100
REPEATS = 20


def make(folder: Path) -> None:
    """Write the same random policies in three forms: zoo/, torch/ (a file per architecture and one of all), single/."""
    draws = np.random.default_rng(0)
    rows, shards, everything = [], {}, {}
    for name in ("zoo", "torch", "single"):
        (folder / name).mkdir(parents=True)
    for architecture in architectures("seen", INPUTS, OUTPUTS):
        shapes = architecture.block_shapes
        layers = [draws.normal(size=(POLICIES, *shape)).astype(np.float16) for shape in shapes]
        batch = PolicyBatch(architecture, tuple(map(torch.from_numpy, layers)))
        tensors = {f"layers.{depth}": layer for depth, layer in enumerate(batch.layers)}
        shard = f"{architecture}.safetensors"
        save_file(tensors, folder / "zoo" / shard)
        shards[shard] = Entry.of((folder / "zoo" / shard).read_bytes())
        torch.save(tensors, folder / "torch" / f"{architecture}.pt")
        everything[str(architecture)] = tensors
        for row, sha256 in enumerate(policy_hashes(batch)):
            single = {name: tensor[row].contiguous() for name, tensor in tensors.items()}
            save_file(single, folder / "single" / f"{architecture}-{row:03d}.safetensors")
            ids = {"id": f"{TASK}/{architecture}/{row:03d}", "architecture": str(architecture), "ghn_seed": row}
            scores = {"success_once": 1.0, "success_at_end": 0.99, "return": 39.0, "episodes": 64}
            rows.append({**ids, **scores, "task": TASK, "split": "seen", "shard": shard, "row": row, "sha256": sha256})
    torch.save(everything, folder / "torch" / "all.pt")
    index = folder / "zoo" / files.INDEX
    pq.write_table(pa.Table.from_pylist(rows, files.INDEX_SCHEMA), index, compression="zstd")
    manifest = Manifest(task=TASK, inputs=INPUTS, outputs=OUTPUTS, index=Entry.of(index.read_bytes()), shards=shards)
    (folder / "zoo" / files.MANIFEST).write_bytes(manifest.to_bytes())


def milliseconds(action: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median processor time of an action from a warm cache."""
    action()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return statistics.median(times) * 1000


def separate(folder: Path, architecture: Architecture) -> list[torch.Tensor]:
    """An architecture's layers from a file per policy."""
    policies = [load_file(folder / "single" / f"{architecture}-{row:03d}.safetensors") for row in range(POLICIES)]
    return [torch.stack([policy[name] for policy in policies]).float() for name in policies[0]]


def measure(folder: Path) -> list[tuple[str, float, float, float]]:
    """For each action its milliseconds with the zoo, with torch.load, and with a file per policy."""
    shapes = architectures("seen", INPUTS, OUTPUTS)
    widest = shapes[-1]
    zoo = Zoo.open(folder / "zoo")
    torch_one = milliseconds(lambda: [x.float() for x in torch.load(folder / "torch" / f"{widest}.pt").values()])
    single_one = milliseconds(lambda: separate(folder, widest))

    def open_again() -> Zoo:
        """The zoo without the shards that are already checked and mapped."""
        return Zoo(zoo.folder, zoo.manifest, zoo.index)

    def all_of_torch() -> list[torch.Tensor]:
        stacked = torch.load(folder / "torch" / "all.pt")
        return [layer.float() for layers in stacked.values() for layer in layers.values()]

    return [
        (
            "open, list the policies",
            milliseconds(lambda: Zoo.open(folder / "zoo").index["id"]),
            milliseconds(lambda: torch.load(folder / "torch" / "all.pt"), 3),
            milliseconds(lambda: sorted((folder / "single").iterdir())),
        ),
        (
            f"{POLICIES} of {widest}, checked",
            milliseconds(lambda: open_again().batch(widest).to(torch.float32)),
            torch_one,
            single_one,
        ),
        (
            f"{POLICIES} of {widest}, again",
            milliseconds(lambda: zoo.batch(widest).to(torch.float32)),
            torch_one,
            single_one,
        ),
        (
            "all, checked",
            milliseconds(lambda: [open_again().batch(each).to(torch.float32) for each in shapes], 3),
            milliseconds(all_of_torch, 3),
            milliseconds(lambda: [separate(folder, each) for each in shapes], 1),
        ),
    ]


def main() -> None:
    """Measure and print a table."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder))
        rows = measure(Path(folder))
    sys.stdout.write(f"{'ms of processor time, to float32':36}{'zoo':>10}{'torch.load':>14}{'file a policy':>16}\n")
    for name, *times in rows:
        sys.stdout.write(f"{name:36}{times[0]:10.1f}{times[1]:14.1f}{times[2]:16.1f}\n")


if __name__ == "__main__":
    main()
