"""How runs are carried out, as options of the command line; imports little, so that `--help` answers at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nnit_zoo.parallel import Backend

Overwrite = Literal["never", "missing", "always"]


@dataclass(frozen=True)
class Execution:
    """How runs are carried out; none of this changes a number."""

    workers: int = 2
    """Processes that simulate."""
    parallel: Backend = "processes"
    """Where they run: on this machine, or on a Ray cluster."""
    output: Path = Path("results")
    """Folder of the result files."""
    overwrite: Overwrite = "missing"
    """What is done for a run that is there unfinished: missing finishes it, never fails; always repeats any run."""
