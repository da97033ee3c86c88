"""The result tables that `nnit-bench run` prints, 80 columns wide."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from nnit_bench.protocol import Protocol
from nnit_bench.records import Distance, RunRecord
from nnit_bench.runner import Outcome, ZooRow
from nnit_bench.statistics import Estimate
from nnit_zoo.tasks.metric import Metric

STATISTICS = ("mean", "top", "top_heldout", "worst")


@dataclass(frozen=True)
class Results:
    """The runs of one task and split, and the zoo's own row if it has one."""

    protocol: Protocol
    outcomes: Sequence[Outcome]
    zoo: ZooRow | None


def show(results: Results) -> None:
    """Print the scores of all methods, then how new their policies are."""
    protocol, outcomes = results.protocol, results.outcomes
    console = Console(file=sys.stdout, highlight=False, markup=False)
    console.print(f"{_title(protocol)}\n")
    console.print(_scores(results), end="\n\n")
    console.print(f"Below each number its 95 % interval. {_selection(protocol)}")
    if results.zoo:
        which = "seen" if protocol.is_joint else "these"
        selected = ", which selected them" if protocol.is_joint or protocol.split == "seen" else ""
        console.print(
            f"* the {results.zoo.policies} stored policies of {which} architectures, as scored when the zoo was built, "
            f"{results.zoo.episodes} episodes each{selected}; its intervals leave episodes out"
        )
    for outcome in outcomes:
        _remarks(console, outcome)
    if new := [outcome.record for outcome in outcomes if outcome.record.novelty]:
        console.print()
        console.print(_novelty(new), end="\n\n")
        console.print(
            "Median distance to the nearest known policy, in brackets as a multiple of that of held-out seeds. "
            "Weights: relative L2. Actions: root mean square on 2,000 states; errors count there as well. "
            "Copies: within 0.1 % of a known policy."
        )


def plain(results: Results) -> dict[str, Any]:
    """The same as JSON values."""
    runs = [
        {"folder": str(outcome.folder), "reused": outcome.reused, **outcome.record.model_dump(mode="json")}
        for outcome in results.outcomes
    ]
    zoo = results.zoo and TypeAdapter(ZooRow).dump_python(results.zoo, mode="json")
    return {"protocol": results.protocol.model_dump(mode="json"), "runs": runs, "zoo": zoo}


def _title(protocol: Protocol) -> str:
    policies, episodes = _count(protocol.size, "policies", "policy"), protocol.select.count
    listed = _count(len(protocol.policies), "architectures", "architecture")
    chosen = "its own architectures" if protocol.is_joint else listed
    simulator = f", on {protocol.simulator}" if protocol.simulator not in (None, "fast") else ""
    return (
        f"{protocol.task}, {protocol.split}: {policies}, {chosen}, "
        f"{_count(episodes, 'episodes', 'episode')} per policy{simulator}"
    )


def _count(number: int, several: str, one: str) -> str:
    return f"{number} {one if number == 1 else several}"


def _selection(protocol: Protocol) -> str:
    """What the columns of the best policies mean."""
    same = f"top-{protocol.best}: selected and scored on the same episodes"
    if protocol.selection == "paper":
        return f"{same}."
    if protocol.report:
        return f"{same}; held out: the same {_count(protocol.best, 'policies', 'policy')} on others."
    return f"{same}; held out: selected on half of them, scored on the other half."


def _scores(results: Results) -> Table:
    protocol = results.protocol
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("", overflow="fold")
    table.add_column("score", no_wrap=True)
    for heading in ("mean", f"top-{protocol.best}", "held out", "worst arch."):
        table.add_column(heading, justify="right")
    for outcome in results.outcomes:
        record = outcome.record
        if record.results:
            _add(table, record.method.label, protocol.metrics, record.results.estimates, record.results.worst)
        else:
            table.add_row(record.method.label, "", record.status)
            table.add_section()
    if results.zoo:
        _add(table, "zoo *", protocol.metrics, results.zoo.estimates, results.zoo.worst)
    return table


def _add(
    table: Table,
    name: str,
    metrics: Sequence[Metric],
    estimates: Mapping[str, Mapping[str, Estimate]],
    worst: str | None,
) -> None:
    """Add the rows of one method, one per score."""
    for metric in metrics:
        first = metric is metrics[0]
        found = (estimates[metric.column].get(each) for each in STATISTICS)
        cells = ["\n".join(each.text(metric.scale)).strip() if each else "-" for each in found]
        if first and worst:
            cells[-1] += f"\n{worst}"
        table.add_row(name if first else "", metric.heading, *cells)
    table.add_section()


def _remarks(console: Console, outcome: Outcome) -> None:
    """What a method's row does not say: why scores are missing or 0, and which architectures it chose."""
    record = outcome.record
    name = record.method.label
    if record.error:
        console.print(f"{name}: {record.error}")
    if record.method.oracle and record.results:
        console.print(f"{name}: a yardstick, for it was given the zoo's policies of these very architectures")
    for reason, count in outcome.zeroed.items():
        console.print(f"{name}: {count} policies scored 0: {reason}")
    joint = record.results and record.results.joint
    if joint:
        console.print(
            f"{name}: {joint.distinct} different architectures, among them {joint.unseen} of the 8 unseen, "
            f"{joint.excluded} of the 9 excluded and {joint.outside} others beyond the zoo's; {joint.distinct_in_top} "
            f"in the top-{record.protocol.best}; {joint.functional:.0%} of the policies score 50 % or more"
        )


def _novelty(records: Sequence[RunRecord]) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("novelty", overflow="fold")
    for heading in ("known seeds,\nsame arch.", "training set,\nany arch.", "actions", "copies", "cosine of\npairs"):
        table.add_column(heading, justify="right")
    for record in records:
        new = record.novelty
        assert new is not None
        cosine = "-" if new.pairwise_cosine is None else f"{new.pairwise_cosine:.2f}"
        weights = [_distance(each, "%") for each in (new.same_architecture, new.any_architecture)]
        actions = _distance(new.actions, "")
        table.add_row(record.method.label, *weights, actions, str(new.copies), cosine)
    return table


def _distance(distance: Distance | None, unit: str) -> str:
    if distance is None:
        return "-"
    value = f"{distance.median:.1%}" if unit == "%" else f"{distance.median:.3f}"
    return value if distance.ratio is None else f"{value} ({distance.ratio:.2f})"
