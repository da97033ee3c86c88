"""Zoo: a task's stored policies, read through an Arrow index and memory-mapped safetensors shards."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import torch
from safetensors import SafetensorError, safe_open
from torch import nn

from nnit_zoo import files, places, tasks
from nnit_zoo.architecture import Architecture, split_of
from nnit_zoo.display import Display
from nnit_zoo.download import Download
from nnit_zoo.errors import UserError, unknown_name
from nnit_zoo.files import HELDOUT_SEEDS_FROM, SPLITS
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.summary import by_split


@dataclass(frozen=True)
class Policy:
    """One stored policy: its row of the index, and its weights as a batch of one."""

    record: Mapping[str, Any]
    weights: PolicyBatch

    def __repr__(self) -> str:
        known = (f"{score} {self.record[score]:.3g}" for score in files.SCORES if self.record[score] is not None)
        return f"<Policy {self.record['id']}: {', '.join((self.record['split'], *known))}>"

    def to_module(self, *, standardised: bool = False) -> nn.Sequential:
        """The policy as a plain float32 nn.Sequential of Linear and Tanh.

        It takes raw observations, as the task's environment gives them: the task's standardisation is folded into its
        first layer. With `standardised`, it takes observations that are standardised already.
        """
        if standardised:
            return self.weights.to_module(0)
        task = tasks.get(self.record["task"])
        mean, std = torch.from_numpy(task.observation_mean), torch.from_numpy(task.observation_std)
        return self.weights.to_module(0, mean, std)


class Zoo:
    """The policies of one task in a folder; open one with `Zoo.open` or `nnit_zoo.load`.

    Iterating gives every `Policy` in index order, and `zoo["PickCube-v1/32-16-64-32/002"]` the one with that id.
    `index` has a row per policy: id, task, architecture, ghn_seed, split, success_once, success_at_end, return,
    episodes, shard, row, sha256, n_params, weight_norm. `split` is `seen`, `unseen`, `excluded`, or `heldout_seed` for
    GHN seeds from 128 on.
    """

    def __init__(self, folder: Path, manifest: files.Manifest, index: pa.Table) -> None:
        self.folder = folder
        self.manifest = manifest
        self.index = index
        self._shards: dict[str, PolicyBatch] = {}

    @classmethod
    def open(cls, folder: Path | str) -> Zoo:
        """The zoo in `folder`; raises UserError if there is none or its index is damaged."""
        folder = Path(folder)
        manifest = files.Manifest.read(folder)
        if not manifest.index.describes(folder / files.INDEX):
            raise damaged(folder / files.INDEX, manifest.task)
        wanted = manifest.standardisation
        if wanted is not None and wanted != tasks.get(manifest.task).standardisation:
            raise UserError(
                f"the policies in {folder} expect observations that are standardised otherwise than by this version of "
                "nnit; use the version that made them"
            )
        return cls(folder, manifest, files.read_index(folder / files.INDEX))

    def check_whole(self) -> None:
        """Raise UserError unless all files of the zoo are there and as its manifest promises."""
        for name in self.manifest.missing(self.folder, self.manifest.files):
            raise damaged(self.folder / name, self.task)

    @property
    def task(self) -> str:
        """Name of the task that the policies solve."""
        return self.manifest.task

    def __repr__(self) -> str:
        splits = ", ".join(f"{row['policies']:,} {split}" for split, row in by_split(self.index).items())
        return f"<Zoo of {self.task} in {self.folder}: {len(self):,} policies ({splits})>"

    def __len__(self) -> int:
        return int(self.index.num_rows)

    def __iter__(self) -> Iterator[Policy]:
        return (self._policy(record) for batch in self.index.to_batches() for record in batch.to_pylist())

    def __getitem__(self, policy: str) -> Policy:
        """The policy with this id; raises UserError if there is none."""
        rows = self.index.filter(pc.equal(self.index["id"], policy)).to_pylist()
        if not rows:
            raise unknown_name("policy", policy, self.index["id"].to_pylist())
        return self._policy(rows[0])

    def filter(self, condition: pc.Expression) -> Zoo:
        """The zoo of the policies for which a condition on index columns holds.

        An example is `zoo.filter(pc.field("return") > 39)` with `import pyarrow.compute as pc`. Raises UserError for a
        condition that the index cannot answer.
        """
        try:
            rows = self.index.filter(condition)
        except pa.ArrowException as error:
            raise UserError(f"cannot filter by {condition}: {error}") from None
        return Zoo(self.folder, self.manifest, rows)

    def architectures(self, split: str) -> tuple[Architecture, ...]:
        """The architectures that have policies in `split`, in index order; raises UserError for an unknown split."""
        if split not in SPLITS:
            raise unknown_name("split", split, SPLITS)
        rows = self.index.filter(pc.equal(self.index["split"], split))
        return tuple(self.parse(text) for text in pc.unique(rows["architecture"]).to_pylist())

    def batch(self, architecture: Architecture | str, split: str | None = None) -> PolicyBatch:
        """The policies of an architecture in one split, or in all, as stored: float16, memory-mapped, in index order.

        Raises UserError if there are none, or if the shard is missing or damaged (its SHA-256 is checked once).
        """
        rows = self._rows(str(architecture), split)["row"].to_pylist()
        # An architecture's rows are sorted by GHN seed, so those of a split are neighbours: a slice stays mapped.
        together = rows[-1] - rows[0] == len(rows) - 1
        return self._shard(str(architecture))[slice(rows[0], rows[-1] + 1) if together else rows]

    def ghn_seeds(self, architecture: Architecture | str, split: str | None = None) -> tuple[int, ...]:
        """The GHN seed of each policy of `batch(architecture, split)`."""
        return tuple(self._rows(str(architecture), split)["ghn_seed"].to_pylist())

    def training_view(self) -> TrainingView:
        """What a generator may learn from: the policies of seen architectures and training seeds."""
        return self._view("seen", reference=False)

    def reference_view(self, split: str) -> TrainingView:
        """The policies of a split as a yardstick (oracle row, novelty), marked so that no generator trains on them.

        Raises UserError if the zoo has none.
        """
        if not self.architectures(split):
            raise UserError(f"the zoo of {self.task} has no policies in split '{split}'")
        return self._view(split, reference=True)

    def _view(self, split: str, *, reference: bool) -> TrainingView:
        architectures = self.architectures(split)
        batches = {architecture: self.batch(architecture, split) for architecture in architectures}
        seeds = {architecture: self.ghn_seeds(architecture, split) for architecture in architectures}
        return TrainingView(self.task, batches, seeds, reference)

    def _policy(self, record: dict[str, Any]) -> Policy:
        row = record["row"]
        return Policy(record, self._shard(record["architecture"])[row : row + 1])

    def parse(self, text: str) -> Architecture:
        """The architecture with these hidden widths and the zoo's inputs and outputs."""
        return Architecture.parse(text, self.manifest.inputs, self.manifest.outputs)

    def _rows(self, architecture: str, split: str | None) -> pa.Table:
        chosen = pc.equal(self.index["architecture"], architecture)
        if split is not None:
            chosen = pc.and_(chosen, pc.equal(self.index["split"], split))
        rows = self.index.filter(chosen)
        if not rows.num_rows:
            splits = SPLITS if split is None else (split,)
            names = {str(each) for name in splits for each in self.architectures(name)}
            place = "zoo" if split is None else split
            raise unknown_name(f"{place} architecture", architecture, names)
        return rows

    def _shard(self, architecture: str) -> PolicyBatch:
        if architecture not in self._shards:
            name = f"{architecture}.safetensors"
            path = self.folder / name
            if not self.manifest.shards[name].describes(path):
                raise damaged(path, self.task)
            self._shards[architecture] = read_shard(path, self.parse(architecture))
        return self._shards[architecture]


@dataclass(frozen=True)
class TrainingView:
    """Policies per architecture, given to generators; refuses what they must not learn from.

    A view marked `reference` holds yardsticks instead, and `Generator.fit` refuses it. Without `seeds`, as in tests,
    a policy's GHN seed is its row number. Raises UserError if it is not a reference view and holds an unseen or
    excluded architecture or a held-out seed.
    """

    task: str
    batches: Mapping[Architecture, PolicyBatch]
    seeds: Mapping[Architecture, tuple[int, ...]] | None = None
    reference: bool = False

    def __post_init__(self) -> None:
        if self.reference:
            return
        for architecture in self.batches:
            if split_of(architecture) in ("unseen", "excluded"):
                raise UserError(f"{architecture} is {split_of(architecture)}: its policies are never for training")
            if max(self.ghn_seeds(architecture), default=0) >= HELDOUT_SEEDS_FROM:
                raise UserError(f"GHN seeds from {HELDOUT_SEEDS_FROM} on are held out: never for training")

    def __repr__(self) -> str:
        use = "for comparison only" if self.reference else "to learn from"
        return f"<TrainingView of {self.task}: {len(self):,} policies of {len(self.batches)} architectures, {use}>"

    @property
    def architectures(self) -> tuple[Architecture, ...]:
        """The architectures that have policies here."""
        return tuple(self.batches)

    def batch(self, architecture: Architecture | str) -> PolicyBatch:
        """The policies of an architecture in float32; raises UserError if it is not in this view."""
        return self.batches[self._here(architecture)].to(torch.float32)

    def ghn_seeds(self, architecture: Architecture | str) -> tuple[int, ...]:
        """The GHN seed of each policy of `batch(architecture)`; raises UserError if it is not in this view."""
        here = self._here(architecture)
        return tuple(range(len(self.batches[here]))) if self.seeds is None else self.seeds[here]

    def __len__(self) -> int:
        return sum(map(len, self.batches.values()))

    def _here(self, architecture: Architecture | str) -> Architecture:
        for here in self.batches:
            if str(here) == str(architecture):
                return here
        if not self.reference and split_of(architecture) in ("unseen", "excluded"):
            raise UserError(f"{architecture} is {split_of(architecture)}: its policies are never for training")
        raise unknown_name("architecture in this view", str(architecture), map(str, self.batches))


def load(task: str, folder: Path | str | None = None, *, download: bool = False) -> Zoo:
    """The task's zoo in `folder`, by default where `nnit-zoo download` puts it.

    With `download`, a zoo that is not there is made first, as that command does; in the default folder, one of another
    version is replaced. Raises UserError, naming the command that helps, if the zoo is missing, damaged, another
    task's, or another version's.
    """
    place = None if folder is None else Path(folder)
    if download and (place is None or not (place / files.MANIFEST).is_file()):
        Download(task, place).ensure(Display(quiet=False))
    return Zoo.open(locate(task, place))


def locate(task: str, folder: Path | None = None) -> Path:
    """The folder of the task's zoo, if its manifest is the expected one; raises UserError as `load` does."""
    place = places.default_folder(task) if folder is None else folder
    release = places.manifest(task) if folder is None else None
    if not (place / files.MANIFEST).is_file():
        raise UserError(f"no zoo of {task} in {place} yet; run: {places.download_command(task, place)}")
    manifest = files.Manifest.read(place)
    if manifest.task != task:
        raise UserError(f"{place} holds the zoo of {manifest.task}, not of {task}")
    if release is not None and manifest != release:
        raise UserError(
            f"the zoo in {place} is from another version of nnit; run: {places.download_command(task, place)}"
        )
    return place


def read_shard(path: Path, architecture: Architecture) -> PolicyBatch:
    """All policies in a shard, memory-mapped; raises UserError if the file is not such a shard.

    Tensor `layers.L` is layer L of every policy, float16 [n, out, in + 1].
    """
    try:
        with safe_open(path, framework="pt") as shard:
            layers = tuple(shard.get_tensor(f"layers.{depth}") for depth in range(len(architecture.block_shapes)))
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path} is not a shard of {architecture}: {error}") from None
    return PolicyBatch(architecture, layers)


def policy_hashes(batch: PolicyBatch) -> list[str]:
    """Each policy's SHA-256: of its stored parameters, layer by layer, row by row, as in `PolicyBatch.flat`."""
    return [hashlib.sha256(flat.tobytes()).hexdigest() for flat in batch.flat().numpy()]


def damaged(path: Path, task: str) -> UserError:
    """The error for a file of a zoo that is not what the manifest promises."""
    return UserError(f"{path} is missing or damaged; mend it with: {places.download_command(task, path.parent)}")
