"""What a generator of networks is, where it is found by name, and how its checkpoint is stored."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import sys
import tempfile
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, ClassVar, Self

import safetensors.torch
import torch
from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
from safetensors import SafetensorError
from torch import Tensor

from nnit_baselines.card import card
from nnit_zoo.architecture import Architecture
from nnit_zoo.atomic import write_atomically, write_bytes, write_json
from nnit_zoo.errors import UserError, unknown_name
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView, Zoo

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
CONFIG = "config.json"
WEIGHTS = "model.safetensors"
CARD = "README.md"
METADATA = {"format": "pt"}
FILE_MODULE = "nnit_method_"
"""Begins the name of the module that a method's file becomes."""


@dataclass(frozen=True)
class SampleRequest:
    """Wanted: `policies` networks of `architecture`, drawn with `seed`."""

    architecture: Architecture
    policies: int
    seed: int


@dataclass(frozen=True)
class Capabilities:
    """What a generator declares that it can do; the harness asks before it runs."""

    conditional: bool = True
    """Samples networks of a requested architecture."""
    joint: bool = False
    """Samples architecture and weights together (NNiT 6.5)."""
    widths: tuple[int, ...] | None = None
    """The hidden widths that it can make; None = any."""
    depths: tuple[int, ...] | None = None
    """The numbers of hidden layers that it can make; None = any."""
    deterministic: bool = False
    """Has only one network per architecture, whatever the seed."""
    checkpoint: bool = True
    """Is trained beforehand and read from a checkpoint; otherwise `fit` takes no time and is called at every run."""
    oracle: bool = False
    """Is fitted on the reference policies of the evaluated split: an upper bound, not a method."""


@dataclass(frozen=True)
class Run:
    """How a `fit` runs; controls, which have nothing to train, ignore it."""

    steps: int | None = None
    """Optimiser steps; None = the method's own default."""
    seed: int = 0
    folder: Path | None = None
    """Where the state to resume from and the log are kept; None = nowhere."""
    progress: Callable[[int, int], None] | None = None
    """Called with the steps done and the steps in all."""
    track: Callable[[dict[str, float]], None] | None = None
    """Called with each line of the training's log: at least its `step`."""


class Generator(ABC):
    """A source of networks for one task: `fit` on a zoo's view, then `sample`.

    It is made without arguments. A subclass with a checkpoint also says what to store (`config`, `tensors`) and how to
    come back (`from_state`). `nnit-bench check` tells whether one keeps to what is written here.
    """

    capabilities: Capabilities
    """Set by the class; a fitted generator may narrow its own."""
    licence: ClassVar[str | None] = None
    """Of its checkpoints, for their model card, by the Hub's name for it."""
    task: str = ""
    """Name of the task that the networks solve; set by `fit`."""
    training_facts: Mapping[str, Any] = {}
    """What is known of the training, kept in config.json."""

    @classmethod
    def from_preset(cls, name: str) -> Self:
        """A generator with the named settings, not yet fitted; raises UserError if there are none of that name."""
        raise UserError(f"{cls.__name__} has no presets, so none named '{name}'")

    @abstractmethod
    def fit(self, view: TrainingView, run: Run | None = None) -> None:
        """Learn from the policies of a view; raises UserError for a reference view unless this is an oracle."""

    def supports(self, architecture: Architecture) -> bool:
        """Whether `sample` can make networks of this architecture, once fitted; by default, as declared."""
        able, hidden = self.capabilities, architecture.hidden
        return (
            able.conditional
            and (able.depths is None or len(hidden) in able.depths)
            and (able.widths is None or set(hidden) <= set(able.widths))
        )

    @abstractmethod
    def sample(self, request: SampleRequest) -> PolicyBatch:
        """The requested networks, float32, on the CPU: the same for the same request, whatever was asked before.

        Raises UserError if this generator does not support that architecture.
        """

    def sample_joint(self, policies: int, seed: int) -> list[PolicyBatch]:
        """`policies` networks of architectures that it chooses, float32, on the CPU; the same for the same arguments.

        One batch for each architecture chosen, in the order of the architectures. Raises UserError if this generator
        does not choose architectures.
        """
        raise UserError(f"{type(self).__name__} does not choose architectures: request one")

    def config(self) -> dict[str, Any]:
        """What config.json holds besides method, task and training: plain JSON values."""
        raise UserError(f"{type(self).__name__} keeps no checkpoint: it is made from the zoo at every run")

    def tensors(self) -> dict[str, Tensor]:
        """What model.safetensors holds."""
        raise UserError(f"{type(self).__name__} keeps no checkpoint: it is made from the zoo at every run")

    @classmethod
    def from_state(cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """The generator that `config` and `tensors` describe; raises ValueError or KeyError if they do not fit."""
        raise UserError(f"{cls.__name__} keeps no checkpoint: it is made from the zoo at every run")

    def save_pretrained(self, folder: Path | str) -> None:
        """Write config.json, model.safetensors and a model card, the Hub's convention, into `folder`.

        Raises UserError if `config` has a key of ours: method, task or training.
        """
        folder, kind, own = Path(folder), type(self), self.config()
        config = {"method": kind.__name__, "task": self.task, "training": dict(self.training_facts)}
        if taken := sorted(config.keys() & own.keys()):
            raise UserError(f"config() of {kind.__name__} has the reserved key {taken[0]}; give it another name")
        config, tensors = config | own, self.tensors()
        write_atomically(folder / WEIGHTS, lambda path: safetensors.torch.save_file(tensors, path, METADATA))
        write_json(folder / CONFIG, config)
        text = card(kind.__name__, _address(kind), self.task, self.training_facts, self.licence)
        write_bytes(folder / CARD, text.encode())

    @classmethod
    def from_pretrained(cls, source: Path | str, task: str | None = None) -> Self:
        """The generator stored in a folder, or in a repository of the Hub by its id.

        Raises UserError if there is none, if it is damaged or another method's, or if it is for another task than
        `task`.
        """
        folder = _fetch(source)
        try:
            config = json.loads((folder / CONFIG).read_text())
            if config["method"] != cls.__name__:
                raise UserError(f"the checkpoint in {source} is of {config['method']}, not of {cls.__name__}")
            generator = cls.from_state(config, safetensors.torch.load_file(folder / WEIGHTS))
            generator.task, generator.training_facts = config["task"], config["training"]
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
            what = f"{type(error).__name__}: {error}"
            raise UserError(f"the checkpoint in {source} cannot be read: {what}") from error
        if task is not None and generator.task != task:
            raise UserError(f"the checkpoint in {source} is for {generator.task}, not for {task}")
        return generator

    def push_to_hub(self, repo_id: str) -> str:
        """Upload the checkpoint to a model repository of the Hub, made if needed; returns the address of the commit."""
        with tempfile.TemporaryDirectory() as folder:
            self.save_pretrained(folder)
            hub = HfApi()
            hub.create_repo(repo_id, exist_ok=True)
            return str(hub.upload_folder(repo_id=repo_id, folder_path=folder))


def refuse_reference(view: TrainingView) -> None:
    """Raise UserError if the view holds yardsticks, such as unseen architectures, instead of training data."""
    if view.reference:
        raise UserError("a reference view is never for training; use zoo.training_view()")


def check_batch(name: str, batch: object) -> PolicyBatch:
    """What a generator gave, if it is as it must be; raises UserError if not, with `name` as the one who gave it."""
    if not isinstance(batch, PolicyBatch):
        raise UserError(f"{name} gave a {type(batch).__name__}, not a PolicyBatch")
    if types := {layer.dtype for layer in batch.layers} - {torch.float32}:
        raise UserError(f"{name} gave {', '.join(sorted(map(str, types)))}; end with: batch.to(torch.float32)")
    if places := {layer.device.type for layer in batch.layers} - {"cpu"}:
        raise UserError(f"{name} gave networks on {places.pop()}; move their layers to the CPU")
    if any(layer.requires_grad for layer in batch.layers):
        raise UserError(f"{name} gave layers that require a gradient; sample under torch.inference_mode()")
    return batch


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


def prepare(name: str, zoo: Zoo, split: str, source: Path | str | None = None, seed: int = 0) -> Generator:
    """The generator called `name`, ready to sample networks of `split` for the zoo's task.

    A trained method is read from `source`, by default from its shipped checkpoint; others are fitted here, with `seed`.
    Raises UserError if there is no checkpoint, or it is for another task.
    """
    kind = get(name)
    if not kind.capabilities.checkpoint:
        generator = kind()
        generator.fit(zoo.reference_view(split) if kind.capabilities.oracle else zoo.training_view(), Run(seed=seed))
        return generator
    found = source or checkpoint(name, zoo.task)
    if found is None:
        raise UserError(
            f"no checkpoint of {name} for {zoo.task} ships with nnit; "
            f"train one with: nnit-bench train --method {name} --task {zoo.task}"
        )
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
        raise UserError(f"'{address}' is not a subclass of nnit_baselines.generator.Generator")
    if missing := sorted(found.__abstractmethods__):
        raise UserError(f"'{address}' does not define {' and '.join(missing)}")
    if not isinstance(getattr(found, "capabilities", None), Capabilities):
        raise UserError(f"'{address}' does not declare what it can do; set capabilities = Capabilities() in the class")
    return found


def _address(kind: type[Generator]) -> str:
    """What `get` finds the class by: its name if it has one."""
    if kind.__module__.startswith(FILE_MODULE):
        return f"{Path(inspect.getfile(kind)).name}:{kind.__qualname__}"
    address = f"{kind.__module__}:{kind.__qualname__}"
    named = BUILT_IN | {each.name: each.value for each in entry_points(group=ENTRY_POINTS)}
    return next((name for name, value in named.items() if value == address), address)


def _run_file(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(f"{FILE_MODULE}{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise UserError(f"no such file: {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up their annotations
    spec.loader.exec_module(module)
    return module


def _fetch(source: Path | str) -> Path:
    """The local folder of a checkpoint; what is not a folder is taken for a Hub id."""
    if Path(source).is_dir():
        return Path(source)
    if isinstance(source, Path) or Path(source).is_absolute():
        raise UserError(f"no checkpoint folder {source}")
    try:
        return Path(snapshot_download(source, allow_patterns=[CONFIG, WEIGHTS]))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OSError) as error:
        raise UserError(
            f"'{source}' is neither a folder nor a repository of the Hub that can be read: {error}"
        ) from None
