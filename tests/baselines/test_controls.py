"""The controls that learn nothing."""

import pytest
import torch

from nnit_baselines.controls.crop import Crop, crop, nearest_covering
from nnit_baselines.controls.ghn_oracle import GHNOracle
from nnit_baselines.generator import SampleRequest
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


def test_crop_keeps_the_first_neurons_and_the_size_of_their_inputs():
    wide, narrow = Architecture(5, (16, 16), 3), Architecture(5, (4, 8), 3)
    source = PolicyBatch(wide, tuple(torch.arange(r * c).reshape(1, r, c).float() for r, c in wide.block_shapes))
    first, second, last = crop(source, narrow).layers
    torch.testing.assert_close(first, source.layers[0][:, :4])
    torch.testing.assert_close(second[:, :, :-1], source.layers[1][:, :8, :4] * 2)
    torch.testing.assert_close(last[:, :, :-1], source.layers[2][:, :, :8] * 2**0.5)
    torch.testing.assert_close(last[:, :, -1], source.layers[2][:, :, -1])


def test_the_nearest_covering_architecture_is_the_smallest_as_wide_everywhere():
    known = tuple(Architecture(5, hidden, 3) for hidden in ((64, 64), (32, 64), (64, 16), (32, 32, 32)))
    assert nearest_covering(Architecture(5, (16, 32), 3), known) == known[1]
    with pytest.raises(UserError, match="no seen architecture covers"):
        nearest_covering(Architecture(5, (96, 16), 3), known)


def test_crop_draws_different_policies_and_repeats_itself(view):
    control = Crop()
    control.fit(view)
    wanted = Architecture(5, (16, 24), 3)
    request = SampleRequest(wanted, 4, seed=1)
    batch = control.sample(request)
    assert batch.architecture == wanted
    assert len(batch.flat().unique(dim=0)) == 4
    assert torch.equal(batch.flat(), control.sample(request).flat())


def test_crop_refuses_a_reference_view(view):
    with pytest.raises(UserError, match="never for training"):
        Crop().fit(TrainingView(view.task, view.batches, reference=True))


def test_the_oracle_gives_the_stored_policies_of_exactly_that_architecture(view):
    oracle = GHNOracle()
    oracle.fit(TrainingView(view.task, view.batches, reference=True))
    wanted = view.architectures[1]
    stored = {tuple(row) for row in view.batch(wanted).flat().tolist()}
    assert {tuple(row) for row in oracle.sample(SampleRequest(wanted, 4, 0)).flat().tolist()} == stored
    assert len(oracle.sample(SampleRequest(wanted, 10, 0))) == 10
    with pytest.raises(UserError, match="no architecture in this view named '64-64'"):
        oracle.sample(SampleRequest(Architecture(5, (64, 64), 3), 1, 0))
