"""What a score is called, and how people read it; imports no torch, since results are read without it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Metric:
    """A score of a task: a column of its table of episodes, and how people read it."""

    column: Literal["return", "success_once", "success_at_end"]
    """Its column in the table of episodes."""
    label: str
    """Its name in tables."""
    unit: Literal["%", ""]
    """`%` for a share in [0, 1], which is shown times 100; empty for a number that is shown as it is."""

    @property
    def scale(self) -> int:
        """What a value is shown times."""
        return 100 if self.unit == "%" else 1

    @property
    def bounds(self) -> tuple[float, float] | None:
        """The least and the largest value that there can be, if there are such."""
        return (0.0, 1.0) if self.unit == "%" else None

    @property
    def heading(self) -> str:
        """Its name with its unit."""
        return f"{self.label}, {self.unit}" if self.unit else self.label
