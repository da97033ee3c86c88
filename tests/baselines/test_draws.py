"""Random choices that follow from a seed and a step."""

import pytest

from nnit_baselines.draws import shuffled


@pytest.mark.parametrize(("count", "size"), [(12, 4), (14, 4), (7, 1)])
def test_a_round_takes_each_item_once_in_an_order_of_its_own(count, size):
    steps = count // size
    rounds = [
        [item for step in range(steps) for item in shuffled(count, size, first + step, seed)]
        for first, seed in ((0, 0), (steps, 0), (0, 1))
    ]
    for taken in rounds:
        assert len(taken) == len(set(taken)) == steps * size and set(taken) <= set(range(count))
    assert len(set(map(tuple, rounds))) == 3


def test_few_items_come_again():
    assert sorted(shuffled(2, 5, 0, 0)) in ([0, 0, 0, 1, 1], [0, 0, 1, 1, 1])
