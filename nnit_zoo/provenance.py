"""Which code is running: the commit of the checkout that this package lies in."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Commit:
    """A commit, and whether the checkout has changes that are not in it; both None outside a checkout.

    Zoos do not count as changes: building one writes it beside the code, and records hold its hashes.
    """

    sha: str | None
    dirty: bool | None

    def __str__(self) -> str:
        """The hash, `-dirty` if there are changes; `unknown` outside a checkout."""
        return "unknown" if self.sha is None else self.sha + "-dirty" * bool(self.dirty)


def commit() -> Commit:
    """The commit of the running code."""
    # Installed inside somebody else's checkout, this file is not that checkout's: git must track it.
    if _git("ls-files", "--error-unmatch", __file__) is None:
        return Commit(None, None)
    changes = _git("status", "--porcelain", "--", ":(top)", ":(top,exclude,glob)nnit_zoo/data/*/**")
    return Commit(_git("rev-parse", "HEAD"), None if changes is None else bool(changes))


def _git(*arguments: str) -> str | None:
    """What git says in the folder of this file; None if it cannot answer there."""
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  fixed words
    except FileNotFoundError:
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
