"""NNiT: the transformer, and training that can be stopped at any moment."""

import json

import pytest
import torch

from nnit_baselines.generator import Run, SampleRequest
from nnit_baselines.nnit import training
from nnit_baselines.nnit.config import NNiTConfig, preset
from nnit_baselines.nnit.generator import Form, NNiT
from nnit_baselines.nnit.model import Transformer
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views import patches
from nnit_zoo.zoo import TrainingView

TINY = NNiTConfig(width=32, depth=2, heads=2, steps=6, batch=4, warmup=2, ema=0.5, sampling_steps=3)


def stirred_model():
    """A model whose zero-initialised parts have been given values."""
    torch.manual_seed(0)
    model = Transformer(16, 32, 2, 2, widths=5, layers=3, side=4)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model


def gaussian_batch(architecture, policies):
    torch.manual_seed(0)
    return PolicyBatch(architecture, tuple(torch.randn(policies, *shape) for shape in architecture.block_shapes))


def test_a_new_model_estimates_zero():
    model = Transformer(16, 32, 2, 2, widths=5, layers=3, side=4)
    positions = patches.positions(Architecture(5, (32, 16), 3), 16)
    estimate = model(torch.randn(2, len(positions), 256), torch.rand(2), positions, torch.tensor([3, 1, 0, 4]))
    assert estimate.abs().max() == 0


def test_patches_are_told_apart_by_position_only():
    model, positions = stirred_model(), patches.positions(Architecture(5, (32, 16), 3), 16)
    noisy, level, widths = torch.randn(2, len(positions), 256), torch.rand(2), torch.tensor([3, 1, 0, 4])
    order = torch.randperm(len(positions))
    straight = model(noisy, level, positions, widths)
    torch.testing.assert_close(model(noisy[:, order], level, positions[order], widths), straight[:, order])


def test_the_estimate_depends_on_architecture_and_noise_level():
    model, positions = stirred_model(), patches.positions(Architecture(5, (32, 16), 3), 16)
    noisy, widths = torch.randn(1, len(positions), 256), torch.tensor([3, 1, 0, 4])
    first = model(noisy, torch.tensor([0.5]), positions, widths)
    assert not torch.allclose(model(noisy, torch.tensor([0.5]), positions, torch.tensor([3, 1, 2, 4])), first)
    assert not torch.allclose(model(noisy, torch.tensor([0.6]), positions, widths), first)


def test_it_learns_to_sample_the_networks_it_was_shown(view):
    """Two networks of one architecture: every sample comes close to one of them, and both come up."""
    architecture = view.architectures[0]
    shown = TrainingView("Push", {architecture: view.batch(architecture)[:2]})
    settings = {"width": 48, "steps": 250, "batch": 8, "warmup": 20, "ema": 0.95, "sampling_steps": 20}
    generator = NNiT(TINY.model_copy(update={**settings, "learning_rate": 3e-3}))
    generator.fit(shown)
    made, stored = generator.sample(SampleRequest(architecture, 16, 0)).flat(), shown.batch(architecture).flat()
    nearest = torch.cdist(made, stored).min(dim=1)
    assert (nearest.values / stored[nearest.indices].norm(dim=1)).mean() < 0.15
    assert set(nearest.indices.tolist()) == {0, 1}


def test_stopping_and_resuming_changes_nothing(view, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "LOG_STEPS", 1)
    straight, resumed = NNiT(TINY), NNiT(TINY)
    straight.fit(view, Run(seed=3))

    def stop(step, steps):
        if step == 4:
            raise KeyboardInterrupt

    saves = iter([0.0, 0.0, 1e9, 1e9])  # the last save before the stop is after step 2
    monkeypatch.setattr(training, "SAVE_SECONDS", 0.0)
    save = training.Trainer.save
    monkeypatch.setattr(training.Trainer, "save", lambda self, path: next(saves) or save(self, path))
    with pytest.raises(KeyboardInterrupt):
        resumed.fit(view, Run(seed=3, folder=tmp_path, progress=stop))
    monkeypatch.setattr(training.Trainer, "save", save)
    resumed.fit(view, Run(seed=3, folder=tmp_path))
    assert all(torch.equal(value, resumed.tensors()[name]) for name, value in straight.tensors().items())
    steps = [json.loads(line)["step"] for line in (tmp_path / training.LOG).read_text().splitlines()]
    assert steps == [1, 2, 3, 4, 5, 6]


def test_another_seed_gives_another_model_and_refuses_the_state(view, tmp_path):
    first, second = NNiT(TINY), NNiT(TINY)
    first.fit(view, Run(seed=0, folder=tmp_path))
    second.fit(view, Run(seed=1))
    assert not torch.equal(first.tensors()["patch_in.weight"], second.tensors()["patch_in.weight"])
    with pytest.raises(UserError, match="other settings, seed or data"):
        second.fit(view, Run(seed=1, folder=tmp_path))


def test_a_checkpoint_samples_the_same_networks(view, tmp_path):
    generator, request = NNiT(TINY), SampleRequest(view.architectures[1], 3, seed=5)
    generator.fit(view, Run(steps=2))
    generator.save_pretrained(tmp_path)
    back = NNiT.from_pretrained(tmp_path, "Push")
    assert back.training["steps"] == 2
    assert torch.equal(generator.sample(request).flat(), back.sample(request).flat())
    assert all(value.dtype == torch.float16 for value in back.tensors().values())


def test_it_samples_an_architecture_that_it_has_not_seen(view):
    generator = NNiT(TINY)
    generator.fit(view)
    wanted = Architecture(5, (32, 16), 3)
    batch = generator.sample(SampleRequest(wanted, 2, 0))
    assert isinstance(batch, PolicyBatch)
    assert batch.finite().all()


@pytest.mark.parametrize(
    ("architecture", "message"),
    [
        (Architecture(6, (16, 16), 3), "5 inputs"),
        (Architecture(5, (16, 16, 16), 3), "3 layers"),
        (Architecture(5, (16, 24), 3), r"knows the hidden widths \(16, 32\), not \[24\]"),
        (None, "request one"),
    ],
)
def test_a_request_it_cannot_meet_gets_an_answer(architecture, message, view):
    generator = NNiT(TINY)
    generator.fit(view, Run(steps=1))
    with pytest.raises(UserError, match=message):
        generator.sample(SampleRequest(architecture, 1, 0))


def test_reference_policies_are_never_learned(view):
    with pytest.raises(UserError, match="never for training"):
        NNiT(TINY).fit(TrainingView(view.task, view.batches, reference=True))


def test_an_unknown_preset_gets_an_answer():
    with pytest.raises(UserError, match="no preset of nnit named 'gpu'"):
        preset("gpu")


def test_standardised_networks_have_one_size_at_every_fan_in_and_come_back():
    wide, narrow = Architecture(5, (64, 64), 3), Architecture(5, (16, 64), 3)
    made = {each: gaussian_batch(each, 50) for each in (wide, narrow)}
    for batch in made.values():
        for layer in batch.layers:  # as a GHN makes them: weights shrink with the root of the fan-in, biases do not
            layer[:, :, :-1] *= 0.5 * (layer.shape[2] - 1) ** -0.5
            layer[:, :, -1] *= 0.2
    form = Form.of(TrainingView("Push", made))
    for batch in made.values():
        standardised = form.standardised(batch)
        for layer in standardised.layers:
            assert layer[:, :, :-1].std().item() == pytest.approx(1, abs=0.05)
            assert layer[:, :, -1].std().item() == pytest.approx(1, abs=0.15)
        torch.testing.assert_close(form.restored(standardised).flat(), batch.flat())
