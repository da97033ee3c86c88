"""Which candidates a zoo keeps: of seen architectures the best that pass, of the yardsticks all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pyarrow as pa

from nnit_zoo.files import policy_split
from nnit_zoo.tasks.task import Task

POLICIES_PER_ARCHITECTURE = 100
SELECTION_SCHEMA = pa.schema(
    [
        ("architecture", pa.string()),
        ("ghn_seed", pa.int64()),
        ("split", pa.string()),
        ("success_once", pa.float64()),
        ("success_at_end", pa.float64()),
        ("return", pa.float64()),
        ("episodes", pa.int64()),
        ("passed", pa.bool_()),
        ("kept", pa.bool_()),
    ]
)


def is_yardstick(split: str, ghn_seed: int) -> bool:
    """Whether a policy of this split's architectures is for comparison only, and so never in the corpus."""
    return policy_split(split, ghn_seed) != "seen"


def select(task: Task, split: str, architecture: str, scores: pa.Table) -> Iterator[dict[str, Any]]:
    """The selection rows of one architecture's candidates, by GHN seed.

    Of a seen architecture, the best 100 that reach all thresholds are kept; the best by the first threshold's metric,
    then the next (NNiT appendix D). Of a reference architecture, and of held-out seeds, all are kept: they are a
    yardstick, which a filter would bend.
    """
    columns = ("success_once", "success_at_end", "return")
    means = scores.group_by("ghn_seed").aggregate([*((column, "mean") for column in columns), ("seed", "count")])
    candidates = sorted(
        means.to_pylist(), key=lambda row: (*(-row[f"{column}_mean"] for column in task.thresholds), row["ghn_seed"])
    )
    reference = [row["ghn_seed"] for row in candidates if is_yardstick(split, row["ghn_seed"])]
    passing = [
        row["ghn_seed"]
        for row in candidates
        if all(row[f"{column}_mean"] >= least for column, least in task.thresholds.items())
    ]
    corpus = [seed for seed in passing if seed not in reference][:POLICIES_PER_ARCHITECTURE]
    kept = {*reference, *corpus}
    for row in sorted(candidates, key=lambda row: row["ghn_seed"]):
        yield {
            "architecture": architecture,
            "ghn_seed": row["ghn_seed"],
            "split": split,
            **{column: row[f"{column}_mean"] for column in columns},
            "episodes": row["seed_count"],
            "passed": row["ghn_seed"] in passing,
            "kept": row["ghn_seed"] in kept,
        }
