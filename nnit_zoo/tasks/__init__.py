"""The tasks that give policies meaning: `get("PickCube-v1")`, `names()`; packages add theirs as entry points."""

from __future__ import annotations

import importlib
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from nnit_zoo.errors import UserError, unknown_name

if TYPE_CHECKING:
    from nnit_zoo.tasks.task import Task

BUILT_IN = {
    "PickCube-v1": "nnit_zoo.tasks.pick_cube:PickCube",
    "PushCube-v1": "nnit_zoo.tasks.push_cube:PushCube",
    "StackCubeEasy-v1": "nnit_zoo.tasks.stack_cube_easy:StackCubeEasy",
    "MNIST-PCA32": "nnit_zoo.tasks.mnist:MNISTPCA32",
}
ENTRY_POINTS = "nnit.tasks"


def names() -> tuple[str, ...]:
    """The names of all tasks: built in, then those installed under the entry-point group `nnit.tasks`.

    Imports none of them, so that a broken one stops nothing.
    """
    return tuple(dict.fromkeys([*BUILT_IN, *sorted(entry_points(group=ENTRY_POINTS).names)]))


@cache
def get(name: str) -> Task:
    """The task of this name, a built-in one before an installed one.

    Raises UserError, with near names, if there is none, or if it cannot be loaded.
    """
    installed = entry_points(group=ENTRY_POINTS)
    if name in BUILT_IN:
        address = BUILT_IN[name]
    elif name in installed.names:
        address = installed[name].value
    else:
        raise unknown_name("task", name, names())
    return _load(name, address)


def _load(name: str, address: str) -> Task:
    from nnit_zoo.tasks.task import Task  # noqa: PLC0415  names are listed without torch

    module, _, attribute = address.partition(":")
    try:
        kind = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # a plug-in may fail in any way while it is imported
        raise UserError(f"task '{name}' cannot be loaded from {address}: {error}") from error
    if not (isinstance(kind, type) and issubclass(kind, Task) and kind.name == name):
        raise UserError(f"{address} is not a subclass of nnit_zoo.tasks.task.Task with the name '{name}'")
    return kind()
