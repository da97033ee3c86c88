"""The controls that learn nothing."""

import pytest
import torch

from nnit_baselines import registry
from nnit_baselines.controls.resized import Crop, Nearest, resize
from nnit_baselines.controls.stored import Noise006
from nnit_baselines.generator import SampleRequest
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView

CONTROLS = sorted(set(registry.BUILT_IN) - {"nnit"})


def fitted(name, view):
    control = registry.get(name)()
    control.fit(TrainingView(view.task, view.batches, reference=control.capabilities.oracle))
    return control


def policies_of(*hidden):
    """A view with four random policies of each of these architectures."""
    torch.manual_seed(0)
    architectures = [Architecture(5, each, 3) for each in hidden]
    return TrainingView(
        "Push",
        {
            each: PolicyBatch(each, tuple(torch.randn(4, *shape) for shape in each.block_shapes))
            for each in architectures
        },
    )


@pytest.mark.parametrize("name", CONTROLS)
def test_a_control_gives_what_is_asked(name, view):
    """More than is stored, too; `test_check` holds it to the rest of the contract."""
    control, wanted = fitted(name, view), view.architectures[1]
    assert control.supports(wanted)
    batch = control.sample(SampleRequest(wanted, 6, seed=1))
    assert (batch.architecture, len(batch)) == (wanted, 6)


@pytest.mark.parametrize("name", ["zoo", "noise-0.03", "mean", "ghn-oracle"])
def test_what_is_not_stored_is_not_supported(name, view):
    control, absent = fitted(name, view), Architecture(5, (64, 64), 3)
    assert not control.supports(absent)
    with pytest.raises(UserError, match="no architecture in this view named '64-64'"):
        control.sample(SampleRequest(absent, 1, 0))


@pytest.mark.parametrize("name", ["zoo", "ghn-oracle"])
def test_stored_policies_come_each_once_and_then_again(name, view):
    control, wanted = fitted(name, view), view.architectures[1]
    stored = {tuple(row) for row in view.batch(wanted).flat().tolist()}
    assert {tuple(row) for row in control.sample(SampleRequest(wanted, 4, 0)).flat().tolist()} == stored
    assert len(control.sample(SampleRequest(wanted, 10, 0))) == 10


def test_noise_has_the_named_size_in_every_layer():
    view = policies_of((64, 64))
    view.batches[view.architectures[0]].layers[1].mul_(7)
    request = SampleRequest(view.architectures[0], 40, 3)
    noisy, clean = (fitted(name, view).sample(request).layers for name in ("noise-0.06", "zoo"))
    for changed, stored in zip(noisy, clean, strict=True):
        relative = (changed - stored).flatten(1).norm(dim=1) / stored.flatten(1).norm(dim=1)
        assert relative.square().mean().sqrt().item() == pytest.approx(Noise006.sigma, rel=0.05)


def test_mean_averages_the_stored_policies(view):
    batch = fitted("mean", view).sample(SampleRequest(view.architectures[0], 2, 0))
    expected = view.batch(view.architectures[0]).flat().mean(dim=0)
    torch.testing.assert_close(batch.flat(), expected.expand(2, -1))


def test_random_is_the_initialisation_of_pytorch():
    view = policies_of((32, 32))
    batch = fitted("random", view).sample(SampleRequest(Architecture(5, (100, 100), 3), 20, 0))
    reference = torch.nn.Linear(100, 100)
    torch.testing.assert_close(batch.layers[1].std(), reference.weight.std(), rtol=0.02, atol=0)
    assert batch.layers[1].abs().max() <= 0.1


def test_cut_inputs_keep_the_size_of_their_sums():
    wide, narrow = Architecture(5, (16, 16), 3), Architecture(5, (4, 8), 3)
    source = PolicyBatch(wide, tuple(torch.arange(r * c).reshape(1, r, c).float() for r, c in wide.block_shapes))
    first, second, last = resize(source, narrow).layers
    torch.testing.assert_close(first, source.layers[0][:, :4])
    torch.testing.assert_close(second[:, :, :-1], source.layers[1][:, :8, :4] * 2)
    torch.testing.assert_close(last[:, :, :-1], source.layers[2][:, :, :8] * 2**0.5)
    torch.testing.assert_close(last[:, :, -1], source.layers[2][:, :, -1])


def test_a_padded_network_computes_the_same():
    view = policies_of((4, 8))
    source = view.batch(view.architectures[0])
    observations = torch.randn(1, 20, 5)
    torch.testing.assert_close(resize(source, Architecture(5, (16, 10), 3))(observations), source(observations))


def test_crop_takes_the_smallest_architecture_as_wide_everywhere():
    control = Crop()
    control.fit(policies_of((64, 64), (32, 64), (64, 16), (32, 32, 32)))
    assert control.source(Architecture(5, (16, 32), 3)) == Architecture(5, (32, 64), 3)
    assert not control.supports(Architecture(5, (96, 16), 3))
    with pytest.raises(UserError, match="no seen architecture can be resized to 96-16"):
        control.sample(SampleRequest(Architecture(5, (96, 16), 3), 1, 0))


def test_nearest_counts_steps_in_width_and_would_rather_pad_than_cut():
    control = Nearest()
    control.fit(policies_of((64, 64), (16, 64), (64, 32), (32, 16), (32, 32, 32)))
    assert control.source(Architecture(5, (64, 64), 3)) == Architecture(5, (64, 64), 3)
    assert control.source(Architecture(5, (32, 32), 3)) == Architecture(5, (32, 16), 3)
    assert control.source(Architecture(5, (20, 64), 3)) == Architecture(5, (16, 64), 3)
    assert not control.supports(Architecture(5, (32,), 3))
