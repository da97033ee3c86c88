"""The numbers of a result row, from tables of episodes made by hand."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from nnit_bench import scores
from nnit_bench.protocol import Protocol, SeedRange
from nnit_zoo.tasks.metric import Metric

METRICS = (
    Metric(column="success_at_end", label="success at end", unit="%"),
    Metric(column="return", label="return", unit=""),
)


def make_protocol(**changes: Any) -> Protocol:
    settings: dict[str, Any] = {
        "task": "T",
        "task_version": 1,
        "metrics": METRICS,
        "split": "unseen",
        "policies": {"a": 1},
        "selection": "paper",
        "select": SeedRange(first=0, count=1),
        "report": None,
    }
    return Protocol(**settings | changes)


def make_episodes(
    success: Any, architectures: list[str], returns: Any = None, phase: str = "select", first: int = 0
) -> pa.Table:
    """A row per policy and episode of tables [policies, episodes]."""
    success = np.asarray(success, float)
    returns = success * 40 if returns is None else np.asarray(returns, float)
    rows = [
        {
            "policy": policy,
            "architecture": architectures[policy],
            "phase": phase,
            "episode_seed": first + episode,
            "return": returns[policy, episode],
            "success_at_end": bool(success[policy, episode]),
        }
        for policy in range(success.shape[0])
        for episode in range(success.shape[1])
    ]
    return pa.Table.from_pylist(rows)


def test_scores_reads_an_episode_table_in_any_order() -> None:
    episodes = pa.table(
        {
            "policy": pa.array([3, 3, 0, 0], pa.int32()),
            "architecture": ["b", "b", "a", "a"],
            "episode_seed": [8, 7, 7, 8],
            "return": pa.array([4, 3, 1, 2], pa.float32()),
            "success_at_end": [False, False, True, False],
        }
    )
    table = scores.from_episodes(episodes, METRICS)
    assert table.policies.tolist() == [0, 3] and table.seeds.tolist() == [7, 8]
    assert table.values["return"].tolist() == [[1, 2], [3, 4]]
    assert table.values["success_at_end"].mean(1).tolist() == [0.5, 0]
    assert table.of(np.array([3, 0])).architectures.tolist() == ["b", "a"]
    assert table.during(table.seeds == 8).values["return"].tolist() == [[2], [4]]


def test_the_best_are_those_with_success_then_return_then_the_lower_number() -> None:
    episodes = make_episodes([[0], [1], [1], [0]], ["a", "a", "b", "b"], [[30], [10], [20], [30]])
    assert scores.ranked(scores.from_episodes(episodes, METRICS), METRICS).tolist() == [2, 1, 0, 3]


def test_worst_architecture_and_plain_means() -> None:
    episodes = make_episodes([[1, 1], [1, 0], [0, 0], [0, 1]], ["16-16", "16-16", "64-64", "64-64"])
    summary = scores.summarise(episodes, make_protocol(top=1))
    assert summary.worst == "64-64" and summary.top == (0,) and summary.joint is None
    success = summary.estimates["success_at_end"]
    assert success["worst"].value == 0.25 and success["mean"].value == 0.5
    assert summary.estimates["return"]["top"].value == 40
    assert summary.architectures["16-16"]["success_at_end"].value == 0.75
    assert "top_heldout" not in success


def test_heldout_top_is_honest_where_the_papers_is_lucky() -> None:
    """Of equally good policies, the ten best on the same episodes look better than they are; on others they do not."""
    rng = np.random.default_rng(0)
    names = ["a"] * 40 + ["b"] * 40
    select, report = (rng.random((80, 50)) < 0.5 for _ in range(2))
    episodes = pa.concat_tables([make_episodes(select, names), make_episodes(report, names, phase="report", first=100)])
    protocol = make_protocol(selection="heldout", report=SeedRange(first=100, count=50))
    success = scores.summarise(episodes, protocol).estimates["success_at_end"]
    assert success["top"].low > 0.5
    assert success["top_heldout"].low < 0.5 < success["top_heldout"].high


def test_a_test_set_is_halved_for_the_heldout_top() -> None:
    """Policy 0 is right on all even blocks and on no odd one; policy 1 the other way round."""
    metrics = (Metric(column="return", label="accuracy", unit="%"),)
    episodes = make_episodes([[0] * 4] * 2, ["a", "a"], [[1, 0, 1, 0], [0, 0.9, 0, 0.9]])
    protocol = make_protocol(selection="heldout", metrics=metrics, top=1)
    accuracy = scores.summarise(episodes, protocol).estimates["return"]
    assert accuracy["top"].value == 0.5  # policy 0 on all blocks
    assert accuracy["top_heldout"].value == 0  # policy 0, best on the even ones, on the odd ones


def test_what_a_generator_chose() -> None:
    names = ["32-32-16-64", "32-32-16-64", "16-16-16-16", "64-64-64-64", "8-8"]
    episodes = make_episodes([[1, 1], [1, 0], [0, 0], [0, 1], [0, 0]], names)
    summary = scores.summarise(episodes, make_protocol(split="joint", policies={"any": 5}, top=2))
    assert summary.worst is None and "worst" not in summary.estimates["return"]
    assert summary.joint == scores.Architectures(
        distinct=4, unseen=1, excluded=1, outside=1, distinct_in_top=1, functional=0.6
    )


def test_curve_of_the_best_falls_and_starts_at_the_best() -> None:
    rng = np.random.default_rng(0)
    episodes = make_episodes(rng.random((12, 20)) < rng.random((12, 1)), ["a"] * 12)
    same, others = scores.top_curve(episodes, make_protocol())
    table = scores.everything(episodes, make_protocol()).values["success_at_end"]
    assert same[0] == table.mean(1).max() and np.all(np.diff(same) <= 1e-12)
    assert same[-1] == pytest.approx(table.mean()) and others[-1] == pytest.approx(table[:, 1::2].mean())


def test_an_interval_of_architectures_is_wider_than_one_of_their_policies() -> None:
    """Ten like policies of each of eight unlike architectures say little about a ninth."""
    rng = np.random.default_rng(0)
    names = [name for name in "abcdefgh" for _ in range(10)]
    success = rng.random((80, 50)) < np.repeat(rng.uniform(0.2, 1, 8), 10)[:, None]
    on_split = scores.summarise(make_episodes(success, names), make_protocol()).estimates["success_at_end"]["mean"]
    of_joint = make_protocol(split="joint", policies={"any": 80})
    on_joint = scores.summarise(make_episodes(success, names), of_joint).estimates["success_at_end"]["mean"]
    assert on_split.high - on_split.low > 1.5 * (on_joint.high - on_joint.low)
