from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nnit_zoo.architecture import Architecture, hidden_widths
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views.permuted import Scheme, invert, permute, permuted
from nnit_zoo.zoo import TrainingView

SCHEMES = ("policy", "seed", "architecture")
NARROW, WIDE = Architecture(5, (16, 32, 16, 32), 3), Architecture(5, (64, 64, 32, 64), 3)


def view_of(*architectures: Architecture, seeds: tuple[int, ...] = (3, 7)) -> TrainingView:
    """Policies whose parameters are all different, cut from one field per GHN seed so that narrow ones are nested."""
    batches = {}
    for architecture in architectures:
        layers = []
        for depth, (rows, columns) in enumerate(architecture.block_shapes):
            field = torch.rand(len(seeds), 64, 65, generator=torch.Generator().manual_seed(depth), dtype=torch.float64)
            layers.append(torch.cat([field[:, :rows, : columns - 1], field[:, :rows, 64:]], dim=2) - 0.5)
        batches[architecture] = PolicyBatch(architecture, tuple(layers))
    return TrainingView("PickCube-v1", batches, dict.fromkeys(architectures, seeds))


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(SCHEMES), st.sampled_from(hidden_widths("seen")), st.integers(0, 2**32))
def test_every_scheme_keeps_the_functions_and_moves_the_weights(scheme: Scheme, hidden: str, seed: int) -> None:
    view = view_of(Architecture.parse(hidden, 5, 3))
    after = permuted(view, scheme, seed)
    observations = torch.randn(1, 20, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for architecture, batch in view.batches.items():
        moved = after.batches[architecture]
        torch.testing.assert_close(moved(observations), batch(observations), rtol=1e-9, atol=1e-12)
        assert not torch.equal(moved.flat(), batch.flat())
        for mine, theirs in zip(moved.layers, batch.layers, strict=True):
            assert torch.equal(mine.flatten(1).sort(1).values, theirs.flatten(1).sort(1).values)
    assert (after.task, after.seeds, after.reference) == (view.task, view.seeds, view.reference)


def test_the_seed_decides() -> None:
    view = view_of(NARROW, WIDE)
    for scheme in ("policy", "seed", "architecture"):
        first, again, other = (permuted(view, scheme, seed) for seed in (0, 0, 1))
        for architecture in view.architectures:
            assert torch.equal(first.batch(architecture).flat(), again.batch(architecture).flat())
            assert not torch.equal(first.batch(architecture).flat(), other.batch(architecture).flat())
    assert torch.equal(
        permuted(view_of(WIDE), "policy", 0).batch(WIDE).flat(), permuted(view, "policy", 0).batch(WIDE).flat()
    )


def test_by_seed_narrow_policies_stay_nested_and_the_blocks_in_place() -> None:
    after = permuted(view_of(NARROW, WIDE), "seed", 0)
    narrow, wide = after.batches[NARROW], after.batches[WIDE]
    for mine, theirs in zip(narrow.layers, wide.layers, strict=True):
        rows, columns = mine.shape[1:]
        assert torch.equal(mine[:, :, :-1], theirs[:, :rows, : columns - 1])
    before = view_of(NARROW, WIDE).batches[WIDE]
    assert torch.equal(before.layers[0][:, :16].sort(1).values, wide.layers[0][:, :16].sort(1).values)
    assert orders_differ(after.batches[WIDE], before)


def test_by_architecture_all_seeds_get_one_order() -> None:
    assert not orders_differ(permuted(view_of(WIDE), "architecture", 0).batches[WIDE], view_of(WIDE).batches[WIDE])
    assert orders_differ(permuted(view_of(WIDE), "policy", 0).batches[WIDE], view_of(WIDE).batches[WIDE])


def orders_differ(after: PolicyBatch, before: PolicyBatch) -> bool:
    """Whether the two policies' first hidden neurons stand in different orders."""
    found = [
        [row.tolist() for row in mine].index(first.tolist())
        for mine, first in zip(after.layers[0], before.layers[0][:, 0], strict=True)
    ]
    return len(set(found)) > 1


def test_the_inverse_undoes_and_unknown_schemes_are_refused() -> None:
    batch = view_of(WIDE).batches[WIDE]
    orders = [torch.randperm(width, generator=torch.Generator().manual_seed(width)) for width in WIDE.hidden]
    assert torch.equal(permute(permute(batch, orders), invert(orders)).flat(), batch.flat())
    with pytest.raises(UserError, match="did you mean policy"):
        permuted(view_of(WIDE), "polic", 0)  # type: ignore[arg-type]
