"""The tasks that give policies meaning: `get("PickCube-v1")`, `names()`."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

from nnit_zoo.errors import unknown_name

if TYPE_CHECKING:
    from nnit_zoo.tasks.task import Task

_CLASSES = {
    "PickCube-v1": "pick_cube.PickCube",
    "PushCube-v1": "push_cube.PushCube",
    "StackCubeEasy-v1": "stack_cube_easy.StackCubeEasy",
    "MNIST-PCA32": "mnist.MNISTPCA32",
}


def names() -> tuple[str, ...]:
    """The names of all tasks; imports none of them, as they need torch."""
    return tuple(_CLASSES)


@cache
def get(name: str) -> Task:
    """The task of this name; raises UserError, with near names, if there is none."""
    if name not in _CLASSES:
        raise unknown_name("task", name, names())
    module, _, kind = _CLASSES[name].partition(".")
    task: Task = getattr(import_module(f"{__name__}.{module}"), kind)()
    return task
