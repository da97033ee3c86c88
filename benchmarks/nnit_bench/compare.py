"""`nnit-bench compare`: whether two methods can be told apart on the episodes that both have played."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from nnit_bench import results, scores
from nnit_bench.protocol import Protocol
from nnit_bench.results import FOLDERS, Folders, StoredRun
from nnit_bench.scores import Scores
from nnit_bench.statistics import Estimate, by_cluster, estimate
from nnit_zoo.console import Json, print_json
from nnit_zoo.errors import UserError
from nnit_zoo.tasks.metric import Metric

NAMES = {"mean": "mean", "top": "top", "top_heldout": "held out"}
SEPARABLE = {True: "yes", False: "no", None: "-"}


class Incomparable(UserError):
    """Two runs were not measured alike, or have nothing in common."""


@dataclass(frozen=True)
class Difference:
    """How much higher one method scores than another, over the same architectures and episodes."""

    metric: str
    statistic: str
    first: float
    second: float
    difference: Estimate

    @property
    def separable(self) -> bool | None:
        """Whether the difference of two methods has an interval that leaves out zero.

        None for policies that were picked: their difference says nothing of the methods' others.
        """
        return _leaves_out_zero(self.difference) if self.statistic == "mean" else None


def compare(
    first: str,
    second: str,
    /,
    *,
    task: str = "PickCube-v1",
    split: str = "unseen",
    folders: Folders = FOLDERS,
    as_json: Json = False,
) -> None:
    """Say whether two methods can be told apart, pairing their architectures and episodes.

    Args:
        first: A method with a stored run, or the folder of a run.
        second: The one to compare it with.
        task: The task, if a method is named.
        split: The split, if a method is named.
        folders: Folders to look for runs in; may be repeated.
        as_json: Print JSON.
    """
    stored = results.find(folders)
    runs = [results.resolve(name, stored, task, split) for name in (first, second)]
    differences = differ(*runs)
    if as_json:
        rows = [{**asdict(each), "separable": each.separable} for each in differences]
        places = [str(run.folder) for run in runs]
        print_json({"folders": places, "differences": rows})
    else:
        _print(runs, differences)


def differ(first: StoredRun, second: StoredRun) -> list[Difference]:
    """The differences of two runs' scores, over the architectures and episodes that both have.

    Of `mean`, architectures with their policies are drawn for both methods together, and so are episodes; on `joint`
    each method's policies are drawn for themselves. Of the `top` ones, which are given, only episodes; these are left
    out unless both runs have as many policies of the same architectures. Raises Incomparable if the two were not
    measured alike, or share no architecture or episode.
    """
    ours = first.record.protocol
    parts = {"mean": _everything(first, second)}
    for name, both in _picked(first, second).items():
        parts[name] = _same_episodes(both)
    found = []
    for statistic, (mine, other) in parts.items():
        for metric in ours.metrics:
            a, b = mine.values[metric.column], other.values[metric.column]
            change = _difference(mine, other, metric, ours, drawn=statistic == "mean")
            found.append(Difference(metric.column, statistic, float(a.mean()), float(b.mean()), change))
    return found


def tied(first: StoredRun, second: StoredRun) -> bool:
    """Whether two runs can be compared, and not be told apart in their mean headline score."""
    protocol = first.record.protocol
    try:
        return not _leaves_out_zero(_difference(*_everything(first, second), protocol.metrics[0], protocol, drawn=True))
    except Incomparable:
        return False


def _leaves_out_zero(change: Estimate) -> bool:
    return change.low < change.high and not change.low <= 0 <= change.high


def _everything(first: StoredRun, second: StoredRun) -> tuple[Scores, Scores]:
    """All scores on the architectures and episodes that both have; raises Incomparable as `differ` does."""
    protocol, theirs = first.record.protocol, second.record.protocol
    if not protocol.measures_like(theirs):
        raise Incomparable(f"{_what(protocol)} and {_what(theirs)} are not measured alike and cannot be compared")
    both = [scores.everything(run.episodes, run.record.protocol) for run in (first, second)]
    if not protocol.is_joint:
        shared = set(both[0].architectures.tolist()) & set(both[1].architectures.tolist())
        if not shared:
            raise Incomparable("the two runs have no architecture in common")
        both = [each.of(each.policies[np.isin(each.architectures, sorted(shared))]) for each in both]
    if not set(both[0].seeds.tolist()) & set(both[1].seeds.tolist()):
        raise Incomparable("the two runs have no episode in common")
    return _same_episodes(both)


def _picked(first: StoredRun, second: StoredRun) -> dict[str, tuple[Scores, Scores]]:
    """The selected policies of both, for each kind of selection that both have; none if they chose among other ones."""
    if first.record.protocol.policies != second.record.protocol.policies:
        return {}
    mine, other = (scores.selected(run.episodes, run.record.protocol) for run in (first, second))
    return {
        name: (mine[name], other[name])
        for name in mine
        if name in other and set(mine[name].seeds.tolist()) & set(other[name].seeds.tolist())
    }


def _same_episodes(both: Sequence[Scores]) -> tuple[Scores, Scores]:
    shared = np.intersect1d(both[0].seeds, both[1].seeds)
    mine, other = (each.during(np.isin(each.seeds, shared)) for each in both)
    return mine, other


def _difference(mine: Scores, other: Scores, metric: Metric, protocol: Protocol, *, drawn: bool) -> Estimate:
    values = [each.values[metric.column] for each in (mine, other)]
    if not drawn:
        tables = [values[0].mean(0, keepdims=True) - values[1].mean(0, keepdims=True)]
    elif scores.clusters(mine, protocol) is None:
        tables = [values[0], -values[1]]
    else:  # by_cluster sorts by name, so rows of the two are of the same architecture
        tables = [by_cluster(values[0], mine.architectures) - by_cluster(values[1], other.architectures)]
    bounds = (-1.0, 1.0) if metric.bounds else None  # of a difference of two shares
    return estimate(tables, np.random.default_rng(0), drawn=drawn, bounds=bounds)


def _what(protocol: Protocol) -> str:
    return f"{protocol.task} {protocol.split} (version {protocol.task_version}, simulator {protocol.simulator})"


def _print(runs: Sequence[StoredRun], differences: Sequence[Difference]) -> None:
    """A table of all differences, then the headline's in words."""
    protocol = runs[0].record.protocol
    metrics: dict[str, Metric] = {metric.column: metric for metric in protocol.metrics}
    first, second = (_name(run, runs) for run in runs)
    console = Console(file=sys.stdout, highlight=False, markup=False)
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    for heading in ("score", "", first, second, "difference", "separable"):
        table.add_column(heading, justify="left" if heading in ("score", "") else "right", overflow="fold")
    for each in differences:
        metric = metrics[each.metric]
        both = (f"{value * metric.scale:.1f}" for value in (each.first, each.second))
        name = NAMES[each.statistic] if each.statistic != "top" else f"top-{protocol.best}"
        change = "\n".join(each.difference.text(metric.scale, signed=True))
        table.add_row(metric.heading, name, *both, change, SEPARABLE[each.separable])
    console.print(
        f"{protocol.task}, {protocol.split}: {first} against {second}, on shared architectures and episodes\n"
    )
    console.print(table, end="\n\n")
    console.print(in_words(first, second, differences[0], protocol.metrics[0]))
    console.print("Each interval is of 95 % by itself, so the first line is the one that decides.")
    if any(each.separable is None for each in differences):
        console.print("The best ones were picked: their lines speak of these policies, not of the methods.")
    for name, run in zip((first, second), runs, strict=True):
        console.print(f"{name}: {_place(run)}", soft_wrap=True)


def in_words(first: str, second: str, difference: Difference, metric: Metric) -> str:
    """What a difference of means says, as a sentence."""
    unit = " points" if metric.unit == "%" else ""
    value, interval = difference.difference.text(metric.scale, signed=True)
    if not interval and difference.first == difference.second:
        return f"{first} and {second} have the same mean {metric.label}, and no interval: nothing tells them apart."
    if not interval:
        return (
            f"{first} and {second} cannot be told apart in mean {metric.label}: "
            f"{value}{unit} over too few architectures or episodes for an interval."
        )
    if not difference.separable:
        return (
            f"{first} and {second} cannot be told apart in mean {metric.label}: "
            f"the 95 % interval {interval}{unit} holds zero."
        )
    word, size = "below" if value.startswith("-") else "above", value.lstrip("+-")
    return f"{first} is {word} {second} in mean {metric.label} by {size}{unit} (95 % interval {interval}): separable."


def _place(run: StoredRun) -> Path:
    """The run's folder, seen from here if it is below."""
    folder = run.folder.resolve()
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def _name(run: StoredRun, runs: Sequence[StoredRun]) -> str:
    """A run's method, with its id if both are of one method."""
    name = run.record.method.label
    alike = len({each.record.method.label for each in runs}) < len(runs)
    return f"{name} {run.record.run_id[:6]}" if alike else name
