"""What a run measures: the settings that fix it, and which architectures its splits list; imports no torch.

The settings are the same for every method.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, get_args

from pydantic import BaseModel, ConfigDict, model_validator

from nnit_zoo.architecture import hidden_widths
from nnit_zoo.errors import UserError, unknown_name
from nnit_zoo.tasks.metric import Metric

if TYPE_CHECKING:
    from nnit_zoo.tasks.task import Task

Split = Literal["unseen", "seen", "excluded", "joint", "offgrid", "wide", "deep", "shallow"]
"""The lists of architectures that a run may be on."""
SPLITS: tuple[Split, ...] = get_args(Split)
"""Their names, in the order in which reports show them."""
ANY = "any"
"""The key of `Protocol.policies` on the split `joint`, where the generator chooses the architectures."""

EXTENSIONS: dict[str, tuple[str, ...]] = {
    "offgrid": (
        "24-24-24-24", "40-40-40-40", "24-32-40-64", "40-16-48-32",
        "48-64-24-40", "32-40-64-24", "64-48-16-40", "16-24-32-48",
    ),
    "wide": (
        "96-96-96-96", "128-128-128-128", "128-64-96-32", "64-128-32-96",
        "32-96-64-128", "96-32-128-64", "128-32-32-128", "64-64-64-96",
    ),
    "deep": (
        "32-32-32-32-32", "64-32-16-32-64", "16-32-64-32-16", "64-64-64-64-64",
        "32-32-32-32-32-32", "64-32-32-64-32-32", "16-64-32-64-16-64", "64-64-64-64-64-64",
    ),
    "shallow": (
        "32-32-32", "64-64-64", "64-32-16", "16-32-64",
        "32-64-32", "64-16-64", "16-16-64", "16-64-32",
    ),
}  # fmt: skip
"""Architectures beyond the zoo's grid (not in the paper): other widths, larger widths, other depths."""

POLICIES: dict[str, int] = {"unseen": 80, "seen": 100, "excluded": 90, "joint": 100}
"""Policies generated in all, spread evenly over the split's architectures (NNiT tables 2, 3 and 9, appendix I)."""
DEFAULT_POLICIES = 80
"""The same for the other splits, which are not in the paper and follow `unseen`."""

Selection = Literal["paper", "heldout"]
"""How the best policies are scored, see `Protocol.selection`."""


class _Frozen(BaseModel):
    """Settings that do not change; one that is not known is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class SeedRange(_Frozen):
    """The episodes of a phase: `count` seeds from `first` on."""

    first: int
    count: int

    @property
    def seeds(self) -> range:
        """The seeds in order."""
        return range(self.first, self.first + self.count)


class Protocol(_Frozen):
    """The settings of a run that every method shares."""

    version: int = 1
    """Raised whenever the same settings come to mean something else."""
    task: str
    task_version: int
    simulator: str | None = "fast"
    """What played the episodes: `fast`, `stock` or `stock-gpu`; null for a task that is not simulated."""
    metrics: tuple[Metric, ...]
    """The task's scores; the policies are ranked by the first, ties by the last."""
    split: str
    policies: dict[str, int]
    """How many policies are generated for each architecture, in the order of the split; on `joint` of "any"."""
    selection: Selection = "heldout"
    """Episodes that score the selected: `paper`, those that selected them; `heldout`, others as well."""
    top: int = 10
    """How many of the generated policies are selected (NNiT 6.3: 10)."""
    seed: int = 0
    """Seed of the generator's sampling, and its fitting if it has no checkpoint; episodes do not depend on it."""
    select: SeedRange
    """The episodes that every policy plays (NNiT 6.3: 50)."""
    report: SeedRange | None
    """The episodes that the selected play again; null under `paper`, and for a task whose episodes are a test set. Such
    a set is halved instead: selected on its even seeds, scored on the odd ones."""

    @property
    def size(self) -> int:
        """How many policies are generated in all."""
        return sum(self.policies.values())

    @property
    def best(self) -> int:
        """How many are selected: `top`, if there are as many."""
        return min(self.top, self.size)

    @model_validator(mode="after")
    def _sizes(self) -> Protocol:
        if not self.policies or min(self.policies.values()) < 0 or max(self.policies.values()) < 1:
            raise UserError("there is nothing to score: --policies must be 1 or more")
        check_seed(self.seed)
        return self

    @classmethod
    def of(
        cls,
        task: Task,
        split: str = "unseen",
        *,
        selection: Selection = "heldout",
        policies: int | None = None,
        only: Sequence[str] = (),
        episodes: int | None = None,
        seed: int = 0,
    ) -> Protocol:
        """The protocol of a task; what is not given is the benchmark's default.

        Raises UserError for a split, an architecture or a number that there is not.
        """
        count = task.episodes if episodes is None else episodes
        select, report = (task.phase_seeds(phase, count) for phase in ("select", "report"))
        return cls(
            task=task.name,
            task_version=task.version,
            simulator=task.simulator,
            metrics=task.metrics,
            split=split,
            policies=policies_per_architecture(split, policies, only),
            selection=selection,
            seed=seed,
            select=SeedRange(first=select.start, count=len(select)),
            report=SeedRange(first=report.start, count=len(report)) if report and selection == "heldout" else None,
        )

    @property
    def is_joint(self) -> bool:
        """Whether the generator chooses the architectures."""
        return ANY in self.policies

    def measures_like(self, other: Protocol) -> bool:
        """Whether scores under both may be compared, on the episodes and architectures that both have."""
        kept = {"version", "task", "task_version", "simulator", "metrics", "split"}
        return self.model_dump(include=kept) == other.model_dump(include=kept)


def check_seed(seed: int) -> None:
    """Raise UserError for a seed that PyTorch, NumPy and the run's record cannot all hold."""
    if not 0 <= seed < 2**31:
        raise UserError(f"--seed must be from 0 to {2**31 - 1}, not {seed}")


def architectures(split: str) -> tuple[str, ...]:
    """The hidden widths that a split lists, empty for `joint`; raises UserError for an unknown split."""
    if split not in SPLITS:
        raise unknown_name("split", split, SPLITS)
    if split == "joint":
        return ()
    return EXTENSIONS[split] if split in EXTENSIONS else hidden_widths(split)


def policies_per_architecture(split: str, each: int | None = None, only: Sequence[str] = ()) -> dict[str, int]:
    """How many policies to generate for each architecture of a split; under the key ANY, in all, for `joint`.

    `each` is a number for every architecture; by default the protocol's total is spread evenly over the split. `only`
    keeps some of the architectures. Raises UserError for a name that the split does not list.
    """
    listed = architectures(split)
    for name in only:
        if name not in listed:
            raise _not_in_split(name, split, listed)
    if split == "joint":
        return {ANY: POLICIES[split] if each is None else each}
    total = POLICIES.get(split, DEFAULT_POLICIES) if each is None else each * len(listed)
    # Architecture i gets the whole numbers between i and i + 1 shares: even, and the same whatever `only` says.
    count = len(listed)
    shares = {name: (i + 1) * total // count - i * total // count for i, name in enumerate(listed)}
    return {name: share for name, share in shares.items() if share != 0 and (not only or name in only)}


def _not_in_split(name: str, split: str, listed: Sequence[str]) -> UserError:
    other = next((each for each in SPLITS if name in architectures(each)), None)
    if other:
        return UserError(f"architecture {name} is not {split} but {other}: use --split {other}")
    if split == "joint":
        return UserError("on the split joint the generator chooses the architectures: leave --architecture out")
    return unknown_name("architecture", name, listed)
