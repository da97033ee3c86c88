"""The intervals: what they hold, and that they agree with the textbook where there is one."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats

from nnit_bench import statistics
from nnit_bench.statistics import by_cluster, estimate, mean

SIMULATION = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "interval_coverage.py"))


def test_standard_error_of_independent_policies_is_the_textbooks() -> None:
    """With one episode, what remains is a mean of independent values: compare with scipy's bootstrap."""
    values = np.random.default_rng(0).beta(2, 1, size=(40, 1))
    means, variances = statistics._moments([values], [np.full((1, 40), 1 / 40)], np.ones((1, 1)))
    assert means[0] == pytest.approx(values.mean())
    assert variances[0] ** 0.5 == pytest.approx(scipy.stats.sem(values[:, 0]))
    ours = mean(values, None, np.random.default_rng(1))
    scipys = scipy.stats.bootstrap(
        (values[:, 0],), np.mean, method="BCa", n_resamples=10_000, rng=np.random.default_rng(2)
    ).confidence_interval
    width = scipys.high - scipys.low
    assert ours.low == pytest.approx(scipys.low, abs=0.1 * width)
    assert ours.high == pytest.approx(scipys.high, abs=0.1 * width)


def test_interval_of_given_policies_is_that_of_their_episodes() -> None:
    values = np.random.default_rng(0).normal(size=(10, 50))
    ours = mean(values, None, np.random.default_rng(1), drawn=False)
    student = scipy.stats.t.interval(0.95, 49, values.mean(), scipy.stats.sem(values.mean(0)))
    width = student[1] - student[0]
    assert ours.low == pytest.approx(student[0], abs=0.1 * width)
    assert ours.high == pytest.approx(student[1], abs=0.1 * width)


def test_variance_is_that_of_the_two_way_layout() -> None:
    """Against the true variance of the mean, which crossed units and episodes have by formula."""
    rng = np.random.default_rng(0)
    units, episodes = 8, 50
    of_units, of_episodes, of_rest = 0.5, 1.0, 2.0
    found = []
    for _ in range(2000):
        table = (
            of_units * rng.normal(size=(units, 1))
            + of_episodes * rng.normal(size=(1, episodes))
            + of_rest * rng.normal(size=(units, episodes))
        )
        weights = np.full((1, units), 1 / units), np.full((1, episodes), 1 / episodes)
        found.append(statistics._moments([table], [weights[0]], weights[1])[1][0])
    truth = of_units**2 / units + of_episodes**2 / episodes + of_rest**2 / (units * episodes)
    assert np.mean(found) == pytest.approx(truth, rel=0.05)


@pytest.mark.parametrize("scenario", SIMULATION["SCENARIOS"], ids=lambda scenario: scenario.label)
def test_interval_holds_the_truth(scenario: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for starts that nobody drew makes it more than 95 %, most of all where scores are nearly perfect."""
    monkeypatch.setattr(statistics, "REPLICATES", 500)
    runs = 400
    held = 0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        values, clusters = scenario.run(rng)
        interval = mean(values, clusters, rng, bounds=(0, 1))
        held += interval.low <= scenario.truth <= interval.high
    assert 0.93 <= held / runs <= (1 if scenario.truth > 0.8 else 0.98)


def test_a_stray_failure_does_not_make_a_score_surer() -> None:
    perfect = np.ones((80, 50))
    stray = perfect.copy()
    stray[7, 7] = 0
    clusters = np.repeat(np.arange(8), 10)
    first, second = (mean(table, clusters, np.random.default_rng(0), bounds=(0, 1)) for table in (perfect, stray))
    assert second.low < first.low and second.high <= 1


def test_a_policy_that_always_fails_leaves_room_for_starts_that_differ() -> None:
    values = np.ones((10, 50))
    values[3] = 0
    ours = mean(values, None, np.random.default_rng(0), drawn=False, bounds=(0, 1))
    assert ours.low < ours.value == 0.9 < ours.high


def test_shares_of_many_digits_have_no_room_for_missed_blocks() -> None:
    """100 blocks of 100 test digits each: no block is all right or all wrong."""
    values = np.random.default_rng(0).binomial(100, 0.97, (80, 100)) / 100
    ours = mean(values, np.repeat(np.arange(8), 10), np.random.default_rng(0), bounds=(0, 1))
    assert ours.high - ours.low < 0.01


def test_paired_difference_holds_the_truth_and_is_narrower_than_an_unpaired_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(statistics, "REPLICATES", 300)
    rng = np.random.default_rng(0)
    held, narrower, runs = 0, 0, 200
    for _ in range(runs):
        hard = rng.normal(size=(8, 1)) + rng.normal(size=(1, 50))
        first, second = (hard + shift + rng.normal(size=(8, 50)) for shift in (0.3, 0.0))
        paired = estimate([first - second], rng)
        held += paired.low <= 0.3 <= paired.high
        unpaired = estimate([first, -second], rng)
        narrower += paired.high - paired.low < unpaired.high - unpaired.low
    assert 0.92 <= held / runs <= 0.98
    assert narrower == runs


def test_larger_clusters_weigh_more() -> None:
    values = np.random.default_rng(0).random((5, 4))
    table = by_cluster(values, np.array(["a", "a", "a", "b", "b"]))
    assert table.shape == (2, 4)
    assert table.mean() == pytest.approx(values.mean())


def test_same_seed_same_interval() -> None:
    values = np.random.default_rng(0).random((12, 5))
    first, second = (mean(values, np.arange(12) // 3, np.random.default_rng(7)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_nothing_but_success_leaves_room_for_failure(value: float) -> None:
    """Clopper and Pearson's exact interval for 50 of 50, and for 0 of 50."""
    ours = mean(np.full((10, 50), value), None, np.random.default_rng(0), bounds=(0, 1))
    exact = scipy.stats.binomtest(int(value * 50), 50).proportion_ci(0.95, method="exact")
    assert (ours.low, ours.high) == pytest.approx((exact.low, exact.high))


def test_means_without_episodes_count_their_units() -> None:
    """100 policies of which each has succeeded in all of its episodes: 100 of 100, not 1 of 1."""
    ours = mean(np.ones((100, 1)), None, np.random.default_rng(0), bounds=(0, 1))
    exact = scipy.stats.binomtest(100, 100).proportion_ci(0.95, method="exact")
    assert (ours.low, ours.high) == pytest.approx((exact.low, exact.high))


@pytest.mark.parametrize(
    ("units", "drawn", "has"), [(1, True, False), (4, True, False), (5, True, True), (1, False, True)]
)
def test_few_drawn_units_have_no_interval(units: int, drawn: bool, has: bool) -> None:
    """A policy or two say little of how policies differ; of given ones only the episodes matter."""
    values = np.random.default_rng(0).random((units, 50))
    ours = mean(values, None, np.random.default_rng(0), drawn=drawn)
    assert ours.value == pytest.approx(values.mean()) and (ours.low < ours.value < ours.high) is has
