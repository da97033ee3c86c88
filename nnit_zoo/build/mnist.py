"""Building MNIST-PCA32's zoo: its features, and GHNs trained on labelled digits.

The paper is silent on how its GHNs were trained here. There is no expert: cross entropy on the training digits, over
seen architectures drawn at random.
"""

from __future__ import annotations

import gzip
import json
import shutil
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors.numpy import save as serialise
from torch import nn

from nnit_zoo.atomic import write_atomically, write_bytes, write_json
from nnit_zoo.build.builder import Builder, log
from nnit_zoo.build.fit import Fit, FitConfig, save_ghn
from nnit_zoo.errors import UserError
from nnit_zoo.files import MANIFEST, sha256_of
from nnit_zoo.ghn import GHN
from nnit_zoo.parallel import Backend
from nnit_zoo.provenance import commit
from nnit_zoo.tasks.mnist import FEATURES, MNISTPCA32

PARTS = {"train": "train", "test": "t10k"}  # part -> how the names of its two original files begin
SOURCES = "a folder with its four IDX files, or ylecun/mnist (needs nnit[datasets])"

Bytes = npt.NDArray[np.uint8]


class MNISTConfig(FitConfig):
    """Settings of each GHN's training, found by trial on one CPU core.

    Many digits per architecture and a strong weight decay raise the accuracy, most where it is lowest; the weight noise
    keeps it when weights are a few per cent off.
    """

    steps: int = 3000
    learning_rate: float = 1e-2
    weight_decay: float = 0.25
    architectures_per_step: int = 2
    states_per_architecture: int = 2048
    weight_noise: float = 0.02


def read_digits(source: str) -> dict[str, tuple[Bytes, Bytes]]:
    """Images [n, 784] and labels [n] of the parts `train` and `test`.

    `source` is a folder with the four original IDX files, gzipped or not, or else a data set that
    `datasets.load_dataset` finds, such as `ylecun/mnist`. Raises UserError if it is neither.
    """
    folder = Path(source)
    if list(folder.glob("*-ubyte*")):
        return {
            part: (
                _read_idx(folder, f"{prefix}-images-idx3-ubyte").reshape(-1, 784),
                _read_idx(folder, f"{prefix}-labels-idx1-ubyte"),
            )
            for part, prefix in PARTS.items()
        }
    try:
        from datasets import load_dataset  # noqa: PLC0415  only this source needs it

        loaded = load_dataset(source)
        return {
            part: (
                np.stack([np.asarray(image, np.uint8).reshape(784) for image in loaded[part]["image"]]),
                np.asarray(loaded[part]["label"], np.uint8),
            )
            for part in PARTS
        }
    except (ImportError, OSError, ValueError, KeyError) as error:
        raise UserError(f"no MNIST in '{source}', but {error}; give {SOURCES}") from None


def _read_idx(folder: Path, name: str) -> Bytes:
    """The array in an IDX file: two zero bytes, the type, the number of axes, their big-endian sizes, the items."""
    path = next((path for path in (folder / name, folder / f"{name}.gz") if path.is_file()), None)
    if path is None:
        raise UserError(f"there is no {name} or {name}.gz in {folder}")
    try:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        axes = content[3]
        shape = np.frombuffer(content, ">u4", axes, offset=4)
        return np.frombuffer(content, np.uint8, offset=4 + 4 * axes).reshape(shape)
    except (OSError, EOFError, IndexError, ValueError, zlib.error) as error:
        raise UserError(f"{path} cannot be read ({error}); fetch it again") from None


def fit_pca(images: Bytes, components: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Mean [784] and leading principal components [components, 784] of images in [0, 1], rounded to float32.

    The sums are over integers, so exact; only the eigenvectors can differ between machines, in their last float64 bits.
    A component's sign is such that its entry of largest size is positive.
    """
    pixels = images.astype(np.float64)
    count, total, products = len(pixels), pixels.sum(0), pixels.T @ pixels
    covariance = products - np.outer(total, total) / count
    _, vectors = np.linalg.eigh(covariance)
    leading = np.ascontiguousarray(vectors[:, : -components - 1 : -1].T)  # safetensors stores memory order
    largest = np.take_along_axis(leading, np.abs(leading).argmax(1)[:, None], axis=1)
    return (total / count / 255).astype(np.float32), (leading * np.sign(largest)).astype(np.float32)


def project(
    images: Bytes, mean: npt.NDArray[np.float32], components: npt.NDArray[np.float32]
) -> npt.NDArray[np.float16]:
    """Features [n, components] of images [n, 784]: computed in float64, rounded once to float16."""
    return ((images / 255 - mean) @ components.T.astype(np.float64)).astype(np.float16)


def build_features(source: str, target: Path) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Write the features and labels of both parts, and the basis, to `target`; gives the task's constants, and facts.

    Basis and constants are fitted on the training digits alone. All components are divided by one number, the root mean
    square of a feature: a unit variance for each of them costs accuracy (docs/deviations.md).
    """
    digits = read_digits(source)
    images = digits["train"][0]
    mean, components = fit_pca(images, MNISTPCA32.inputs)
    tensors: dict[str, npt.NDArray[Any]] = {"mean": mean, "components": components}
    for part, (pictures, labels) in digits.items():
        tensors |= {f"{part}.features": project(pictures, mean, components), f"{part}.labels": labels}
    write_bytes(target, serialise(tensors))
    squares = tensors["train.features"].astype(np.float64) ** 2
    scale = float(np.float32(np.sqrt(squares.mean())))
    constants = {"observation_mean": [0.0] * len(components), "observation_std": [scale] * len(components)}
    kept = squares.sum(1).mean() / (images / 255).var(0).sum()
    return constants, {**{part: len(labels) for part, (_, labels) in digits.items()}, "variance_kept": round(kept, 6)}


def train_ghn(config: MNISTConfig, target: Path, seed: int) -> str:
    """Train one seed's GHN on the training digits; stores its state as float16 safetensors; a log line."""
    torch.set_num_threads(1)
    task = MNISTPCA32()
    observations, labels = task.digits("train")
    ghn = GHN(task.inputs, task.outputs, seed)
    ghn.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a fifth faster
    optimizer = torch.optim.AdamW(
        ghn.parameters(), lr=config.learning_rate, betas=(0.9, 0.98), weight_decay=config.weight_decay
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=config.steps)
    fit = Fit(ghn, config, seed, nn.functional.cross_entropy)
    loss = fit.run(observations, labels, config.steps, optimizer, schedule)
    return save_ghn(ghn, target, seed=seed, loss=loss)


class MNISTBuilder(Builder):
    """Fits the features to the training digits of `source`, and GHNs to the features."""

    stages = ("features", "ghns", "scores", "pack")

    def __init__(
        self,
        task: MNISTPCA32,
        work: Path,
        seeds: int,
        workers: int,
        parallel: Backend = "processes",
        source: str | None = None,
    ) -> None:
        super().__init__(task, work, seeds, workers, parallel)
        self.config = MNISTConfig()
        self.source = source

    def features(self) -> None:
        """Make the features from the digits of `source`; without it, those that are there must do."""
        target = self.data / "task.json"
        if self.source is None:
            if not target.exists():
                raise UserError(f"{self.task.name} has no features yet: name with --source {SOURCES}")
            log("features: done")
            return
        earlier = json.loads(target.read_text())["build"] if target.exists() else {}
        made = self.work / "features" / FEATURES
        constants, facts = build_features(self.source, made)
        if (self.data / MANIFEST).exists() and sha256_of(made) != sha256_of(self.data / FEATURES):
            raise self._other_zoo(f"for other features than those of {self.source}")
        write_atomically(self.data / FEATURES, partial(shutil.copyfile, made))
        content = {"name": self.task.name, "version": self.task.version, **constants}
        write_json(target, {**content, "build": {**earlier, "features": {**facts, "commit": str(commit())}}})
        log(f"features: {json.dumps(facts)}")

    def training(self) -> tuple[Callable[[Path, int], str], dict[str, Any]]:
        """Cross entropy on the training digits; there is no expert."""
        _, labels = MNISTPCA32().digits("train")
        return partial(train_ghn, self.config), {**self.config.model_dump(), "digits": len(labels)}

    def made_from(self) -> dict[str, str]:
        """The features."""
        return {"features_sha256": sha256_of(self.data / FEATURES)}
