"""The settings that fix what a run measures."""

from typing import Any

import pytest

from nnit_bench.protocol import MOST_EPISODES, PHASE_SEEDS, Protocol, policies_per_architecture
from nnit_zoo.errors import UserError


def test_policies_are_spread_evenly() -> None:
    assert set(policies_per_architecture("unseen").values()) == {10}
    seen = policies_per_architecture("seen")
    assert len(seen) == 64 and sum(seen.values()) == 100 and set(seen.values()) == {1, 2}
    assert sum(policies_per_architecture("excluded", each=3).values()) == 27


def test_one_architecture_gets_what_it_gets_among_all() -> None:
    everything = policies_per_architecture("seen")
    for name in ("16-16-16-64", "64-64-64-64"):
        assert policies_per_architecture("seen", only=[name]) == {name: everything[name]}


@pytest.mark.parametrize(
    ("name", "message"),
    [("32-32-16-46", "did you mean 32-32-16-64"), ("64-64-64-64", "not unseen but seen: add --split seen")],
)
def test_an_architecture_outside_the_split_is_answered(name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        policies_per_architecture("unseen", only=[name])


@pytest.mark.parametrize("change", [{"episodes": 0}, {"seed": -1}, {"policies": {}}, {"policies": {"16-16-16-32": -1}}])
def test_settings_that_measure_nothing_are_refused(protocol: Protocol, change: dict[str, Any]) -> None:
    with pytest.raises(UserError):
        Protocol(**{**protocol.model_dump(), **change})


def test_no_episode_is_in_two_phases() -> None:
    starts = sorted(PHASE_SEEDS.values())
    assert starts[0] + MOST_EPISODES <= starts[1]
    assert starts[1] + MOST_EPISODES < 2**31  # what ManiSkill and NumPy accept everywhere
