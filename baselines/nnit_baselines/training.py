"""Train a method on a zoo and write its checkpoint with a model card: what `nnit-bench train` does."""

from __future__ import annotations

import platform
from pathlib import Path

import torch

import nnit_zoo
from nnit_baselines.generator import FitOptions, Generator
from nnit_baselines.registry import get
from nnit_zoo.errors import UserError
from nnit_zoo.files import MANIFEST, sha256_of
from nnit_zoo.provenance import commit


def train(
    method: str, task: str, options: FitOptions, output: Path, zoo_folder: Path | None = None, preset: str | None = None
) -> Generator:
    """Fit `method` on the task's training view and write config.json, model.safetensors and README.md to `output`.

    An interrupted run goes on from `options.folder`. Raises UserError for an unknown method or preset, a method that
    needs no training, or a missing zoo.
    """
    kind = get(method)
    if not kind.capabilities.checkpoint:
        raise UserError(f"{method} needs no training; run: nnit-bench run --method {method}")
    zoo = nnit_zoo.load(task, zoo_folder)
    view = zoo.training_view()
    generator = kind() if preset is None else kind.from_preset(preset)
    generator.fit(view, options)
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
    return generator
