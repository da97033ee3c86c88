"""What there is to say of a zoo in few numbers; imports no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from nnit_zoo import places
from nnit_zoo.files import HELDOUT_SEEDS_FROM, MANIFEST, SCORES, SELECTION, SPLITS


def by_split(index: pa.Table) -> dict[str, dict[str, Any]]:
    """Per split its numbers of architectures and policies and the mean scores of these, None where a task has none.

    `episodes` are those that each policy played: all splits with as many played the same ones.
    """
    counts = [("architecture", "count_distinct"), ("id", "count"), ("episodes", "min")]
    counts += [(score, "mean") for score in SCORES]
    rows = index.group_by("split", use_threads=False).aggregate(counts).to_pylist()
    return {
        row["split"]: {
            "architectures": row["architecture_count_distinct"],
            "policies": row["id_count"],
            "episodes": row["episodes_min"],
            **{score: row[f"{score}_mean"] for score in SCORES},
        }
        for row in sorted(rows, key=lambda row: SPLITS.index(row["split"]))
    }


def pass_rates(selection: Path) -> dict[str, float]:
    """Per seen architecture, the share of its candidates for the corpus that reach the task's thresholds."""
    table = pq.ParquetFile(selection).read()
    candidates = (pc.field("split") == "seen") & (pc.field("ghn_seed") < HELDOUT_SEEDS_FROM)
    rows = table.filter(candidates).group_by("architecture", use_threads=False).aggregate([("passed", "mean")])
    return dict(zip(rows["architecture"].to_pylist(), rows["passed_mean"].to_pylist(), strict=True))


def ghns_of(selection: Path) -> int:
    """The number of GHNs that made the candidates."""
    return len(pc.unique(pq.ParquetFile(selection).read(["ghn_seed"])["ghn_seed"]))


def describe(task: str) -> dict[str, Any]:
    """What there is to say of a zoo that ships: sizes, where it lies, how much of it is there, and its summary."""
    manifest, index = places.manifest(task), places.index(task)
    place = places.default_folder(task)
    held = place / MANIFEST
    ours = held.is_file() and held.read_bytes() == manifest.to_bytes()  # it may be unreadable, or of another version
    return {
        "task": task,
        "inputs": manifest.inputs,
        "outputs": manifest.outputs,
        "policies": index.num_rows,
        "bytes": manifest.size,
        "folder": str(place),
        "shards": len(manifest.shards),
        "shards_downloaded": sum((place / name).is_file() for name in manifest.shards) if ours else 0,
        "splits": by_split(index),
        "pass_rates": pass_rates(places.data_folder(task) / SELECTION),
    }
