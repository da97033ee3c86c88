"""Checkpoints in 8 bits: what is lost, and that nothing else is."""

import numpy
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from nnit_baselines.quantise import LARGEST, quantised, restored

VALUES = st.floats(-1e4, 1e4, width=32).map(lambda value: value if abs(value) > 1e-30 else 0.0)
MATRICES = arrays(numpy.float32, array_shapes(min_dims=2, max_dims=3, max_side=6), elements=VALUES)


@given(MATRICES)
def test_an_entry_moves_by_half_a_step_of_its_row_at_most_and_only_once(values):
    before = torch.from_numpy(values)
    stored = quantised({"weight": before})
    after = restored(stored)
    row = before.abs().amax(dim=-1, keepdim=True)
    assert ((after["weight"] - before).abs() <= 0.502 * row / LARGEST).all()
    again = quantised(after)
    assert again.keys() == stored.keys()
    assert all(torch.equal(again[name], stored[name]) for name in stored)


def test_vectors_are_float16_and_the_rest_is_one_byte_an_entry():
    stored = quantised({"bias": torch.linspace(-1, 1, 8), "weight": torch.randn(4, 8)})
    assert {name: tensor.dtype for name, tensor in stored.items()} == {
        "bias": torch.float16,
        "weight": torch.int8,
        "weight.scale": torch.bfloat16,
    }
    assert torch.equal(restored(stored)["bias"], torch.linspace(-1, 1, 8).half().float())


def test_what_is_not_quantised_is_only_widened():
    tensors = {"weight": torch.randn(3, 4).half(), "norm.scale": torch.randn(3).half()}
    assert all(torch.equal(each, tensors[name].float()) for name, each in restored(tensors).items())


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_training_that_diverged_is_not_made_finite(value):
    back = restored(quantised({"weight": torch.tensor([[1.0, value], [1.0, 2.0]])}))["weight"]
    assert not back[0].isfinite().any() and back[1].isfinite().all()


def test_integers_without_their_scale_are_damage():
    with pytest.raises(KeyError, match=r"weight\.scale"):
        restored({"weight": torch.ones(2, 2, dtype=torch.int8)})
