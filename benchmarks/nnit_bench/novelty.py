"""Whether generated policies are new: their distance to the policies that the generator could have copied.

A generator that hands out stored policies scores as well as they do. So each generated policy is compared with what is
known: with the *known seeds* of its architecture, that is, the policies that the hypernetworks of the corpus give for
it (training policies if the architecture is seen; else what a copy of a seed carried over to it would be), with all
training policies, and in what it does. The yardstick is the same distance for policies of held-out seeds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch
from torch import Tensor

from nnit_bench.records import Distance, Novelty
from nnit_zoo.architecture import SPLITS, Architecture, split_of
from nnit_zoo.diversity import cosines, distances, pairs
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.tasks.task import Task
from nnit_zoo.zoo import Zoo, policy_hashes

COPY = 1e-3  # relative L2 below which a policy is a copy; float16 rounds by 3e-4 of a parameter, and less on average
SCHEMA = pa.schema(
    [
        ("policy", pa.int32()),
        ("architecture", pa.string()),
        ("sha256", pa.string()),  # of its float32 parameters, in the order of PolicyBatch.flat
        ("same_architecture", pa.float64()),  # this and the next two distances as in records.Novelty
        ("same_architecture_seed", pa.int32()),
        ("any_architecture", pa.float64()),
        ("any_architecture_seed", pa.int32()),
        ("any_architecture_name", pa.string()),
        ("actions", pa.float64()),
    ]
)
Floats = npt.NDArray[np.float64]


def measure(task: Task, zoo: Zoo, batches: Sequence[PolicyBatch]) -> tuple[Novelty, pa.Table]:
    """The novelty of generated policies, and a row of SCHEMA for each, numbered in the order given."""
    there = zoo.architectures("heldout_seed")
    heldout = [
        zoo.batch(batch.architecture, "heldout_seed")[: len(batch)].to(torch.float32)
        for batch in batches
        if batch.architecture in there
    ]
    nearest = _distances(task, zoo, [*batches, *heldout])
    policies = [(str(batch.architecture), sha256) for batch in batches for sha256 in policy_hashes(batch)]
    rows, yardstick = nearest[: len(policies)], nearest[len(policies) :]
    found = {name: _compare(name, rows, yardstick) for name in ("same_architecture", "any_architecture", "actions")}
    copies = sum(_is_copy(row) for row in rows)
    l2, cosine = _pairwise(batches)
    novelty = Novelty(copies=copies, pairwise_l2=l2, pairwise_cosine=cosine, **found)
    table = [
        {"policy": number, "architecture": name, "sha256": sha256, **row}
        for number, ((name, sha256), row) in enumerate(zip(policies, rows, strict=True))
    ]
    return novelty, pa.Table.from_pylist(table, SCHEMA)


def _distances(task: Task, zoo: Zoo, batches: Sequence[PolicyBatch]) -> list[dict[str, Any]]:
    """The distances of each policy, those it has no known policies for and those that are not finite left out."""
    found: list[dict[str, Any]] = [{} for batch in batches for _ in range(len(batch))]
    finite: dict[Architecture, list[PolicyBatch]] = {}
    rows: dict[Architecture, list[int]] = {}
    starts = np.cumsum([0, *map(len, batches)]).tolist()
    for batch, start in zip(batches, starts, strict=False):
        chosen = torch.nonzero(batch.finite()).flatten().tolist()
        finite.setdefault(batch.architecture, []).append(batch[chosen])
        rows.setdefault(batch.architecture, []).extend(start + index for index in chosen)
    wanted = {architecture: concatenate(parts) for architecture, parts in finite.items() if rows[architecture]}
    states = task.probe_states()
    known = {(split, each) for split in SPLITS for each in zoo.architectures(split)}
    for architecture, batch in wanted.items():
        split = split_of(architecture)
        if (split, architecture) not in known:
            continue
        same = zoo.batch(architecture, split).to(torch.float32)
        seeds = zoo.ghn_seeds(architecture, split)
        nearest, distance = _nearest(batch.flat().double().numpy(), same.flat().double().numpy())
        for row, index, value in zip(rows[architecture], nearest.tolist(), distance.tolist(), strict=True):
            found[row] |= {"same_architecture": value, "same_architecture_seed": seeds[index]}
        if states is not None:
            for row, value in zip(rows[architecture], _action_distance(task, states, batch, same), strict=True):
                found[row]["actions"] = value
    for architecture, others in _any_architecture(zoo, wanted):
        for row, values in zip(rows[architecture], others, strict=True):
            found[row] |= values
    return found


def _nearest(wanted: Floats, known: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
    """The nearest row of `known` to each row of `wanted`, and its distance relative to the known row's norm."""
    squares = (known**2).sum(1)
    distance = ((wanted**2).sum(1)[:, None] + squares - 2 * wanted @ known.T) / squares
    nearest = distance.argmin(1)
    # Not from the product above: what it leaves of a copy is rounding.
    return nearest, np.linalg.norm(wanted - known[nearest], axis=1) / np.sqrt(squares[nearest])


def _action_distance(task: Task, states: Tensor, policies: PolicyBatch, known: PolicyBatch) -> list[float]:
    """Root mean square difference of behaviour on the probe states to the known policy that behaves most alike."""
    mine, theirs = (_behaviour(task, states, batch) for batch in (policies, known))
    exact = "donot_use_mm_for_euclid_dist"  # the faster way gives a copy a distance
    nearest = torch.cdist(mine, theirs, compute_mode=exact).min(1).values / mine.shape[1] ** 0.5
    return [float(value) for value in nearest]


def _behaviour(task: Task, states: Tensor, batch: PolicyBatch) -> Tensor:
    """What each policy does on all states, [n, states x outputs]; a few policies at a time stay in the cache.

    Huge weights overflow: no number counts as 0, as in an episode.
    """
    parts = [batch[start : start + 16](states[None]) for start in range(0, len(batch), 16)]
    return task.behaviour(torch.cat(parts).nan_to_num()).flatten(1)


@dataclass(frozen=True)
class _Canvas:
    """Networks of one depth as vectors: blocks in the corner of the largest, weights times the root of their fan-in.

    A hypernetwork divides by that root, so a part of a network carried over to another width is the same vector. Inputs
    that no neuron reads do not count, so that one padded with silent neurons is the same vector, too.
    """

    shapes: tuple[tuple[int, int], ...]
    """(out, in + 1) of the largest block of each layer; what lies outside is left out."""

    def pack(self, batch: PolicyBatch) -> Floats:
        parts = []
        for layer, (rows, columns) in zip(batch.layers, self.shapes, strict=True):
            canvas = np.zeros((len(batch), rows, columns))
            out, into = min(rows, layer.shape[1]), min(columns, layer.shape[2]) - 1
            weights = layer[:, :, :-1].double().numpy()
            fan_in = weights.any(axis=1).sum(axis=1)[:, None, None]
            canvas[:, :out, :into] = weights[:, :out, :into] * fan_in**0.5
            canvas[:, :out, -1] = layer[:, :out, -1].double().numpy()
            parts.append(canvas.reshape(len(batch), -1))
        return np.concatenate(parts, axis=1)

    def mask(self, architecture: Architecture) -> Floats:
        """1 where the architecture has parameters, else 0."""
        ones = PolicyBatch(architecture, tuple(torch.ones(1, *shape) for shape in architecture.block_shapes))
        return np.asarray(self.pack(ones)[0] != 0, np.float64)


def _any_architecture(
    zoo: Zoo, wanted: Mapping[Architecture, PolicyBatch]
) -> Iterator[tuple[Architecture, list[dict[str, Any]]]]:
    """Per architecture and policy, the nearest training policy of any architecture, over the blocks that both have."""
    for depth in {len(batch.layers) for batch in wanted.values()}:
        training = [each for each in zoo.architectures("seen") if len(each.block_shapes) == depth]
        if not training:
            continue
        mine = {architecture: batch for architecture, batch in wanted.items() if len(batch.layers) == depth}
        largest = np.max([each.block_shapes for each in training], axis=0)
        canvas = _Canvas(tuple((rows, columns) for rows, columns in largest.tolist()))
        policies = np.concatenate([canvas.pack(batch) for batch in mine.values()])
        masks = np.stack([canvas.mask(architecture) for architecture in mine])
        mask_of = np.repeat(np.arange(len(mine)), [len(batch) for batch in mine.values()])
        nearest = _nearest_on_canvas(zoo, canvas, training, policies, masks, mask_of)
        ends = np.cumsum([len(batch) for batch in mine.values()]).tolist()
        for architecture, end in zip(mine, ends, strict=True):
            yield architecture, nearest[end - len(mine[architecture]) : end]


def _nearest_on_canvas(
    zoo: Zoo,
    canvas: _Canvas,
    training: Sequence[Architecture],
    policies: Floats,
    masks: Floats,
    mask_of: npt.NDArray[np.int64],
) -> list[dict[str, Any]]:
    """The nearest training policy to each of `policies` [n, canvas]; `masks[mask_of[i]]` is where i has weights."""
    squares = policies**2
    best = np.full(len(policies), np.inf)
    found: list[dict[str, Any]] = [{} for _ in policies]
    for architecture in training:
        known, theirs = canvas.pack(zoo.batch(architecture, "seen")), canvas.mask(architecture)
        norms = (known**2 @ masks.T).T[mask_of]  # squared, of each known policy in the part that the wanted one has
        distance = ((squares @ theirs)[:, None] + norms - 2 * policies @ known.T) / norms
        nearest = distance.argmin(1)
        value = distance[np.arange(len(policies)), nearest]
        seeds = zoo.ghn_seeds(architecture, "seen")
        for row in np.flatnonzero(value < best):
            best[row] = value[row]
            # Not from the product above: what it leaves of a copy is rounding.
            shared, one = masks[mask_of[row]] * theirs, known[nearest[row]]
            exact = np.linalg.norm((policies[row] - one) * shared) / np.linalg.norm(one * shared)
            found[row] = {
                "any_architecture": float(exact),
                "any_architecture_seed": seeds[nearest[row]],
                "any_architecture_name": str(architecture),
            }
    return found


def _compare(name: str, rows: Sequence[dict[str, Any]], yardstick: Sequence[dict[str, Any]]) -> Distance | None:
    """The medians of one distance; None if no policy has it."""
    mine, others = ([row[name] for row in table if name in row] for table in (rows, yardstick))
    if not mine:
        return None
    median = float(np.median(np.array(mine)))
    heldout = float(np.median(np.array(others))) if others else None
    return Distance(median=median, heldout=heldout, ratio=median / heldout if heldout else None)


def _is_copy(row: dict[str, Any]) -> bool:
    distances = (row.get("same_architecture"), row.get("any_architecture"))
    return any(isinstance(each, float) and each < COPY for each in distances)


def _pairwise(batches: Sequence[PolicyBatch]) -> tuple[float | None, float | None]:
    """Mean L2 distance and cosine similarity over all pairs of finite policies that share an architecture."""
    finite = [batch[torch.nonzero(batch.finite()).flatten().tolist()] for batch in batches]
    several = [batch for batch in finite if len(batch) > 1]
    if not several:
        return None, None
    l2, cosine = (torch.cat([pairs(of(batch)) for batch in several]) for of in (distances, cosines))
    return float(l2.mean()), float(cosine.mean())
