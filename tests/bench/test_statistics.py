"""The statistics of the result table: what they say, and that their intervals hold what they promise."""

import numpy as np
import pyarrow as pa
import pytest
import scipy.stats

from nnit_bench import statistics
from nnit_bench.statistics import Scores


def make_scores(success: np.ndarray, architectures: list[str], returns: np.ndarray | None = None) -> Scores:
    returns = success * 40 if returns is None else returns
    values = {"success_at_end": success, "success_once": success, "return": returns}
    return Scores(values, np.arange(len(success)), np.array(architectures))


def test_interval_of_independent_policies_agrees_with_scipy() -> None:
    values = np.random.default_rng(0).beta(2, 1, size=(40, 1))
    ours = statistics.mean(values, np.arange(40), np.random.default_rng(1))
    scipys = scipy.stats.bootstrap(
        (values[:, 0],), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(2)
    ).confidence_interval
    width = scipys.high - scipys.low
    assert ours.value == pytest.approx(values.mean())
    assert ours.low == pytest.approx(scipys.low, abs=0.06 * width)
    assert ours.high == pytest.approx(scipys.high, abs=0.06 * width)


@pytest.mark.parametrize(
    ("architecture", "policy", "episode"),
    [(0.0, 1.0, 0.3), (0.5, 1.0, 0.3), (0.0, 0.3, 1.0), (1.0, 0.5, 0.3)],
    ids=["policies differ", "both differ", "hard and easy episodes", "architectures differ"],
)
def test_interval_holds_the_truth(architecture: float, policy: float, episode: float) -> None:
    """Coverage on data like ours; an interval that ignored clusters or shared episodes would hold it half the time."""
    rng = np.random.default_rng(0)
    truth = scipy.stats.norm.cdf(1 / np.sqrt(1 + architecture**2 + policy**2 + episode**2))
    clusters = np.repeat(np.arange(8), 10)
    held = 0
    for _ in range(50):
        skill = np.repeat(rng.normal(0, architecture, 8), 10) + rng.normal(0, policy, 80)
        success = 1 + skill[:, None] + rng.normal(0, episode, 50) + rng.normal(size=(80, 50)) > 0
        interval = statistics.mean(success.astype(float), clusters, rng)
        held += interval.low <= truth <= interval.high
    assert held >= 41


def test_same_seed_same_interval() -> None:
    values = np.random.default_rng(0).random((12, 5))
    first, second = (statistics.mean(values, np.arange(12) // 3, np.random.default_rng(7)) for _ in range(2))
    assert first == second


def test_best_prefers_success_then_return_then_number() -> None:
    success = np.array([[0.5], [1.0], [1.0], [0.5]])
    returns = np.array([[30.0], [10.0], [20.0], [30.0]])
    table = make_scores(success, ["a", "a", "b", "b"], returns)
    assert statistics.best(table, 4).tolist() == [2, 1, 0, 3]


def test_heldout_top_is_honest_where_the_papers_is_lucky() -> None:
    """Of equally good policies, the top-10 on the same episodes looks better than they are; held out it does not."""
    rng = np.random.default_rng(0)
    select = make_scores((rng.random((80, 50)) < 0.5).astype(float), ["a"] * 40 + ["b"] * 40)
    report = make_scores((rng.random((80, 50)) < 0.5).astype(float), ["a"] * 40 + ["b"] * 40)
    estimates = statistics.summarise(select, report, top=10).estimates["success_at_end"]
    assert estimates["top"].low > 0.5
    assert estimates["top_heldout"].low < 0.5 < estimates["top_heldout"].high


def test_worst_architecture_and_plain_means() -> None:
    success = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    summary = statistics.summarise(make_scores(success, ["16-16", "16-16", "64-64", "64-64"]), None, top=1)
    assert summary.worst == "64-64"
    assert summary.estimates["success_at_end"]["worst"].value == 0.25
    assert summary.estimates["success_at_end"]["mean"].value == 0.5
    assert summary.estimates["return"]["top"].value == 40
    assert summary.architectures["16-16"]["success_at_end"] == 0.75


def test_scores_reads_an_episode_table() -> None:
    episodes = pa.table(
        {
            "policy": pa.array([3, 3, 0, 0], pa.int32()),
            "architecture": ["b", "b", "a", "a"],
            "seed": [8, 7, 7, 8],
            "return": pa.array([4, 3, 1, 2], pa.float32()),
            "success_once": [True, False, True, True],
            "success_at_end": [False, False, True, False],
        }
    )
    table = statistics.scores(episodes)
    assert table.policies.tolist() == [0, 3]
    assert table.values["return"].tolist() == [[1, 2], [3, 4]]
    assert table.values["success_at_end"].mean(1).tolist() == [0.5, 0]
    assert table.of(np.array([3, 0])).architectures.tolist() == ["b", "a"]
