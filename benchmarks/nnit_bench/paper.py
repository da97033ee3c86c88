"""`nnit-bench reproduce`: the paper's tables with our row under each of theirs, from stored runs.

The paper does not say whether success is at the end of an episode or once in it; ours is at the end. What follows its
± is not said either; ours are 95 % intervals.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from typing import Literal

import pyarrow.compute as pc
from pydantic import ValidationError
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable

from nnit_bench import results, scores
from nnit_bench.results import FOLDERS, Folders, StoredRun
from nnit_bench.statistics import Estimate
from nnit_zoo import places
from nnit_zoo.console import Json, print_json

Name = Literal["main", "full-distribution", "joint", "mnist"]
ROBOT_TASKS = ("PickCube-v1", "PushCube-v1", "StackCubeEasy-v1")
MNIST = "MNIST-PCA32"
METHODS = {"NNiT": "nnit", "D2NWG": "d2nwg-packed", "SANE": "sane-2024"}
"""The paper's name of a method -> ours."""
CONTROLS = ("nearest", "crop")
"""What needs no training and is not in the paper: how far one gets with stored policies, padded or cut to size."""
SUCCESS, RETURN = "success_at_end", "return"

# NNiT table 2: (return, ±, success %) of PickCube, PushCube and StackCubeEasy.
MAIN = {
    ("Dataset", "seen"): ((39.37, 0.55, 98), (42.02, 0.4, 100), (39.53, 0.78, 94)),
    ("SANE", "seen"): ((3.81, 0.29, 1), (6.90, 0.25, 6), (4.64, 0.16, 0)),
    ("D2NWG", "seen"): ((38.59, 1.35, 98), (42.28, 0.05, 100), (37.65, 0.69, 90)),
    ("NNiT", "seen"): ((38.77, 0.41, 98), (42.10, 0.16, 100), (38.38, 0.51, 91)),
    ("SANE", "unseen"): ((3.65, 0.41, 1), (5.89, 0.32, 2), (3.71, 0.13, 0)),
    ("D2NWG", "unseen"): ((28.31, 4.53, 59), (37.35, 1.63, 89), (27.18, 2.35, 42)),
    ("NNiT", "unseen"): ((38.70, 0.36, 99), (42.00, 0.19, 100), (36.24, 1.33, 86)),
}
# NNiT table 3.
JOINT = ((38.85, 0.32, 99), (41.99, 0.10, 100), (37.57, 0.85, 90))
# NNiT appendix I, PickCube: different architectures, of the 8 unseen, functional %, different ones in the top 10.
JOINT_ARCHITECTURES = (53, 3, 97, 9)
# NNiT table "Full Distribution on Unseen Architectures": success % of PickCube, PushCube and StackCubeEasy.
FULL_DISTRIBUTION = {
    ("mean", "NNiT"): (78.8, 74.7, 54.9),
    ("mean", "D2NWG"): (15.6, 60.0, 12.2),
    ("top", "NNiT"): (98.8, 100, 86.4),
    ("top", "D2NWG"): (59.4, 89.2, 41.8),
    ("worst", "NNiT"): (64.8, 59.6, 42.6),
    ("worst", "D2NWG"): (5.6, 41.2, 2.0),
}
# NNiT appendix "Validation on the MNIST Benchmark": mean accuracy %, and how many of 80 networks are above 80 %.
MNIST_RESULTS = (96.1, 80)
TOLERANT = (
    "here: of hypernetworks that had weight noise while they learned, so they may bear more of any generator's errors "
    "than the paper's (docs/deviations.md)"
)
PUSH_SCALE = (
    "PushCube-v1, here: rewards as ManiSkill has them since 3.0.0b21, out of 4; out of 3, as they were and as the "
    "paper's may be, our expert's return is higher by 0.6"
)


@dataclass(frozen=True)
class Number:
    """A cell: a value, with what the paper writes behind ±, or with its 95 % interval."""

    value: float
    spread: float | None = None
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, estimate: Estimate, scale: float) -> Number:
        """An estimate of ours, times `scale`."""
        return cls(estimate.value * scale, low=estimate.low * scale, high=estimate.high * scale)

    def __str__(self) -> str:
        """The value, and below it its spread or interval."""
        if self.low is not None and self.high is not None:
            return "\n".join(Estimate(self.value, self.low, self.high).text()).strip()
        return f"{self.value:g}" if self.spread is None else f"{self.value:.2f}\n±{self.spread:.2f}"


@dataclass(frozen=True)
class Row:
    """A row: what it is, whether it is the paper's or ours, and a cell per column, None where there is nothing."""

    label: str
    source: Literal["paper", "here"]
    cells: tuple[Number | None, ...]


@dataclass(frozen=True)
class Table:
    """A table of the paper with our rows in it."""

    title: str
    columns: tuple[str, ...]
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Commands that would fill our empty cells, or why they stay empty; and which cells are of shipped runs."""


def reproduce(*, table: Name = "main", folders: Folders = FOLDERS, as_json: Json = False) -> None:
    """Print a table of the paper with our row under each of its rows, from stored runs.

    Args:
        table: main is its table 2, full-distribution its table of all 80 policies, joint its table 3.
        folders: Folders to look for runs in; may be repeated.
        as_json: Print JSON.
    """
    made = TABLES[table](results.latest(results.find(folders)))
    if as_json:
        print_json([asdict(each) for each in made])
        return
    console = Console(file=sys.stdout, highlight=False, markup=False)
    for each in made:
        shown = RichTable(box=SIMPLE_HEAD, padding=(0, 0), show_edge=False)
        for number, heading in enumerate(("", "", *each.columns)):
            shown.add_column(heading, justify="left" if number < 2 else "right", no_wrap=True)
        for before, row in zip([None, *each.rows], each.rows, strict=False):
            label = "" if before and before.label == row.label else row.label
            shown.add_row(label, row.source, *map(_text, row.cells))
            if row.source == "here":
                shown.add_section()
        console.print(f"{each.title}\n")
        console.print(shown)
        console.print()
    for line in dict.fromkeys(line for each in made for line in each.notes):
        console.print(line, soft_wrap=line.startswith("missing"))  # a command can be copied


def _text(cell: Number | None) -> str:
    return "-" if cell is None else str(cell)


def markdown(table: Table) -> str:
    """The table in Markdown, its title a heading."""
    lines = [f"### {table.title}", "", "| | | " + " | ".join(each.replace("\n", " ") for each in table.columns) + " |"]
    lines.append("|---" * 2 + "|---:" * len(table.columns) + "|")
    for row in table.rows:
        cells = " | ".join(_text(cell).replace("\n", " ") for cell in row.cells)
        lines.append(f"| {row.label} | {row.source} | {cells} |")
    notes = [f"- {note}" for note in dict.fromkeys(table.notes)]
    return "\n".join([*lines, "", *notes, ""] if notes else [*lines, ""])


Latest = Mapping[tuple[str, str, str], StoredRun]


def main_table(runs: Latest) -> list[Table]:
    """The paper's table 2: the ten best policies on seen and unseen architectures."""
    table = Table("NNiT table 2: the ten best policies, on the episodes that selected them", _return_and_success())
    for (name, split), paper in MAIN.items():
        table.rows.append(Row(f"{name}, {split}", "paper", _paper_cells(paper)))
        if name == "Dataset":
            table.rows.append(Row(f"{name}, {split}", "here", _dataset()))
            table.notes.append("Dataset, here: scored on the episodes that selected its policies")
        else:
            table.rows.append(Row(f"{name}, {split}", "here", _ours(table, runs, name, split, "top")))
    _tell_scale(table)
    return [table]


def full_distribution(runs: Latest) -> list[Table]:
    """The paper's table of all 80 policies on unseen architectures."""
    title = "NNiT table 'Full Distribution on Unseen Architectures': success at end, %"
    table = Table(title, ROBOT_TASKS)
    names = {"mean": "mean of 80", "top": "top-10", "worst": "worst arch."}
    for (statistic, name), paper in FULL_DISTRIBUTION.items():
        label = f"{names[statistic]}, {name}"
        table.rows.append(Row(label, "paper", tuple(Number(value) for value in paper)))
        cells = _ours(table, runs, name, "unseen", statistic)[1::2]
        table.rows.append(Row(label, "here", cells))
    for statistic, name in product(names, CONTROLS):
        cells = _ours(table, runs, name, "unseen", statistic)[1::2]
        table.rows.append(Row(f"{names[statistic]}, {name}", "here", cells))
    table.notes.append(f"{', '.join(CONTROLS)}: not in the paper; stored policies, padded or cut to size, no training")
    return [table]


def joint(runs: Latest) -> list[Table]:
    """The paper's table 3 and its appendix on what was chosen: architecture and weights together."""
    selected = Table("NNiT table 3: 100 policies of its own architectures, the ten best", _return_and_success())
    selected.rows.append(Row("NNiT", "paper", _paper_cells(JOINT)))
    selected.rows.append(Row("NNiT", "here", _ours(selected, runs, "NNiT", "joint", "top")))
    _tell_scale(selected)
    columns = ("different\narchitectures", "of the 8\nunseen", "functional, %", "different\nin top-10")
    chosen = Table("NNiT appendix 'Architecture Diversity under Joint Sampling': PickCube-v1", columns)
    chosen.rows.append(Row("NNiT", "paper", tuple(Number(value) for value in JOINT_ARCHITECTURES)))
    run = runs.get((ROBOT_TASKS[0], "joint", METHODS["NNiT"]))
    found = run and run.summary and run.summary.joint
    numbers = (found.distinct, found.unseen, found.functional * 100, found.distinct_in_top) if found else None
    cells = tuple(map(Number, numbers)) if numbers else (None,) * len(columns)
    chosen.rows.append(Row("NNiT", "here", cells))
    return [selected, chosen]


def mnist(runs: Latest) -> list[Table]:
    """The paper's appendix on MNIST: 80 networks of unseen architectures."""
    table = Table("NNiT appendix on MNIST, unseen architectures", ("mean accuracy, %", "above 80 %, of 80"))
    table.rows.append(Row("NNiT", "paper", tuple(Number(value) for value in MNIST_RESULTS)))
    cells: tuple[Number | None, ...] = (None, None)
    run = _find(table, runs, MNIST, "unseen", "NNiT")
    if run and run.summary:
        accuracy = scores.everything(run.episodes, run.record.protocol).values[RETURN].mean(1)
        mean = Number.of(run.summary.estimates[RETURN]["mean"], 100)
        cells = (mean, Number(int((accuracy > 0.8).sum())))
    table.rows.append(Row("NNiT", "here", cells))
    return [table]


TABLES: dict[Name, Callable[[Latest], list[Table]]] = {
    "main": main_table,
    "full-distribution": full_distribution,
    "joint": joint,
    "mnist": mnist,
}


def _return_and_success() -> tuple[str, ...]:
    """A column each for return and success of every robot task; the headings fit 80 columns."""
    names = (task.removesuffix("-v1").replace("StackCube", "Stack") for task in ROBOT_TASKS)
    return tuple(heading for name in names for heading in (f"{name}\nreturn", "\nsuccess"))


def _paper_cells(paper: Iterable[tuple[float, float, float]]) -> tuple[Number, ...]:
    return tuple(cell for value, spread, success in paper for cell in (Number(value, spread), Number(success)))


def _ours(table: Table, runs: Latest, name: str, split: str, statistic: str) -> tuple[Number | None, ...]:
    """Return and success of one of our runs on each robot task; notes in the table what is missing."""
    cells: list[Number | None] = []
    for task in ROBOT_TASKS:
        run = _find(table, runs, task, split, name)
        if run and run.summary:
            estimates = run.summary.estimates
            cells += [Number.of(estimates[RETURN][statistic], 1), Number.of(estimates[SUCCESS][statistic], 100)]
        else:
            cells += [None, None]
    return tuple(cells)


def _tell_scale(table: Table) -> None:
    """Note what our returns on PushCube-v1 are out of, if a table of returns and successes has one."""
    column = 2 * ROBOT_TASKS.index("PushCube-v1")
    if any(row.source == "here" and row.cells[column] for row in table.rows):
        table.notes.append(PUSH_SCALE)


def _find(table: Table, runs: Latest, task: str, split: str, name: str) -> StoredRun | None:
    """The stored run of a method of the paper; without one, notes in the table what makes it."""
    method = METHODS.get(name, name)
    run = runs.get((task, split, method))
    if run is None:
        there = method in _methods()
        make = f"missing: {results.command(method, task, split)}"
        table.notes.append(make if there else f"missing: {name} is not in this version of nnit")
    elif run.summary is None:
        table.notes.append(f"unsupported: {name} on {task}, {split}: {run.record.error}")
    elif not run.is_whole:
        table.notes.append(f"in part: the run of {name} on {task}, {split} has not all policies of the protocol")
    if run and run.given:
        table.notes.append(f"with {', '.join(run.given)}: {name} on {task}, {split}")
    if run and run.is_shipped:
        table.notes.append(f"shipped, not run here: {name} on {task}, {split}")
    if run and name == "NNiT" and (preset := _preset(run)) != "paper":
        settings = f"preset {preset}" if preset else "settings of its own"
        table.notes.append(f"NNiT, here: {settings}, not the paper's (docs/nnit.md)")
    if run and task in ROBOT_TASKS:
        table.notes.append(TOLERANT)
    return run


def _preset(run: StoredRun) -> str | None:
    """The preset of NNiT that a run's settings are, whatever their number of steps; None if they are of no preset."""
    method = run.record.method
    if preset := method.training.get("preset"):
        return str(preset)
    from nnit_baselines.nnit.config import NNiTConfig, preset_name  # noqa: PLC0415  imports torch

    try:
        return preset_name(NNiTConfig.model_validate(method.config["settings"]))
    except (KeyError, ValidationError):  # of another version, or not of ours
        return None


def _methods() -> Sequence[str]:
    from nnit_baselines import registry  # noqa: PLC0415  imports torch, which a complete table does not need

    return registry.names()


def _dataset() -> tuple[Number | None, ...]:
    """Mean return and success of each robot task's zoo, over its seen architectures."""
    cells: list[Number | None] = []
    for task in ROBOT_TASKS:
        if task in places.tasks_with_zoo():
            index = places.index(task)
            seen = index.filter(pc.equal(index["split"], "seen"))
            for column, scale in ((RETURN, 1), (SUCCESS, 100)):
                cells.append(Number(round(pc.mean(seen[column]).as_py() * scale, 1)))
        else:
            cells += [None, None]
    return tuple(cells)
