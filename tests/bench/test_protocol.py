"""The settings that fix what a run measures."""

from typing import Any

import pytest

from nnit_bench.protocol import EXTENSIONS, SPLITS, Protocol, architectures, policies_per_architecture
from nnit_zoo.architecture import split_of
from nnit_zoo.errors import UserError


def test_policies_are_spread_evenly() -> None:
    assert set(policies_per_architecture("unseen").values()) == {10}
    seen = policies_per_architecture("seen")
    assert len(seen) == 64 and sum(seen.values()) == 100 and set(seen.values()) == {1, 2}
    assert sum(policies_per_architecture("excluded", each=3).values()) == 27
    assert policies_per_architecture("joint") == {"any": 100}
    assert set(policies_per_architecture("wide").values()) == {10}


def test_one_architecture_gets_what_it_gets_among_all() -> None:
    everything = policies_per_architecture("seen")
    for name in ("16-16-16-64", "64-64-64-64"):
        assert policies_per_architecture("seen", only=[name]) == {name: everything[name]}


def test_no_architecture_is_in_two_splits_and_extensions_are_beyond_the_zoo() -> None:
    names = [name for split in SPLITS for name in architectures(split)]
    assert len(names) == len(set(names))
    for split, listed in EXTENSIONS.items():
        assert len(listed) == 8 and all(split_of(name) == "other" for name in listed), split


@pytest.mark.parametrize(
    ("split", "name", "message"),
    [
        ("unseen", "32-32-16-46", "did you mean 32-32-16-64"),
        ("unseen", "64-64-64-64", "not unseen but seen: use --split seen"),
        ("unseen", "96-96-96-96", "not unseen but wide: use --split wide"),
        ("joint", "1-2-3", "the generator chooses the architectures"),
        ("unsen", "64-64-64-64", "did you mean unseen"),
    ],
)
def test_an_architecture_outside_the_split_is_answered(split: str, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        policies_per_architecture(split, only=[name])


@pytest.mark.parametrize("change", [{"seed": -1}, {"policies": {}}, {"policies": {"16-16-16-32": -1}}])
def test_settings_that_measure_nothing_are_refused(protocol: Protocol, change: dict[str, Any]) -> None:
    with pytest.raises(UserError):
        Protocol(**{**protocol.model_dump(), **change})


def test_episodes_are_the_tasks(task: Any, digits: Any) -> None:
    ours = Protocol.of(task, "unseen", episodes=6)
    assert ours.report is not None
    assert list(ours.select.seeds) == list(task.phase_seeds("select", 6))
    assert not set(ours.select.seeds) & set(ours.report.seeds)
    assert Protocol.of(task, "unseen", selection="paper").report is None
    of_a_test_set = Protocol.of(digits, "unseen")
    assert of_a_test_set.report is None and of_a_test_set.selection == "heldout"
    assert list(of_a_test_set.select.seeds) == list(range(8))
