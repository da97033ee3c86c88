"""What a generator of networks is, and how its checkpoint is stored."""

from __future__ import annotations

import json
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError
from nnit_zoo.hub import explained
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
CARD = "README.md"
METADATA = {"format": "pt"}


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
    """Is fitted on the reference policies of the evaluated split: a yardstick, not a method."""


@dataclass(frozen=True)
class FitOptions:
    """How to fit; controls, which have nothing to train, ignore it."""

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
    sampling_steps: int | None = None
    """In how many steps it samples; None for a method without such steps. `nnit-bench run --sampling-steps` sets it."""

    @property
    def description(self) -> str:
        """What its model card says of it: by default the first line of its class's documentation."""
        return (type(self).__doc__ or "").partition("\n")[0]

    @classmethod
    def from_preset(cls, name: str) -> Self:
        """A generator with the named settings, not yet fitted; raises UserError if there are none of that name."""
        raise UserError(f"{cls.__name__} has no presets, so none named '{name}'")

    @abstractmethod
    def fit(self, view: TrainingView, options: FitOptions | None = None) -> None:
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
        from nnit_baselines.registry import address  # noqa: PLC0415  which imports this module

        folder, kind, own = Path(folder), type(self), self.config()
        config = {"method": kind.__name__, "task": self.task, "training": dict(self.training_facts)}
        if taken := sorted(config.keys() & own.keys()):
            raise UserError(f"config() of {kind.__name__} has the reserved key {taken[0]}; give it another name")
        content = json.dumps(config | own, indent=2) + "\n"
        weights = safetensors.torch.save(self.tensors(), METADATA)
        text = card(
            kind.__name__,
            address(kind),
            self.task,
            description=self.description,
            training=self.training_facts,
            licence=self.licence,
        )
        (folder / CONFIG).unlink(missing_ok=True)  # written last, it says that the checkpoint is whole
        write_bytes(folder / WEIGHTS, weights)
        write_bytes(folder / CARD, text.encode())
        write_bytes(folder / CONFIG, content.encode())

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
        """Upload the checkpoint to a model repository of the Hub, made if needed; returns the address of the commit.

        Raises UserError if the Hub refuses.
        """
        with tempfile.TemporaryDirectory() as folder:
            self.save_pretrained(folder)
            with explained(repo_id):
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


def _fetch(source: Path | str) -> Path:
    """The local folder of a checkpoint; what is not a folder is taken for a Hub id."""
    if source == "":
        raise UserError("the checkpoint's name is empty; give a folder, or an id on the Hugging Face Hub")
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
