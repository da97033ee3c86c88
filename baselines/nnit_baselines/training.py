"""Train a method on a zoo and write its checkpoint with a model card: what `nnit-bench train` does."""

from __future__ import annotations

import platform
from pathlib import Path

import torch

from nnit_baselines.generator import FitOptions, Generator
from nnit_baselines.registry import get
from nnit_zoo.errors import UserError
from nnit_zoo.files import MANIFEST, sha256_of
from nnit_zoo.provenance import commit
from nnit_zoo.zoo import Zoo


def untrained(method: str, preset: str | None = None) -> Generator:
    """A generator called `method` for `train`, with the settings of that preset, or else its own.

    Raises UserError for an unknown method or preset, or a method that needs no training.
    """
    kind = get(method)
    if not kind.capabilities.checkpoint:
        raise UserError(f"{method} needs no training; run: nnit-bench run --method {method}")
    return kind() if preset is None else kind.from_preset(preset)


def train(generator: Generator, zoo: Zoo, options: FitOptions, output: Path, preset: str | None = None) -> None:
    """Fit on the zoo's training view and write config.json, model.safetensors and README.md to `output`.

    An interrupted run goes on from `options.folder`. The record of the training names `preset`.
    """
    output.mkdir(parents=True, exist_ok=True)  # what cannot be written to is told before the work
    view = zoo.training_view()
    generator.fit(view, options)
    generator.task = zoo.task  # also if its author forgot
    generator.training_facts = {
        **generator.training_facts,
        "seed": options.seed,
        **({} if options.steps is None else {"steps": options.steps}),
        **({} if preset is None else {"preset": preset}),
        "policies": len(view),
        "zoo_manifest_sha256": sha256_of(zoo.folder / MANIFEST),
        "git_commit": str(commit()),
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
    }
    generator.save_pretrained(output)
