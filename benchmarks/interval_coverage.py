"""How often the benchmark's 95 % intervals hold the truth, in simulated runs whose truth is known: docs/protocol.md.

A run is 8 architectures x 10 policies x 50 episodes of successes. A policy succeeds if level + its architecture's
skill + its own + the episode's ease + noise, all normal, is above 0. Some starts may be hard: few policies master them.

    OMP_NUM_THREADS=1 python benchmarks/interval_coverage.py --runs 1000
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.stats import norm

from nnit_bench.statistics import REPLICATES, TAILS, by_cluster, mean

ARCHITECTURES, POLICIES, EPISODES = 8, 10, 50
MASTERED = 0.04  # of the policies, a hard start
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scenario:
    """What differs, as standard deviations of skill and ease, and how easy the task is."""

    label: str
    architecture: float = 0
    policy: float = 0
    episode: float = 0
    level: float = 1
    hard: float = 0
    """Share of hard starts."""
    joint: bool = False
    """100 policies, each drawn with its architecture."""

    @property
    def truth(self) -> float:
        """The success rate over all architectures, policies and episodes that could have been drawn."""
        spread = (1 + self.architecture**2 + self.policy**2 + self.episode**2) ** 0.5
        return float((1 - self.hard) * norm.cdf(self.level / spread) + self.hard * MASTERED)

    def run(self, rng: np.random.Generator) -> tuple[Floats, NDArray[np.int64] | None]:
        """Successes [policies, episodes] of one run, and the architecture of each policy, None on joint."""
        count = 100 if self.joint else ARCHITECTURES * POLICIES
        clusters = None if self.joint else np.repeat(np.arange(ARCHITECTURES), POLICIES)
        skill = rng.normal(0, self.policy, count)
        if clusters is not None:
            skill += rng.normal(0, self.architecture, ARCHITECTURES)[clusters]
        noise = rng.normal(0, self.episode, EPISODES) + rng.normal(size=(count, EPISODES))
        success = self.level + skill[:, None] + noise > 0
        mastered = rng.random((count, EPISODES)) < MASTERED
        return np.where(rng.random(EPISODES) < self.hard, mastered, success).astype(np.float64), clusters


SCENARIOS = (
    Scenario("policies", policy=1, episode=0.3),
    Scenario("architectures and policies", architecture=0.5, policy=1, episode=0.3),
    Scenario("episodes", policy=0.3, episode=1),
    Scenario("architectures, strongly", architecture=1, policy=0.5, episode=0.3),
    Scenario("nothing; failures are chance"),
    Scenario("all of it, easy", architecture=0.3, policy=0.5, episode=0.5, level=2.5),
    Scenario("architectures, strongly, easy", architecture=1, policy=0.5, episode=0.3, level=2.4),
    Scenario("all of it, very easy", architecture=0.3, policy=0.5, episode=0.5, level=3.3),
    Scenario("policies and episodes, 100 policies as on `joint`", policy=1, episode=0.3, joint=True),
    Scenario("1 % of the starts are hard, the others very easy", level=2.9, hard=0.01),
    Scenario("2 % of the starts are hard, the others very easy", level=2.9, hard=0.02),
    Scenario("4 % of the starts are hard, the others very easy", level=2.9, hard=0.04),
)


def percentiles(table: Floats, rng: np.random.Generator) -> tuple[float, float]:
    """What one might use instead: percentiles of the means of the same draws of units and episodes."""
    units, episodes = (rng.multinomial(n, np.full(n, 1 / n), REPLICATES) / n for n in table.shape)
    low, high = np.quantile(((units @ table) * episodes).sum(1), TAILS).tolist()
    return low, high


def held(scenario: Scenario, seed: int) -> tuple[bool, bool]:
    """Whether this interval, and whether the percentiles, hold the truth in one run."""
    rng = np.random.default_rng(seed)
    values, clusters = scenario.run(rng)
    ours = mean(values, clusters, rng, bounds=(0, 1))
    low, high = percentiles(by_cluster(values, clusters), rng)
    return ours.low <= scenario.truth <= ours.high, low <= scenario.truth <= high


def main() -> None:
    """Print a line of a Markdown table for each scenario."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    sys.stdout.write("| What differs | succeed | this interval | percentiles of the same draws |\n|---|---|---|---|\n")
    with Parallel(n_jobs=options.workers) as pool:
        for scenario in SCENARIOS:
            found = np.array(pool(delayed(held)(scenario, seed) for seed in range(options.runs)))
            ours, others = found.mean(0)
            sys.stdout.write(f"| {scenario.label} | {scenario.truth:.1%} | {ours:.1%} | {others:.1%} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
