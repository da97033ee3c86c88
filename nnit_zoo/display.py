"""What a person sees while something runs: progress and notes on stderr."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

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
        if self.quiet or not total:
            yield lambda done: None
        elif self._console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                _Rate(),
                TimeRemainingColumn(),
            )
            period = 300  # seconds that the rate is averaged over: some items take minutes
            with Progress(*columns, console=self._console, transient=True, speed_estimate_period=period) as bars:
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
        return Text(_rate(task.speed) if task.speed else "")


def _rate(per_second: float) -> str:
    """Items per second, or per minute or hour if these are few."""
    for unit, seconds in (("s", 1), ("min", 60)):
        if per_second * seconds >= 1:
            return f"{per_second * seconds:.0f}/{unit}"
    return f"{per_second * 3600:.0f}/h"


class _Lines:
    """Progress for logs: a line at the start, every 20 seconds with the rate since the one before, and at the end."""

    def __init__(self, display: Display, label: str, total: int) -> None:
        self._display, self._label, self._total, self._done = display, label, total, 0
        self._start = self._last = time.monotonic()
        self._done_before = 0
        display.note(f"{label}: {total}")

    def advance(self, done: int) -> None:
        self._done += done
        now = time.monotonic()
        if now - self._start < 1:
            self._done_before = self._done  # what an earlier run had finished is no sign of how fast this one is
        if self._done >= self._total:
            self._display.note(f"{self._label}: {self._total} of {self._total} in {_duration(now - self._start)}")
        elif now - self._last >= SECONDS_BETWEEN_LINES and self._done > self._done_before:
            rate = (self._done - self._done_before) / (now - self._last)
            left = _duration((self._total - self._done) / rate)
            self._display.note(f"{self._label}: {self._done} of {self._total}, {_rate(rate)}, {left} left")
            self._last, self._done_before = now, self._done


def _duration(seconds: float) -> str:
    """Seconds, or hours, minutes and seconds if these are many."""
    return f"{seconds:.0f} s" if seconds < 300 else str(timedelta(seconds=round(seconds)))
