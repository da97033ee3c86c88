"""The numbers of the result table and their 95 % intervals, from a table with a row per episode.

Every statistic is the mean over a set of policies: all of them, the ten best, or those of the worst architecture. The
intervals are percentile bootstraps that resample whatever the statement should hold beyond: architectures, the policies
within them, and the episodes. All policies play the same episodes, so episodes are drawn once for all of them: a hard
start is hard for every policy. In simulations with 8 architectures x 10 policies x 50 episodes, the intervals of the
mean held the truth in 88 to 100 % of cases (88 when architectures differ much and policies little: 8 are few clusters).

The ten best and the worst architecture are picked first and then taken as given: their intervals say how well the
picked policies are known, not how well they were picked. An interval of no width means that all of its episodes went
the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

METRICS = ("success_at_end", "success_once", "return")
REPLICATES = 2000

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Estimate(NamedTuple):
    """A mean and its 95 % interval."""

    value: float
    low: float
    high: float


class Scores(NamedTuple):
    """One phase's scores: metric -> values [policies, episodes], and each policy's number and architecture."""

    values: Mapping[str, Floats]
    policies: Ints
    architectures: NDArray[np.str_]

    def of(self, policies: Ints) -> Scores:
        """The scores of some policies, in the order given."""
        row = {number: index for index, number in enumerate(self.policies.tolist())}
        rows = [row[number] for number in policies.tolist()]
        values = {metric: table[rows] for metric, table in self.values.items()}
        return Scores(values, self.policies[rows], self.architectures[rows])


def scores(episodes: pa.Table) -> Scores:
    """The scores in an episode table of one phase, in which every policy plays the same episodes."""
    episodes = episodes.sort_by([("policy", "ascending"), ("seed", "ascending")])
    numbers, first = np.unique(episodes["policy"].to_numpy(), return_index=True)
    values = {
        metric: episodes[metric].to_numpy(zero_copy_only=False).astype(np.float64).reshape(len(numbers), -1)
        for metric in METRICS
    }
    return Scores(values, numbers.astype(np.int64), np.array(episodes["architecture"].to_pylist())[first])


def best(table: Scores, count: int) -> Ints:
    """Numbers of the `count` policies with the highest success at end; ties go to the return, then the lower number."""
    success = table.values["success_at_end"].mean(1)
    order = np.lexsort((table.policies, -table.values["return"].mean(1), -success))
    return table.policies[order[:count]]


def worst_architecture(table: Scores) -> str:
    """The architecture whose policies have the lowest mean success at end; ties go to the lower return."""
    names = np.unique(table.architectures)

    def standing(name: str) -> tuple[float, float]:
        rows = table.architectures == name
        return float(table.values["success_at_end"][rows].mean()), float(table.values["return"][rows].mean())

    return str(min(names.tolist(), key=standing))


def mean(values: Floats, clusters: NDArray[np.generic], rng: np.random.Generator) -> Estimate:
    """The mean of values [policies, episodes] and its interval: bootstrap over clusters, their policies, and episodes.

    `clusters` [policies] says which policies are drawn together; if each is its own cluster, policies are simply drawn.
    """
    _, members = np.unique(clusters, return_inverse=True)
    sizes = np.bincount(members)
    draws = rng.multinomial(len(sizes), np.full(len(sizes), 1 / len(sizes)), REPLICATES)
    weights = np.empty((REPLICATES, len(values)))
    for cluster, size in enumerate(sizes.tolist()):
        weights[:, members == cluster] = rng.multinomial(draws[:, cluster] * size, np.full(size, 1 / size))
    weights /= weights.sum(1, keepdims=True)
    episodes = values.shape[1]
    episode_weights = rng.multinomial(episodes, np.full(episodes, 1 / episodes), REPLICATES) / episodes
    means = ((weights @ values) * episode_weights).sum(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return Estimate(float(values.mean()), float(low), float(high))


class Summary(NamedTuple):
    """A table row: metric -> statistic -> estimate; the worst architecture; architecture -> metric -> plain mean."""

    estimates: dict[str, dict[str, Estimate]]
    worst: str
    architectures: dict[str, dict[str, float]]


def summarise(select: Scores, report: Scores | None, top: int, seed: int = 0) -> Summary:
    """All statistics of a method, metric by metric.

    `mean` and `worst` are over everything generated; `top` is selected and scored on the same episodes (NNiT table 1).
    If the selected policies were scored again in `report`, `top_heldout` is their mean there (not in the paper: the ten
    luckiest of many policies look better than they are).
    """
    worst = worst_architecture(select)
    chosen = select.of(best(select, top))
    sets = {"mean": select, "top": chosen, "worst": select.of(select.policies[select.architectures == worst])}
    if report is not None:
        sets["top_heldout"] = report.of(chosen.policies)
    rng = np.random.default_rng(seed)
    estimates = {
        metric: {
            name: mean(part.values[metric], part.architectures if name == "mean" else part.policies, rng)
            for name, part in sets.items()
        }
        for metric in METRICS
    }
    names = list(dict.fromkeys(select.architectures.tolist()))
    by_architecture = {
        name: {metric: float(select.values[metric][select.architectures == name].mean()) for metric in METRICS}
        for name in names
    }
    return Summary(estimates, worst, by_architecture)
