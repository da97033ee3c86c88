"""Where generators are found by name or address, and made ready to sample."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import sys
import warnings
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from nnit_baselines.generator import CONFIG, Capabilities, FitOptions, Generator
from nnit_zoo.errors import UserError, unknown_name
from nnit_zoo.zoo import Zoo

BUILT_IN = {
    "nnit": "nnit_baselines.nnit.generator:NNiT",
    "ghn-oracle": "nnit_baselines.controls.stored:GHNOracle",
    "zoo": "nnit_baselines.controls.stored:Stored",
    "noise-0.03": "nnit_baselines.controls.stored:Noise003",
    "noise-0.06": "nnit_baselines.controls.stored:Noise006",
    "noise-0.1": "nnit_baselines.controls.stored:Noise01",
    "mean": "nnit_baselines.controls.stored:Mean",
    "crop": "nnit_baselines.controls.resized:Crop",
    "nearest": "nnit_baselines.controls.resized:Nearest",
    "random": "nnit_baselines.controls.initial:Random",
}
ENTRY_POINTS = "nnit.generators"
CHECKPOINTS = Path(__file__).parent / "checkpoints"
FILE_MODULE = "nnit_method_"
"""Begins the name of the module that a method's file becomes."""


def names() -> tuple[str, ...]:
    """The names of all generators: built in, and installed under the entry-point group `nnit.generators`."""
    return tuple(sorted({*BUILT_IN, *entry_points(group=ENTRY_POINTS).names}))


def available() -> dict[str, type[Generator]]:
    """The classes of all names; an installed plug-in that cannot be loaded is left out with a warning."""
    found = {}
    for name in names():
        try:
            found[name] = get(name)
        except UserError as error:
            warnings.warn(f"method {name} is left out: {error}", stacklevel=2)
    return found


def get(name: str) -> type[Generator]:
    """The generator class with this name, or at `package.module:Class` or `path/to/file.py:Class`.

    A file finds modules beside it, and a module those of the current folder. Raises UserError, with near names, if
    there is no such class.
    """
    if name in BUILT_IN:
        return _load(BUILT_IN[name])
    installed = entry_points(group=ENTRY_POINTS)
    if name in installed.names:
        return _load(installed[name].value)
    if name.endswith(".py"):
        raise UserError(f"'{name}' names no class; write {name}:ClassName")
    if ":" not in name:
        raise unknown_name("method", name, names())
    place, _, _ = name.rpartition(":")
    folder = str(Path(place).resolve().parent if place.endswith(".py") else Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    return _load(name)


def checkpoint(name: str, task: str) -> Path | None:
    """The folder of the checkpoint of this method and task that ships with the package, if there is one."""
    folder = CHECKPOINTS / name / task
    return folder if (folder / CONFIG).is_file() else None


def is_ready(name: str, task: str) -> bool:
    """Whether a method can be used for this task as it is: it needs no checkpoint, or one ships with the package."""
    return not get(name).capabilities.checkpoint or checkpoint(name, task) is not None


def no_checkpoint(name: str, task: str) -> UserError:
    """What to raise for a method that is not ready; it names the command that trains one."""
    train = f"nnit-bench train --method {name} --task {task}"
    return UserError(f"no checkpoint of {name} for {task} ships with nnit; train one with: {train}")


def prepare(name: str, zoo: Zoo, split: str, source: Path | str | None = None, seed: int = 0) -> Generator:
    """The generator called `name`, ready to sample networks of `split` for the zoo's task.

    A trained method is read from `source`, by default from its shipped checkpoint; others are fitted here, with `seed`.
    Raises UserError if there is no checkpoint, or it is for another task, or `source` is given for one that takes none.
    """
    kind = get(name)
    if not kind.capabilities.checkpoint:
        if source is not None:
            raise UserError(f"{name} has no checkpoint, as it needs no training: leave --checkpoint out")
        generator = kind()
        generator.fit(
            zoo.reference_view(split) if kind.capabilities.oracle else zoo.training_view(), FitOptions(seed=seed)
        )
        return generator
    found = checkpoint(name, zoo.task) if source is None else source
    if found is None:
        raise no_checkpoint(name, zoo.task)
    return kind.from_pretrained(found, zoo.task)


def _load(address: str) -> type[Generator]:
    """The class at `module:Class` or `file.py:Class`."""
    place, _, attribute = address.rpartition(":")
    try:
        module = _run_file(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    except UserError:
        raise
    except Exception as error:  # somebody else's code, which may fail in any way
        raise UserError(f"cannot load method '{address}': {type(error).__name__}: {error}") from error
    found = getattr(module, attribute, None)
    if found is None:
        raise unknown_name(f"class in {place}", attribute, [name for name in vars(module) if name[0].isupper()])
    if not (isinstance(found, type) and issubclass(found, Generator)):
        raise UserError(f"'{address}' is not a subclass of nnit_baselines.Generator")
    if missing := sorted(found.__abstractmethods__):
        raise UserError(f"'{address}' does not define {' and '.join(missing)}")
    if not isinstance(getattr(found, "capabilities", None), Capabilities):
        raise UserError(f"'{address}' does not declare what it can do; set capabilities = Capabilities() in the class")
    return found


def address(kind: type[Generator]) -> str:
    """What `get` finds a class by: its name if it has one."""
    if kind.__module__.startswith(FILE_MODULE):
        return f"{Path(inspect.getfile(kind)).name}:{kind.__qualname__}"
    address = f"{kind.__module__}:{kind.__qualname__}"
    named = BUILT_IN | {each.name: each.value for each in entry_points(group=ENTRY_POINTS)}
    return next((name for name, value in named.items() if value == address), address)


def _run_file(path: Path) -> Any:
    place = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:8]  # files of one name are modules of two
    name = f"{FILE_MODULE}{path.stem}_{place}"
    if name in sys.modules:  # like any module, it is loaded once
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise UserError(f"no such file: {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look up their annotations
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
