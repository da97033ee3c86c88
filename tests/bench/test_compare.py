"""Two methods are told apart if they differ, and not if they do not."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from nnit_bench import compare
from nnit_bench.protocol import Protocol, SeedRange
from nnit_bench.results import StoredRun
from nnit_zoo.errors import UserError


@pytest.fixture
def protocol(task: Any) -> Protocol:
    return Protocol.of(task, "unseen", selection="paper", episodes=20)


Store = Callable[..., StoredRun]


def outcomes(shift: float, seed: int, columns: int = 20) -> np.ndarray:
    """Successes that share hard architectures and hard episodes with those of any other seed."""
    shared, own = np.random.default_rng(0), np.random.default_rng(seed)
    hard = np.repeat(shared.normal(0, 1, 8), 10)[:, None] + shared.normal(0, 1, columns)
    return np.asarray(shift + hard + own.normal(size=(80, columns)) > 0)


def test_a_difference_is_seen_through_what_both_share(store: Store, protocol: Protocol) -> None:
    """The intervals of the two overlap widely; paired, the difference stands out."""
    protocol = protocol.model_copy(update={"selection": "heldout"})  # on halves, as on a test set
    better = store("better", protocol, outcomes(0.5, 1))
    worse = store("worse", protocol, outcomes(0.0, 2))
    found = {each.statistic: each for each in compare.differ(better, worse) if each.metric == "success_at_end"}
    mean = found["mean"]
    assert mean.separable and mean.difference.low > 0
    assert found.keys() == {"mean", "top", "top_heldout"}
    for each in found.values():
        assert each.first > each.second and each.difference.value == pytest.approx(each.first - each.second)
    first, second = (run.record.results.estimates["success_at_end"]["mean"] for run in (better, worse))  # type: ignore[union-attr]
    assert first.low < second.high
    words = compare.in_words("better", "worse", mean, protocol.metrics[0])
    assert words.startswith("better is above worse in mean success at end by") and words.endswith("separable.")


def test_no_difference_is_not_seen(store: Store, protocol: Protocol) -> None:
    runs = [store(name, protocol, outcomes(0.2, seed)) for name, seed in (("one", 1), ("two", 2))]
    mean = compare.differ(*runs)[0]
    assert mean.separable is False and mean.difference.low < 0 < mean.difference.high
    assert {each.separable for each in compare.differ(*runs) if each.statistic != "mean"} == {None}
    assert "cannot be told apart" in compare.in_words("one", "two", mean, protocol.metrics[0])


def test_a_run_against_itself_is_no_different_at_all(store: Store, protocol: Protocol) -> None:
    run = store("one", protocol, outcomes(0.2, 1))
    for each in compare.differ(run, run):
        assert (each.difference.value, each.difference.low, each.difference.high) == (0, 0, 0)
    words = compare.in_words("one", "two", compare.differ(run, run)[0], protocol.metrics[0])
    assert words == "one and two have the same mean success at end, and no interval: nothing tells them apart."


def test_only_shared_architectures_and_episodes_count(store: Store, protocol: Protocol) -> None:
    everything = outcomes(0.2, 1)
    whole = store("whole", protocol, everything)
    later = protocol.model_copy(update={"select": SeedRange(first=protocol.select.first + 5, count=15)})
    part = store("late", later, everything[:, 5:])
    assert "top" in {each.statistic for each in compare.differ(whole, part)}
    few = later.model_copy(update={"policies": dict(list(later.policies.items())[:4])})
    part = store("part", few, everything[:40, 5:])
    mean, *others = compare.differ(whole, part)
    assert {each.statistic for each in others} == {"mean"}  # the best ten of 40 are no match for those of 80
    assert (mean.first, mean.second) == (everything[:40, 5:].mean(), everything[:40, 5:].mean())
    assert mean.difference.value == 0
    apart = protocol.model_copy(update={"select": SeedRange(first=protocol.select.first + 50, count=20)})
    with pytest.raises(UserError, match="no episode in common"):
        compare.differ(whole, store("apart", apart, everything))


def test_too_few_architectures_tell_no_methods_apart(store: Store, protocol: Protocol) -> None:
    few = protocol.model_copy(update={"policies": dict(list(protocol.policies.items())[:4])})
    runs = [store(name, few, outcomes(level, 1)[:40]) for name, level in (("better", 1.5), ("worse", 0.0))]
    mean = compare.differ(*runs)[0]
    assert not mean.separable and compare.tied(*runs)
    words = compare.in_words("better", "worse", mean, few.metrics[0])
    assert "cannot be told apart" in words and "over too few architectures" in words


def test_policies_of_a_generator_that_chooses_are_not_paired(store: Store, protocol: Protocol) -> None:
    joint = protocol.model_copy(update={"split": "joint", "policies": {"any": 80}})
    better = store("better", joint, outcomes(1.5, 1))
    worse = store("worse", joint, outcomes(0.0, 2)[:70])
    mean = compare.differ(better, worse)[0]
    assert mean.separable and mean.difference.value == pytest.approx(mean.first - mean.second)


@pytest.mark.parametrize("change", [{"task_version": 2}, {"split": "seen"}, {"simulator": "stock"}])
def test_what_was_not_measured_alike_is_not_compared(store: Store, protocol: Protocol, change: dict[str, Any]) -> None:
    one = store("one", protocol, outcomes(0.2, 1))
    other = store("other", protocol.model_copy(update=change), outcomes(0.2, 1))
    with pytest.raises(UserError, match="not measured alike"):
        compare.differ(one, other)
