"""`nnit-bench report`: all stored results as Markdown, JSON, CSV and figures."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nnit_bench import paper, results, scores
from nnit_bench.compare import tied
from nnit_bench.protocol import SPLITS, architectures
from nnit_bench.results import FOLDERS, Folders, StoredRun
from nnit_bench.statistics import Estimate
from nnit_zoo.atomic import write_atomically, write_bytes
from nnit_zoo.console import Json
from nnit_zoo.errors import UserError
from nnit_zoo.tasks.metric import Metric

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVEL_NAMES = 16  # architectures whose names still fit below a figure unless they stand upright
Group = list[StoredRun]
"""The runs of one task and split, a method each, the best first."""


def report(*, folders: Folders = FOLDERS, output: Path = Path("report"), as_json: Json = False) -> None:
    """Write all stored results as tables, and as figures if matplotlib is installed.

    Args:
        folders: Folders to look for runs in; may be repeated.
        output: Folder to write report.md, report.json, report.csv and the figures to.
        as_json: Print the content of report.json.
    """
    runs = list(results.latest(results.find(folders)).values())
    if not runs:
        raise UserError(f"no finished runs in {', '.join(map(str, folders))}; make one with: nnit-bench run")
    groups = _grouped(runs)
    content = json.dumps([_plain(run) for group in groups for run in group], indent=2) + "\n"
    figures: dict[str, Figure] = {}
    if find_spec("matplotlib"):
        figures |= _figures(groups)
    else:
        sys.stderr.write("tables only: figures need matplotlib; run: pip install 'nnit[figures]'\n")
    write_bytes(output / "report.json", content.encode())
    write_bytes(output / "report.csv", _csv(groups).encode())
    write_bytes(output / "report.md", _markdown(groups, figures).encode())
    for name, figure in figures.items():
        _save(figure, output / name)
    written = ["report.md", "report.json", "report.csv", *figures]
    sys.stdout.write(content if as_json else "".join(f"{output / name}\n" for name in written))


def _grouped(runs: Sequence[StoredRun]) -> list[Group]:
    """The runs by task and split in the order of SPLITS, each group from the highest mean headline score."""
    order: list[str] = [*SPLITS]
    groups: dict[tuple[str, int], Group] = {}
    for run in sorted(runs, key=_rank):
        protocol = run.record.protocol
        groups.setdefault((protocol.task, order.index(protocol.split)), []).append(run)
    return [groups[key] for key in sorted(groups)]


def _rank(run: StoredRun) -> tuple[float, str]:
    found = run.summary
    return (-found.estimates[_headline(run).column]["mean"].value if found else 1.0), run.record.method.name


def _headline(run: StoredRun) -> Metric:
    return run.record.protocol.metrics[0]


def _plain(run: StoredRun) -> dict[str, Any]:
    record = run.record.model_copy(update={"results": run.summary})
    return {
        "folder": str(run.folder),
        "shipped": run.is_shipped,
        **record.model_dump(mode="json", exclude={"packages"}),
    }


def _csv(groups: Sequence[Group]) -> str:
    """A line per estimate."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    of_run = ["task", "split", "method", "run_id", "shipped"]
    lines.writerow([*of_run, "architecture", "metric", "statistic", "value", "low", "high"])
    for run in (run for group in groups for run in group if run.summary):
        found = run.summary
        assert found is not None
        protocol = run.record.protocol
        start = [protocol.task, protocol.split, run.record.method.name, run.record.run_id, run.is_shipped]
        for metric, statistics in found.estimates.items():
            for name, each in statistics.items():
                place = found.worst if name == "worst" else ""
                lines.writerow([*start, place, metric, name, each.value, each.low, each.high])
        for architecture, metrics in found.architectures.items():
            for metric, each in metrics.items():
                lines.writerow([*start, architecture, metric, "mean", each.value, each.low, each.high])
    return text.getvalue()


def _markdown(groups: Sequence[Group], figures: dict[str, Figure]) -> str:
    parts = ["# Results\n"]
    for group in groups:
        protocol = group[0].record.protocol
        metric = protocol.metrics[0]
        parts.append(f"## {protocol.task}, {protocol.split}\n")
        parts.append(
            f"Headline: {metric.heading}, with 95 % intervals. `tied with`: cannot be "
            "told apart from these. `nearest known`: median distance (relative L2) to the nearest policy that a "
            "known seed has for the architecture; in brackets as a multiple of that of held-out seeds. "
            "`copies`: policies that are stored ones, if need be cut or padded to size. "
            "`shipped`: run by the project, not here.\n"
        )
        best = f"top-{max(run.record.protocol.best for run in group)}"
        heading = ["method", "mean", best, "held out", "worst architecture", "tied with", "nearest known", "copies"]
        parts.append("| " + " | ".join(heading) + " |\n|---|" + "---:|" * (len(heading) - 1))
        ties = _ties(group)
        parts += [_row(run, group, metric, ties[run.folder]) for run in group]
        parts.append("")
        parts += [f"![{name}]({name})\n" for name in figures if name in _figure_names(group)]
    latest = {
        (run.record.protocol.task, run.record.protocol.split, run.record.method.name): run
        for group in groups
        for run in group
    }
    parts.append("## The paper's tables\n")
    parts += [paper.markdown(table) for make in paper.TABLES.values() for table in make(latest)]
    return "\n".join(parts)


def _ties(group: Group) -> dict[Path, list[str]]:
    """The folder of each run -> the methods that it cannot be told apart from."""
    ties: dict[Path, list[str]] = {run.folder: [] for run in group}
    for one, other in combinations((run for run in group if run.summary), 2):
        if tied(one, other):
            ties[one.folder].append(other.record.method.label)
            ties[other.folder].append(one.record.method.label)
    return ties


def _row(run: StoredRun, group: Group, metric: Metric, ties: Sequence[str]) -> str:
    record = run.record
    marks = [*run.given, "yardstick" * record.method.oracle, "shipped" * run.is_shipped]
    name = ", ".join([record.method.label + _size(run, group), *filter(None, marks)])
    if run.summary is None:
        return f"| {name} | {record.status}: {record.error} |" + " |" * 6
    numbers = run.summary.estimates[metric.column]
    cells = [_cell(numbers.get(name), metric) for name in ("mean", "top", "top_heldout", "worst")]
    if run.summary.worst:
        cells[-1] += f" {run.summary.worst}"
    same = record.novelty and record.novelty.same_architecture
    ratio = "" if not same or same.ratio is None else f" ({same.ratio:.2f})"
    distance = f"{same.median:.1%}{ratio}" if same else "-"
    copies = f"{record.novelty.copies} of {record.protocol.size}" if record.novelty else "-"
    return "| " + " | ".join([name, *cells, ", ".join(ties), distance, copies]) + " |"


def _size(run: StoredRun, group: Group) -> str:
    """How large a run is, if it is smaller than others of its group."""
    sizes = [(each.size, each.select.count) for each in (one.record.protocol for one in group)]
    mine = sizes[group.index(run)]
    return "" if mine == max(sizes) else f" ({mine[0]} policies, {mine[1]} episodes each)"


def _cell(estimate: Estimate | None, metric: Metric) -> str:
    if estimate is None:
        return "-"
    value, interval = estimate.text(metric.scale)
    return f"{value} ({interval})" if interval else value


def _figure_names(group: Group) -> tuple[str, str]:
    protocol = group[0].record.protocol
    return (
        f"architectures-{protocol.task}-{protocol.split}.png",
        f"top-{protocol.task}-{protocol.split}.png",
    )


def _figures(groups: Sequence[Group]) -> Iterator[tuple[str, Figure]]:
    for group in groups:
        scored = [run for run in group if run.summary]
        if scored:
            by_architecture, top = _figure_names(group)
            if not scored[0].record.protocol.is_joint:
                yield by_architecture, _by_architecture(scored)
            yield top, _top_curves(scored)


def _by_architecture(runs: Sequence[StoredRun]) -> Figure:
    """The headline of every architecture and method: a dot with its interval."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    metric = _headline(runs[0])
    asked = {name for run in runs for name in run.record.protocol.policies}
    names = [name for name in architectures(runs[0].record.protocol.split) if name in asked]
    many = len(names) > LEVEL_NAMES
    figure = Figure(figsize=(12 if many else 8, 4), layout="constrained")
    axes = figure.subplots()
    step = 0.7 / len(runs)  # side by side, with a gap between architectures
    for number, run in enumerate(runs):
        found = run.summary
        assert found is not None
        there = [(place, name) for place, name in enumerate(names) if name in found.architectures]
        of = [found.architectures[name][metric.column] for _, name in there]
        places = [place + (number - (len(runs) - 1) / 2) * step for place, _ in there]
        values = [each.value * metric.scale for each in of]
        around = [[(e.value - e.low) * metric.scale for e in of], [(e.high - e.value) * metric.scale for e in of]]
        size, width = (2, 0.5) if many else (5, 1.5)
        axes.errorbar(places, values, around, fmt="o", ms=size, elinewidth=width, label=run.record.method.label)
    axes.set_xticks(range(len(names)), names, rotation=90 if many else 30, fontsize=6 if many else 8)
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.set_xticks([place + 0.5 for place in range(len(names) - 1)], minor=True)
    axes.tick_params(axis="x", which="minor", length=0)
    axes.grid(axis="x", which="minor", color="0.9")
    _finish(figure, axes, runs[0], "architecture; bars: 95 % intervals")
    return figure


def _top_curves(runs: Sequence[StoredRun]) -> Figure:
    """The mean of the best k policies: on the episodes that selected them, and on other ones."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    metric = _headline(runs[0])
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for run in runs:
        same, others = scores.top_curve(run.episodes, run.record.protocol)
        counts = range(1, len(same) + 1)
        (line,) = axes.plot(counts, same * metric.scale, label=run.record.method.label)
        axes.plot(counts, others * metric.scale, "--", color=line.get_color())
    axes.plot([], [], "-", color="black", label="selected and scored\non the same episodes")
    axes.plot([], [], "--", color="black", label="selected on half of\nthem, scored on the\nother half")
    _finish(figure, axes, runs[0], "best k policies")
    return figure


def _finish(figure: Figure, axes: Any, run: StoredRun, below: str) -> None:
    """Title, axes and legend; the y axis reaches as far as the data."""
    protocol = run.record.protocol
    axes.set_title(f"{protocol.task}, {protocol.split}")
    axes.set_ylabel(_headline(run).heading)
    axes.set_xlabel(below)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    figure.legend(fontsize=8, loc="outside right upper")


def _save(figure: Figure, path: Path) -> None:
    write_atomically(
        path,
        # without a name of the software: the same bytes every time
        lambda temporary: figure.savefig(temporary, format="png", dpi=150, metadata={"Software": None}),
    )
