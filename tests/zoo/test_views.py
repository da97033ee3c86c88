from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views import canvas, patches

WIDTHS = st.integers(1, 40)


@st.composite
def batches(draw: st.DrawFn) -> PolicyBatch:
    hidden = draw(st.lists(WIDTHS, min_size=1, max_size=6))
    architecture = Architecture(draw(WIDTHS), tuple(hidden), draw(WIDTHS))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 99)))
    count = draw(st.integers(1, 3))
    dtype = draw(st.sampled_from([torch.float16, torch.float32]))
    # never zero, so that a parameter cannot be taken for padding
    layers = [1 + torch.rand(count, *shape, generator=generator) for shape in architecture.block_shapes]
    return PolicyBatch(architecture, tuple(layer.to(dtype) for layer in layers))


def assert_same(found: PolicyBatch, expected: PolicyBatch) -> None:
    assert found.architecture == expected.architecture
    for mine, theirs in zip(found.layers, expected.layers, strict=True):
        assert mine.dtype == theirs.dtype
        assert torch.equal(mine, theirs)


@settings(max_examples=50, deadline=None)
@given(batches(), st.sampled_from([4, 8, 16]))
def test_canvas_round_trip_with_zeros_around(batch: PolicyBatch, patch: int) -> None:
    tensor = canvas.pack(batch, size=48, patch=patch)
    assert tensor.shape == (len(batch), len(batch.layers), 48, 48 + patch)
    assert (tensor != 0).sum() == len(batch) * batch.architecture.parameters
    assert_same(canvas.unpack(tensor, batch.architecture), batch)


@settings(max_examples=50, deadline=None)
@given(batches(), st.sampled_from([4, 8, 16]))
def test_patches_round_trip_and_cut_the_canvas(batch: PolicyBatch, patch: int) -> None:
    tokens = patches.pack(batch, patch)
    assert_same(patches.unpack(tokens, batch.architecture, patch), batch)

    mask = patches.mask(batch.architecture, patch)
    assert torch.equal(tokens != 0, mask.expand_as(tokens))
    assert mask.any(dim=1).all()
    assert mask.sum() == batch.architecture.parameters

    # each token is the patch of the canvas at its position, and together they hold all that is there
    grid = canvas.pack(batch, size=48, patch=patch)
    cut = grid.unfold(2, patch, patch).unfold(3, patch, patch)
    layer, row, column = patches.positions(batch.architecture, patch, size=48).T
    assert torch.equal(cut[:, layer, row, column].flatten(2), tokens)


def test_unpack_drops_what_a_generator_writes_into_the_padding() -> None:
    architecture = Architecture(5, (3, 7), 2)
    batch = PolicyBatch(architecture, tuple(torch.randn(2, *shape) for shape in architecture.block_shapes))
    tokens = patches.pack(batch, 4)
    noisy = torch.where(patches.mask(architecture, 4), tokens, torch.ones(()))
    assert_same(patches.unpack(noisy, architecture, 4), batch)


def test_architectures_and_tensors_that_do_not_fit_are_refused() -> None:
    wide = Architecture(42, (96,), 8)
    batch = PolicyBatch(wide, tuple(torch.zeros(1, *shape) for shape in wide.block_shapes))
    with pytest.raises(UserError, match="96"):
        canvas.pack(batch)
    with pytest.raises(UserError, match="96"):
        patches.positions(wide)
    other = Architecture(42, (16, 16), 8)
    with pytest.raises(UserError, match="16-16"):
        patches.unpack(patches.pack(batch), other)
    with pytest.raises(UserError, match="16-16"):
        canvas.unpack(canvas.pack(batch, size=96), other)
