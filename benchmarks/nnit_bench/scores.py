"""The numbers of a result table, computed from a run's episodes.

`mean` and `worst` are over everything generated. `top` is the mean of the best policies on the episodes that selected
them, as in the paper; `top_heldout` is their mean on others.

What an interval allows for depends on the sentence that the number stands for. `mean` speaks of the generator on
architectures like these: architectures, with their policies, are drawn (the committed 8 stand for others), and so are
episodes; on `joint` the generator draws the architectures itself, so policies are drawn. `worst` speaks of one
architecture, the one that came out lowest: policies and episodes are drawn. Both kinds of `top` speak of these ten
policies: only episodes are drawn. How well the worst or the best were picked is in no interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from nnit_bench.protocol import Protocol
from nnit_bench.statistics import Estimate, Floats, Ints, mean
from nnit_zoo.architecture import hidden_widths, split_of
from nnit_zoo.tasks.metric import Metric

FUNCTIONAL = 0.5  # headline score from which a policy counts as functional (NNiT appendix I does not say)


class Scores(NamedTuple):
    """One phase's scores: column -> values [policies, episodes], with each policy's number and architecture."""

    values: Mapping[str, Floats]
    policies: Ints
    architectures: NDArray[np.str_]
    seeds: Ints

    def of(self, policies: Ints) -> Scores:
        """The scores of some policies, in the order given."""
        row = {number: index for index, number in enumerate(self.policies.tolist())}
        rows = [row[number] for number in policies.tolist()]
        values = {column: table[rows] for column, table in self.values.items()}
        return Scores(values, self.policies[rows], self.architectures[rows], self.seeds)

    def during(self, episodes: NDArray[np.bool_]) -> Scores:
        """The scores of some episodes."""
        values = {column: table[:, episodes] for column, table in self.values.items()}
        return Scores(values, self.policies, self.architectures, self.seeds[episodes])


@dataclass(frozen=True)
class Architectures:
    """What a generator that chooses its architectures chose (NNiT appendix I)."""

    distinct: int
    """How many different ones."""
    unseen: int
    """How many of the 8 unseen ones are among them."""
    excluded: int
    """How many of the 9 excluded ones are among them."""
    outside: int
    """How many of them are not among the zoo's 81."""
    distinct_in_top: int
    """How many different ones the selected policies have."""
    functional: float
    """Share of all policies whose headline score is 0.5 or more."""


@dataclass(frozen=True)
class Summary:
    """A method's row of a result table."""

    estimates: dict[str, dict[str, Estimate]]
    """Column -> `mean`, `worst`, `top`, `top_heldout` -> estimate; without `worst` on `joint`."""
    worst: str | None
    """The architecture with the lowest headline score."""
    top: tuple[int, ...]
    """The numbers of the selected policies, best first."""
    architectures: dict[str, dict[str, Estimate]]
    """Architecture -> column -> mean over its policies."""
    joint: Architectures | None
    """On `joint`, what the generator chose."""


def from_episodes(episodes: pa.Table, metrics: Sequence[Metric]) -> Scores:
    """The scores in a table of episodes of one phase, in which every policy plays the same ones."""
    episodes = episodes.sort_by([("policy", "ascending"), ("episode_seed", "ascending")])
    numbers, first = np.unique(episodes["policy"].to_numpy(), return_index=True)
    values: dict[str, Floats] = {
        each.column: episodes[each.column].to_numpy(zero_copy_only=False).astype(np.float64).reshape(len(numbers), -1)
        for each in metrics
    }
    names = np.array(episodes["architecture"].take(pa.array(first)).to_pylist())
    seeds = episodes["episode_seed"].to_numpy()[: len(episodes) // len(numbers)]
    return Scores(values, numbers.astype(np.int64), names, seeds.astype(np.int64))


def phase(episodes: pa.Table, name: str) -> pa.Table:
    """The rows of phase `select` or `report`."""
    return episodes.filter(pc.equal(episodes["phase"], name))


def everything(episodes: pa.Table, protocol: Protocol) -> Scores:
    """The scores of all generated policies, on the episodes that every one plays."""
    return from_episodes(phase(episodes, "select"), protocol.metrics)


def ranked(table: Scores, metrics: Sequence[Metric]) -> Ints:
    """The policies' numbers from the best: by the headline, ties by the last metric, then by the lower number."""
    headline, last = (-table.values[each.column].mean(1) for each in (metrics[0], metrics[-1]))
    return table.policies[np.lexsort((table.policies, last, headline))]


def selected(episodes: pa.Table, protocol: Protocol) -> dict[str, Scores]:
    """The scores of the selected policies: `top` on the episodes that selected them, `top_heldout` on others.

    The others are those of phase `report`. If the task has none, the odd seeds of phase `select` are, for the policies
    that are best on the even ones.
    """
    table = everything(episodes, protocol)
    best = ranked(table, protocol.metrics)[: protocol.top]
    found = {"top": table.of(best)}
    if protocol.report:
        found["top_heldout"] = from_episodes(phase(episodes, "report"), protocol.metrics).of(best)
    elif protocol.selection == "heldout" and len(table.seeds) > 1:
        even = table.seeds % 2 == 0
        best = ranked(table.during(even), protocol.metrics)[: protocol.top]
        found["top_heldout"] = table.during(~even).of(best)
    return found


def worst_architecture(table: Scores, metrics: Sequence[Metric]) -> str:
    """The architecture whose policies have the lowest mean headline score; ties go to the last metric."""

    def standing(name: str) -> tuple[float, float]:
        rows = table.architectures == name
        headline, last = (float(table.values[each.column][rows].mean()) for each in (metrics[0], metrics[-1]))
        return headline, last

    return str(min(np.unique(table.architectures).tolist(), key=standing))


def summarise(episodes: pa.Table, protocol: Protocol) -> Summary:
    """All statistics of a run, from its episodes."""
    table = everything(episodes, protocol)
    picked = selected(episodes, protocol)
    names = list(dict.fromkeys(table.architectures.tolist()))
    of_one = {name: table.of(table.policies[table.architectures == name]) for name in names}
    worst = None if protocol.is_joint else worst_architecture(table, protocol.metrics)
    estimates: dict[str, dict[str, Estimate]] = {}
    for metric in protocol.metrics:
        found = {"mean": _estimate(table, metric, clusters(table, protocol))}
        if worst:
            found["worst"] = _estimate(of_one[worst], metric)
        found |= {name: _estimate(part, metric, drawn=False) for name, part in picked.items()}
        estimates[metric.column] = found
    return Summary(
        estimates=estimates,
        worst=worst,
        top=tuple(picked["top"].policies.tolist()),
        architectures={
            name: {metric.column: _estimate(part, metric) for metric in protocol.metrics}
            for name, part in of_one.items()
        },
        joint=_chosen(table, picked["top"], protocol.metrics[0]) if protocol.is_joint else None,
    )


def of_means(means: Scores, protocol: Protocol) -> tuple[dict[str, dict[str, Estimate]], str]:
    """`mean`, `worst` and `top` of policies that only have means over episodes, [policies, 1], and the worst's name.

    The intervals allow for architectures and policies only; so `top`, which is of given policies, has none.
    """
    worst = worst_architecture(means, protocol.metrics)
    lowest = means.of(means.policies[means.architectures == worst])
    best = means.of(ranked(means, protocol.metrics)[: protocol.best])
    estimates: dict[str, dict[str, Estimate]] = {}
    for metric in protocol.metrics:
        top = float(best.values[metric.column].mean())
        estimates[metric.column] = {
            "mean": _estimate(means, metric, clusters(means, protocol)),
            "worst": _estimate(lowest, metric),
            "top": Estimate(top, top, top),
        }
    return estimates, worst


def clusters(table: Scores, protocol: Protocol) -> NDArray[np.str_] | None:
    """What is drawn as one: an architecture's policies, unless there is one architecture only or the method chose."""
    return None if protocol.is_joint or len(set(table.architectures.tolist())) == 1 else table.architectures


def top_curve(episodes: pa.Table, protocol: Protocol) -> tuple[Floats, Floats]:
    """The headline's mean over the best k policies, for k = 1 .. all: on the same episodes, and held out, [all] each.

    Held out means here: selected on the even episode seeds, scored on the odd ones; only ten are played again.
    """
    table = everything(episodes, protocol)
    counts = np.arange(1, len(table.policies) + 1)

    def running_mean(ranking: Scores, scored: Scores) -> Floats:
        values = scored.of(ranked(ranking, protocol.metrics)).values[protocol.metrics[0].column]
        return np.asarray(values.mean(1).cumsum() / counts)

    even = table.seeds % 2 == 0
    if even.all() or not even.any():
        return running_mean(table, table), np.full(len(counts), np.nan)
    return running_mean(table, table), running_mean(table.during(even), table.during(~even))


def _estimate(
    table: Scores, metric: Metric, drawn_together: NDArray[np.str_] | None = None, *, drawn: bool = True
) -> Estimate:
    """One estimate, with a random state of its own: it is the same whatever else is computed."""
    rng = np.random.default_rng(0)
    return mean(table.values[metric.column], drawn_together, rng, drawn=drawn, bounds=metric.bounds)


def _chosen(table: Scores, top: Scores, headline: Metric) -> Architectures:
    names = set(table.architectures.tolist())
    return Architectures(
        distinct=len(names),
        unseen=len(names & set(hidden_widths("unseen"))),
        excluded=len(names & set(hidden_widths("excluded"))),
        outside=sum(split_of(name) == "other" for name in names),
        distinct_in_top=len(set(top.architectures.tolist())),
        functional=float((table.values[headline.column].mean(1) >= FUNCTIONAL).mean()),
    )
