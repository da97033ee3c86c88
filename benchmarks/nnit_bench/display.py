"""What a person sees of a run: progress and notes on stderr, the result table on stdout."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from nnit_bench.protocol import Protocol
from nnit_bench.statistics import METRICS, Estimate, Summary

if TYPE_CHECKING:
    from nnit_bench.runner import Outcome, ZooRow

SECONDS_BETWEEN_LINES = 20


class Display:
    """Notes and progress on stderr: bars on a terminal, else a line now and then, nothing at all if `quiet`."""

    def __init__(self, quiet: bool) -> None:
        self.quiet = quiet
        self._console = Console(stderr=True)

    def note(self, text: str) -> None:
        """Say something that is not a result."""
        if not self.quiet:
            self._console.print(Text(text), soft_wrap=True)

    @contextmanager
    def stage(self, label: str, total: int) -> Iterator[Callable[[int], None]]:
        """Show a stage of work; gives a function that takes the number of newly finished items."""
        if self.quiet:
            yield lambda done: None
        elif self._console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                _Rate(),
                TimeRemainingColumn(),
            )
            with Progress(*columns, console=self._console, transient=True) as bars:
                bar = bars.add_task(label, total=total)
                yield lambda done: bars.advance(bar, done)
        else:
            yield _Lines(self, label, total).advance

    @contextmanager
    def steps(self, label: str) -> Iterator[Callable[[int, int], None]]:
        """Show work that says itself how much it is; gives a function that takes the items done and those in all."""
        with ExitStack() as stack:
            done_before = 0
            advance: Callable[[int], None] | None = None

            def report(done: int, total: int) -> None:
                nonlocal done_before, advance
                advance = advance or stack.enter_context(self.stage(label, total))
                advance(done - done_before)
                done_before = done

            yield report


class _Rate(TextColumn):
    """Finished items per second."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.0f}/s" if task.speed else "")


class _Lines:
    """Progress for logs: a line at the start, every 20 seconds, and at the end."""

    def __init__(self, display: Display, label: str, total: int) -> None:
        self._display, self._label, self._total, self._done = display, label, total, 0
        self._start = self._last = time.monotonic()
        display.note(f"{label}: {total}")

    def advance(self, done: int) -> None:
        self._done += done
        now = time.monotonic()
        seconds = now - self._start
        if self._done >= self._total:
            self._display.note(f"{self._label}: {self._total} of {self._total} in {seconds:.0f} s")
        elif now - self._last >= SECONDS_BETWEEN_LINES and self._done:
            left = seconds / self._done * (self._total - self._done)
            rate = self._done / seconds
            self._display.note(f"{self._label}: {self._done} of {self._total}, {rate:.0f}/s, {left:.0f} s left")
            self._last = now


LABELS = {"success_at_end": "at end, %", "success_once": "once, %", "return": "return"}


def print_table(protocol: Protocol, outcomes: Sequence[Outcome], zoo_row: ZooRow | None) -> None:
    """Print the result table on stdout: a row per method and score, and the zoo's own."""
    policies, architectures = sum(protocol.policies.values()), len(protocol.policies)
    top = f"top-{protocol.top}"
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("", overflow="fold")
    table.add_column("success", no_wrap=True)
    for heading in ("mean", top, "held out", "worst arch."):
        table.add_column(heading, justify="right")
    for outcome in outcomes:
        _add(table, outcome.record.method.name.rpartition("/")[2], outcome.summary)
    if zoo_row:
        _add(table, "zoo *", zoo_row.summary)
    console = Console(file=sys.stdout, highlight=False, markup=False)
    console.print(
        f"{protocol.task}, {protocol.split}: {policies} policies, {architectures} architectures, "
        f"{protocol.episodes} episodes per policy\n"
    )
    console.print(table, end="\n\n")
    console.print(
        f"Below each number its 95 % interval. {top}: chosen and scored on the same episodes; held out: the same "
        f"{protocol.top} policies on others."
    )
    if zoo_row:
        console.print(
            f"* the {zoo_row.policies} stored policies of these architectures, as scored when the zoo was built, "
            f"{zoo_row.episodes} episodes each"
        )
    for outcome in outcomes:  # a row of zeros should say why
        for reason, count in outcome.zeroed.items():
            console.print(f"{outcome.record.method.name}: {count} policies scored 0: {reason}")


def _add(table: Table, name: str, summary: Summary) -> None:
    """Add the rows of one method, one per score."""
    for metric in METRICS:
        scale = 1 if metric == "return" else 100
        numbers = summary.estimates[metric]
        cells = [_cell(numbers.get(column), scale) for column in ("mean", "top", "top_heldout", "worst")]
        if metric == METRICS[0]:
            cells[-1] += f"\n{summary.worst}"
        table.add_row(name if metric == METRICS[0] else "", LABELS[metric], *cells)
    table.add_section()


def _cell(estimate: Estimate | None, scale: int) -> str:
    if estimate is None:
        return "-"
    value, low, high = (f"{number * scale:.1f}".replace("100.0", "100") for number in estimate)  # fits 80 columns
    return f"{value}\n{low}-{high}"
