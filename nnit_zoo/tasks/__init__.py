"""The tasks that give policies meaning: `get("PickCube-v1")`, `names()`."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING

from nnit_zoo.errors import unknown_name

if TYPE_CHECKING:
    from nnit_zoo.tasks.task import Task

_TASKS = {"PickCube-v1": "nnit_zoo.tasks.pick_cube:PickCube"}


def names() -> tuple[str, ...]:
    """The names of all tasks."""
    return tuple(_TASKS)


@cache
def get(name: str) -> Task:
    """The task of this name; raises UserError, with near names, if there is none."""
    if name not in _TASKS:
        raise unknown_name("task", name, names())
    module, _, attribute = _TASKS[name].partition(":")
    task: Task = getattr(importlib.import_module(module), attribute)()
    return task
