"""Copies show as copies, however they were made, and new policies as new."""

from typing import Any

import pytest
import torch

from nnit_baselines.controls.resized import resize
from nnit_bench import novelty
from nnit_zoo.architecture import Architecture
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import Zoo

UNSEEN, SEEN = "32-32-16-64", "64-64-64-64"


def fresh(architecture: Architecture, policies: int = 4, seed: int = 0) -> PolicyBatch:
    draws = torch.Generator().manual_seed(seed)
    layers = [torch.randn(policies, *shape, generator=draws) * 0.2 for shape in architecture.block_shapes]
    return PolicyBatch(architecture, tuple(layers))


def parse(name: str) -> Architecture:
    return Architecture.parse(name, 3, 2)


@pytest.mark.parametrize(("name", "split"), [(SEEN, "seen"), (UNSEEN, "unseen")])
def test_a_copy_of_a_zoo_policy_shows_as_such(task: Any, zoo: Zoo, name: str, split: str) -> None:
    copies = zoo.batch(name, split)[[1, 0]].to(torch.float32)
    found, rows = novelty.measure(task, zoo, [copies, fresh(parse(name), 1)])
    assert found.copies == 2
    assert rows["same_architecture"].to_pylist()[:2] == [0, 0]
    assert rows["same_architecture_seed"].to_pylist()[:2] == [1, 0]
    assert rows["actions"].to_pylist()[:2] == [0, 0]
    assert rows["same_architecture"][2].as_py() > 0.5


def test_the_distance_is_the_noise_that_was_added(task: Any, zoo: Zoo) -> None:
    stored = zoo.batch(SEEN, "seen").to(torch.float32)
    layers = []
    for layer in stored.layers:
        noise = torch.randn(layer.shape, generator=torch.Generator().manual_seed(1))
        layers.append(layer + 0.05 * noise * layer.square().mean().sqrt())
    noisy = PolicyBatch(stored.architecture, tuple(layers))
    found, rows = novelty.measure(task, zoo, [noisy])
    difference = (noisy.flat() - stored.flat()).norm(dim=1) / stored.flat().norm(dim=1)
    assert rows["same_architecture"].to_pylist() == pytest.approx(difference.tolist(), rel=1e-6)
    assert found.copies == 0 and found.actions is not None and found.actions.median > 0


def test_a_crop_of_a_training_policy_is_a_copy_of_it(task: Any, zoo: Zoo) -> None:
    cut = resize(zoo.batch(SEEN, "seen").to(torch.float32), parse(UNSEEN))
    found, rows = novelty.measure(task, zoo, [cut])
    assert found.copies == 2
    assert rows["any_architecture_name"].to_pylist() == [SEEN, SEEN]
    assert rows["any_architecture_seed"].to_pylist() == [0, 1]
    assert max(rows["any_architecture"].to_pylist()) < 1e-6


def test_a_training_policy_padded_with_silent_neurons_is_a_copy_of_it(task: Any, zoo: Zoo) -> None:
    padded = resize(zoo.batch("32-16-64-32", "seen").to(torch.float32), parse("32-32-64-64"))
    found, rows = novelty.measure(task, zoo, [padded])
    assert found.copies == 2
    assert rows["any_architecture_name"].to_pylist() == ["32-16-64-32"] * 2


def test_permuted_neurons_still_act_the_same(task: Any, zoo: Zoo) -> None:
    """A copy with its neurons in another order is far in weights and at zero in actions."""
    stored = zoo.batch(SEEN, "seen").to(torch.float32)
    order = torch.randperm(64, generator=torch.Generator().manual_seed(0))
    layers = list(stored.layers)
    layers[0] = layers[0][:, order]
    layers[1] = torch.cat([layers[1][:, :, :-1][:, :, order], layers[1][:, :, -1:]], dim=2)
    _, rows = novelty.measure(task, zoo, [PolicyBatch(stored.architecture, tuple(layers))])
    assert min(rows["same_architecture"].to_pylist()) > 0.1
    assert max(rows["actions"].to_pylist()) < 1e-5


def test_held_out_seeds_are_the_yardstick(task: Any, zoo: Zoo) -> None:
    """Policies of held-out seeds themselves are exactly as new as held-out seeds."""
    found, _ = novelty.measure(task, zoo, [zoo.batch(UNSEEN, "heldout_seed").to(torch.float32)])
    for distance in (found.same_architecture, found.any_architecture, found.actions):
        assert distance is not None and distance.ratio == pytest.approx(1)


def test_pairs_and_what_cannot_be_compared(task: Any, zoo: Zoo) -> None:
    twins = fresh(parse(UNSEEN), 1)[[0, 0]]
    found, _ = novelty.measure(task, zoo, [twins])
    assert found.pairwise_l2 == pytest.approx(0) and found.pairwise_cosine == pytest.approx(1)
    strange, rows = novelty.measure(task, zoo, [fresh(parse("96-96-96-96"), 1), fresh(parse("8-8"), 1)])
    assert strange.same_architecture is None and strange.pairwise_l2 is None and strange.actions is None
    assert rows["any_architecture"].null_count == 1  # of another depth
    assert rows["any_architecture"][0].as_py() > 0.5


def test_policies_whose_outputs_overflow_leave_numbers(task: Any, zoo: Zoo) -> None:
    """A record that holds NaN could not be read again."""
    layers = tuple(layer * 1e37 for layer in fresh(parse(UNSEEN), 1).layers)
    found, _ = novelty.measure(task, zoo, [PolicyBatch(parse(UNSEEN), layers), fresh(parse(UNSEEN), 2)])
    assert found == type(found).model_validate_json(found.model_dump_json())


def test_an_architecture_of_another_width_is_compared_where_both_have_weights(task: Any, zoo: Zoo) -> None:
    wide = fresh(parse("96-96-96-96"), 1)
    stored = zoo.batch(SEEN, "seen")[0].to(torch.float32)
    for mine, theirs in zip(wide.layers, stored.layers, strict=True):
        out, into = theirs.shape[1], theirs.shape[2] - 1
        gain = (into / (mine.shape[2] - 1)) ** 0.5  # a layer of larger fan-in has smaller weights
        mine[:, :out, :into] = theirs[:, :, :-1] * gain
        mine[:, :out, -1] = theirs[:, :, -1]
    found, rows = novelty.measure(task, zoo, [wide])
    assert rows["any_architecture"][0].as_py() < 1e-6 and found.copies == 1
