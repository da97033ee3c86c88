from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from nnit_zoo.architecture import SPLITS, Architecture, check_known, hidden_widths, split_of, vocabulary
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch, concatenate

ARCHITECTURE = Architecture(6, (16, 4, 32), 3)


def random_batch(count: int = 4) -> PolicyBatch:
    generator = torch.Generator().manual_seed(0)
    layers = (torch.randn(count, *shape, generator=generator) / 3 for shape in ARCHITECTURE.block_shapes)
    return PolicyBatch(ARCHITECTURE, tuple(layers))


def test_committed_lists_are_the_papers() -> None:
    lists = {split: set(hidden_widths(split)) for split in SPLITS}
    assert {split: len(names) for split, names in lists.items()} == {"seen": 64, "unseen": 8, "excluded": 9}
    every = {"-".join(map(str, widths)) for widths in itertools.product(vocabulary(), repeat=4)}
    assert set.union(*lists.values()) == every  # 64 + 8 + 9 = 81, so they are disjoint too
    assert lists["excluded"] == {name for name in every if name.endswith("-16-16")}
    assert {"32-32-16-64", "32-32-32-64", "16-16-16-32", "16-64-64-32"} < lists["unseen"]
    assert {"32-16-64-32", "32-64-16-32", "32-32-32-16", "64-64-16-32"} < lists["seen"]


def test_architecture_names_are_parsed_and_checked() -> None:
    architecture = Architecture.parse("32-16-64-32", 42, 8)
    assert str(architecture) == "32-16-64-32"
    assert architecture.parameters == 43 * 32 + 33 * 16 + 17 * 64 + 65 * 32 + 33 * 8
    assert split_of(architecture) == "seen"
    assert split_of("24-24") == "other"
    with pytest.raises(UserError, match="32-16-64-32"):
        check_known(["32-16-64-33"])
    for text in ("32-x", "", "32-0"):
        with pytest.raises(UserError):
            Architecture.parse(text, 42, 8)


def test_module_computes_what_the_batch_computes() -> None:
    batch = random_batch()
    observations = torch.randn(len(batch), 10, 6, generator=torch.Generator().manual_seed(1))
    outputs = batch(observations)
    state = torch.get_rng_state()
    for index in range(len(batch)):
        torch.testing.assert_close(batch.to_module(index)(observations[index]), outputs[index])
    assert torch.equal(torch.get_rng_state(), state)


def test_networks_as_a_zoo_stores_them_compute_in_float32() -> None:
    batch = random_batch().to(torch.float16)
    observations = torch.randn(1, 10, 6, generator=torch.Generator().manual_seed(1))
    outputs = batch(observations)
    assert outputs.dtype == torch.float32
    assert torch.equal(outputs, batch.to(torch.float32)(observations))
    assert torch.equal(batch(observations.half()), batch(observations.half().float()))
    assert batch.to(torch.float64)(observations.double()).dtype == torch.float64


def test_module_with_folded_standardisation_takes_raw_observations() -> None:
    batch = random_batch()
    generator = torch.Generator().manual_seed(2)
    mean, std = torch.randn(6, generator=generator), 0.05 + torch.rand(6, generator=generator)
    raw = mean + std * torch.randn(10, 6, generator=generator)
    expected = batch(((raw - mean) / std)[None])
    for index in range(len(batch)):
        torch.testing.assert_close(batch.to_module(index, mean, std)(raw), expected[index], rtol=1e-4, atol=1e-5)


def test_batches_are_cut_and_joined() -> None:
    batch = random_batch()
    again = concatenate([batch[0], batch[1:3], batch[[3]]])
    assert torch.equal(again.flat(), batch.flat())
    for index in (3, np.int64(3), torch.tensor(3), np.array([3]), torch.arange(4) == 3):
        assert torch.equal(batch[index].flat(), batch.flat()[3:])
    assert torch.equal(batch[:1][torch.tensor([True])].flat(), batch.flat()[:1])  # a mask, not an index
    assert [len(single) for single in batch] == [1, 1, 1, 1]
    assert batch.flat().shape == (4, ARCHITECTURE.parameters)
    other = Architecture(6, (2,), 3)
    with pytest.raises(UserError, match="one architecture"):
        concatenate([batch, PolicyBatch(other, tuple(torch.zeros(1, *shape) for shape in other.block_shapes))])


def test_layers_of_another_shape_are_refused_and_non_finite_policies_found() -> None:
    batch = random_batch()
    with pytest.raises(UserError, match="16-4-32"):
        PolicyBatch(ARCHITECTURE, batch.layers[::-1])
    batch.layers[1][2, 0, 0] = float("nan")
    assert batch.finite().tolist() == [True, True, False, True]
