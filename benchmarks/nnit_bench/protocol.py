"""What a run measures: the settings that fix it, their defaults, and the episodes that score it."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict, model_validator

from nnit_zoo.architecture import SPLITS, hidden_widths, split_of
from nnit_zoo.errors import UserError, unknown_name

# The first episode seed of each phase. All methods and all runs are scored on the same episodes; building the zoo uses
# none of them (its seeds stay below a billion). The policies picked in `select` are scored again in `report`.
PHASE_SEEDS = {"select": 1_000_000_000, "report": 1_500_000_000}
MOST_EPISODES = 1_000_000

# Policies generated in all, spread evenly over the split's architectures (NNiT table 6 for unseen and table 1 for seen;
# `excluded` is not in the paper and follows unseen).
POLICIES = {"unseen": 80, "seen": 100, "excluded": 90}


class Protocol(BaseModel):
    """The settings of a run that every method shares; two runs compare only if theirs are equal."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int = 1
    """Raised whenever the same settings come to mean something else."""
    task: str
    task_version: int
    split: str
    policies: dict[str, int]
    """How many policies are generated for each architecture, in the order of the split."""
    episodes: int = 50
    """Episodes per policy and phase, with seeds counting up from the phase's first (NNiT 5.2: 50)."""
    top: int = 10
    """How many of the generated policies the top mean takes (NNiT 5.2: 10)."""
    seed: int = 0
    """Seed of the generator's sampling, and its fitting if it has no checkpoint; episodes do not depend on it."""
    phase_seeds: dict[str, int] = PHASE_SEEDS

    @model_validator(mode="after")
    def _sizes(self) -> Protocol:
        if not self.policies or min(self.policies.values()) < 0 or max(self.policies.values()) < 1:
            raise UserError("there is nothing to score: --policies must be 1 or more")
        if not 1 <= self.episodes <= MOST_EPISODES:
            raise UserError(f"--episodes must be from 1 to {MOST_EPISODES}, not {self.episodes}")
        if not 0 <= self.seed < 2**31:
            raise UserError(f"--seed must be from 0 to {2**31 - 1}, not {self.seed}")
        return self

    def seeds(self, phase: str) -> range:
        """The episode seeds of a phase, `select` or `report`."""
        return range(self.phase_seeds[phase], self.phase_seeds[phase] + self.episodes)


def policies_per_architecture(split: str, each: int | None = None, only: Sequence[str] = ()) -> dict[str, int]:
    """How many policies to generate for each architecture of a split.

    `each` is a number for every architecture; by default the protocol's total is spread evenly over the split. `only`
    keeps some of the architectures. Raises UserError for a name that the split does not list.
    """
    listed = hidden_widths(split)
    for name in only:
        if name not in listed:
            raise _not_in_split(name, split, listed)
    total = POLICIES[split] if each is None else each * len(listed)
    # Architecture i gets the whole numbers between i and i + 1 shares: even, and the same whatever `only` says.
    count = len(listed)
    shares = {name: (i + 1) * total // count - i * total // count for i, name in enumerate(listed)}
    return {name: share for name, share in shares.items() if share != 0 and (not only or name in only)}


def _not_in_split(name: str, split: str, listed: Sequence[str]) -> UserError:
    other = split_of(name)
    if other in SPLITS:
        return UserError(f"architecture {name} is not {split} but {other}: add --split {other}")
    return unknown_name("architecture", name, listed)
