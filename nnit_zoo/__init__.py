"""A zoo of small policies: what a policy is, how a zoo is stored, fetched, checked and built.

>>> import nnit_zoo
>>> zoo = nnit_zoo.load("PickCube-v1")  # after `nnit-zoo download --task PickCube-v1`
>>> zoo.batch("32-16-64-32", split="seen")
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nnit_zoo.zoo import Zoo


def load(task: str, folder: Path | str | None = None) -> Zoo:
    """The task's zoo in `folder`, by default where `nnit-zoo download` puts it; see `nnit_zoo.zoo.load`."""
    from nnit_zoo import zoo  # not at the top: `import nnit_zoo` stays free of torch

    return zoo.load(task, folder)
