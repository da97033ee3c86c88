"""Which zoos ship with this package, and in which folders zoos lie; imports no torch."""

from __future__ import annotations

import shlex
from pathlib import Path

import pyarrow as pa
from huggingface_hub.constants import HF_ASSETS_CACHE

from nnit_zoo import tasks
from nnit_zoo.errors import UserError, unknown_name
from nnit_zoo.files import INDEX, MANIFEST, Manifest, read_index

DATA = Path(__file__).parent / "data"
CACHE = Path(HF_ASSETS_CACHE).expanduser() / "nnit" / "zoo"
"""Where zoos are put unless a folder is named: in the assets cache of huggingface_hub, which HF_HOME moves."""


def data_folder(task: str) -> Path:
    """The folder of the package that holds what is shipped of a task, and that `nnit-zoo build` writes."""
    return DATA / task


def tasks_with_zoo() -> tuple[str, ...]:
    """The tasks whose zoo ships with this package."""
    return tuple(sorted(path.parent.name for path in DATA.glob(f"*/{MANIFEST}")))


def manifest(task: str) -> Manifest:
    """The manifest of the zoo that ships for the task; raises UserError, with what to do, if none does."""
    return Manifest.read(_shipped(task))


def index(task: str, architecture: str | None = None) -> pa.Table:
    """The index of the zoo that ships for the task, or one architecture's rows of it; raises UserError likewise."""
    return read_index(_shipped(task) / INDEX, architecture)


def _shipped(task: str) -> Path:
    if task in tasks_with_zoo():
        return data_folder(task)
    if task in tasks.names():
        raise UserError(f"{task} has no zoo yet; build it with: nnit-zoo build --task {task}")
    raise unknown_name("zoo", task, tasks_with_zoo())


def default_folder(task: str) -> Path:
    """Where `nnit-zoo download` puts the task's zoo."""
    return CACHE / task


def download_command(task: str, folder: Path) -> str:
    """The command that makes the zoo in `folder`, or mends it."""
    where = "" if folder.resolve() == default_folder(task).resolve() else f" --folder {shlex.quote(str(folder))}"
    return f"nnit-zoo download --task {task}{where}"
