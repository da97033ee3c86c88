"""A deep check of a zoo folder: checksums, schema, splits, finite parameters and a forward pass of every policy."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import torch

from nnit_zoo import files, tasks
from nnit_zoo.architecture import Architecture, split_of
from nnit_zoo.errors import UserError
from nnit_zoo.files import Progress, policy_split
from nnit_zoo.zoo import Policy, Zoo, damaged, policy_hashes, read_shard

DIFFERING = 3  # episodes of a policy that another processor may let end otherwise
ROUNDING = 1e-6  # of a mean of the same scores


def verify(folder: Path, progress: Progress | None = None, splits: Collection[str] = files.SPLITS) -> list[str]:
    """What is wrong with the zoo in `folder`, a sentence per problem; empty if it is sound.

    Only shards with policies of these splits are looked for. `progress` is called with the number of newly done
    shards, those that are not looked for at once. Raises UserError if the folder has no manifest that can be read.
    """
    manifest = files.Manifest.read(folder)
    if not manifest.index.describes(folder / files.INDEX):
        return [str(damaged(folder / files.INDEX, manifest.task))]
    try:
        index = files.read_index(folder / files.INDEX)
    except UserError as error:
        return [str(error)]
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in manifest.shards}
    problems = []
    for row in index.to_pylist():
        rows.setdefault(row["shard"], []).append(row)
        problems += _row_problems(row, manifest.task)
    if len(set(index["id"].to_pylist())) != len(index):
        problems.append(f"{folder / files.INDEX} lists a policy twice")
    for name in sorted(rows.keys() - manifest.shards.keys()):
        problems.append(f"{folder / files.INDEX} lists policies in {name}, which {files.MANIFEST} does not")
    wanted = files.shards_of(index, splits)
    if progress:
        progress(len(manifest.shards.keys() - wanted))
    for name in (name for name in manifest.shards if name in wanted):
        entry = manifest.shards[name]
        architecture = Architecture.parse(Path(name).stem, manifest.inputs, manifest.outputs)
        if entry.describes(folder / name):
            problems += _shard_problems(folder / name, architecture, rows[name])
        else:
            problems.append(str(damaged(folder / name, manifest.task)))
        if progress:
            progress(1)
    return problems


def sample(zoo: Zoo, count: int, splits: Collection[str] = files.SPLITS) -> list[Policy]:
    """`count` policies of these splits, or all if there are fewer, evenly spread over the index."""
    zoo = zoo.filter(pc.field("split").isin(list(splits)))
    ids = zoo.index["id"].to_pylist()
    count = min(count, len(ids))
    return [zoo[ids[len(ids) * number // count]] for number in range(count)]


def rescore(
    folder: Path, count: int, progress: Progress | None = None, splits: Collection[str] = files.SPLITS
) -> list[dict[str, Any]]:
    """Play the build's episodes again with the policies of `sample(zoo, count, splits)`: a row for each.

    A row has the policy's id, each of its scores as `stored_` and `now_`, and whether they agree. The same kind of
    processor gives the same numbers. Another may round otherwise: in a task with success, whose episodes are simulated,
    three of them may then end otherwise, each worth up to 1 or the zoo's best return. `progress` is called with the
    number of newly finished episodes. Raises UserError as `Task.evaluate` does.
    """
    zoo = Zoo.open(folder)
    task = tasks.get(zoo.task)
    worth = {"success_at_end": 1.0, "success_once": 1.0, "return": pc.max(zoo.index["return"]).as_py()}
    chosen = sample(zoo, count, splits)
    now: dict[str, dict[str, Any]] = {}
    for episodes in dict.fromkeys(policy.record["episodes"] for policy in chosen):
        group = [policy for policy in chosen if policy.record["episodes"] == episodes]
        table = task.evaluate([policy.weights for policy in group], task.scoring_seeds[:episodes], progress=progress)
        means = table.group_by("policy", use_threads=False).aggregate([(score, "mean") for score in files.SCORES])
        now |= {
            policy.record["id"]: row for policy, row in zip(group, means.sort_by("policy").to_pylist(), strict=True)
        }
    rows = []
    for policy in chosen:
        row = {"id": policy.record["id"], "agrees": True}
        simulated = policy.record["success_at_end"] is not None
        share = DIFFERING / policy.record["episodes"] if simulated else 0
        for score in files.SCORES:
            before, after = policy.record[score], now[row["id"]][f"{score}_mean"]
            row |= {f"stored_{score}": before, f"now_{score}": after}
            row["agrees"] &= before is None or abs(after - before) <= share * worth[score] + ROUNDING
        rows.append(row)
    return rows


def _row_problems(row: dict[str, Any], task: str) -> list[str]:
    """A row of the index must follow from its architecture and GHN seed."""
    expected = {
        "id": f"{task}/{row['architecture']}/{row['ghn_seed']:03d}",
        "task": task,
        "split": policy_split(split_of(row["architecture"]), row["ghn_seed"]),
        "shard": f"{row['architecture']}.safetensors",
    }
    return [
        f"policy {row['id']} has {column} '{row[column]}' in the index, but should have '{value}'"
        for column, value in expected.items()
        if row[column] != value
    ]


def _shard_problems(path: Path, architecture: Architecture, rows: list[dict[str, Any]]) -> list[str]:
    try:
        batch = read_shard(path, architecture)
    except UserError as error:
        return [str(error)]
    if any(layer.dtype != torch.float16 for layer in batch.layers):
        return [f"{path} does not hold float16 parameters"]
    if [row["row"] for row in rows] != list(range(len(batch))):
        return [f"{path} holds {len(batch)} policies, and the index does not list exactly these"]
    observations = torch.randn(1, 16, architecture.inputs, generator=torch.Generator().manual_seed(0))
    working = batch.to(torch.float32)(observations).isfinite().flatten(1).all(1) & batch.finite()
    intact = [sha256 == row["sha256"] for sha256, row in zip(policy_hashes(batch), rows, strict=True)]
    problems = [
        f"policy {row['id']} in {path} gives no finite actions" for row, ok in zip(rows, working, strict=True) if not ok
    ]
    problems += [
        f"policy {row['id']} in {path} is not the one in the index"
        for row, ok in zip(rows, intact, strict=True)
        if not ok
    ]
    return problems
