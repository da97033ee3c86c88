"""NNiT: the transformer, both mixtures of noise levels, and training that can be stopped at any moment."""

import json
import math
from collections import Counter
from types import SimpleNamespace

import pytest
import torch

from nnit_baselines import FitOptions, SampleRequest
from nnit_baselines.nnit import training
from nnit_baselines.nnit.config import NNiTConfig, preset
from nnit_baselines.nnit.form import Form
from nnit_baselines.nnit.generator import NNiT
from nnit_baselines.nnit.mixture import Places
from nnit_baselines.nnit.model import Transformer
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views import canvas, patches
from nnit_zoo.zoo import TrainingView

SMALL = {"width": 32, "depth": 2, "heads": 2, "steps": 6, "batch": 4, "warmup": 2, "ema": 0.5, "sampling_steps": 3}
PACKED = NNiTConfig(**SMALL)
PADDED = NNiTConfig(**preset("paper").model_dump() | SMALL | {"canvas": 32, "precision": "float32", "chain": 50})
BOTH = pytest.mark.parametrize("settings", [PACKED, PADDED], ids=["packed", "padded"])
FORM = Form(5, 3, 3, (16, 32), 1.0, 1.0, fan_in_scaling=True)
ARCHITECTURE = Architecture(5, (32, 16), 3)


def inputs(settings, policies=2):
    """Codes, patches, places and levels of an architecture, as the transformer takes them."""
    where = Places.of(ARCHITECTURE, FORM, settings)
    codes = where.codes.expand(policies, -1, -1)
    return codes, torch.randn(policies, *where.mask.shape), where.places, torch.rand(policies, 2)


def stirred(settings, channels=1):
    """A model whose zero-initialised parts have been given values."""
    torch.manual_seed(0)
    model = Transformer(settings, channels=channels, widths=4, layers=3)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return model


def gaussian_batch(architecture, policies):
    torch.manual_seed(0)
    return PolicyBatch(architecture, tuple(torch.randn(policies, *shape) for shape in architecture.block_shapes))


def test_a_short_training_leaves_the_first_weights_behind():
    model = torch.nn.Linear(1, 1, bias=False)
    mixture = SimpleNamespace(settings=NNiTConfig(), loss=lambda model, data, step, seed: model.weight.sum())
    trainer = training.Trainer(model, [], mixture, seed=0)
    torch.nn.init.zeros_(trainer.mean.module.weight)
    torch.nn.init.ones_(model.weight)
    trainer.rate = lambda: 0.0
    for _ in range(100):
        trainer.advance()
    assert trainer.mean.module.weight.item() > 0.999


def test_what_is_kept_is_the_running_mean_of_the_weights():
    model = torch.nn.Linear(1, 1, bias=False)
    torch.nn.init.zeros_(model.weight)
    settings = NNiTConfig(steps=50, warmup=1, last_learning_rate=NNiTConfig().learning_rate, ema=0.99)
    mixture = SimpleNamespace(settings=settings, loss=lambda model, data, step, seed: -model.weight.sum())
    weights = []
    training.train(model, [], mixture, FitOptions(progress=lambda *_: weights.append(model.weight.item())))
    assert 0 < weights[0] < model.weight.item() < 0.95 * weights[-1]


# The transformer


@BOTH
def test_a_new_model_says_zero(settings):
    for output in Transformer(settings, channels=2, widths=4, layers=3)(*inputs(settings)):
        assert output.shape[:2] == (2, 2) and output.abs().max() == 0


@BOTH
def test_patches_are_told_apart_by_place_only(settings):
    model, (codes, noisy, places, levels) = stirred(settings), inputs(settings)
    order = torch.randperm(len(places))
    (widths, straight), (same, turned) = (
        model(codes, noisy, places, levels),
        model(codes, noisy[:, order], places[order], levels),
    )
    torch.testing.assert_close(turned, straight[:, :, order])
    torch.testing.assert_close(same, widths)


@BOTH
@pytest.mark.parametrize("changed", ["codes", "weights", "architecture level", "weight level"])
def test_both_outputs_depend_on_everything(settings, changed):
    model, (codes, noisy, places, levels) = stirred(settings), inputs(settings)
    before = model(codes, noisy, places, levels)
    if changed == "codes":
        codes = codes.roll(1, dims=2)
    elif changed == "weights":
        noisy = noisy + 1
    else:
        levels = levels.clone()
        levels[:, 0 if changed == "architecture level" else 1] += 0.1
    for first, second in zip(before, model(codes, noisy, places, levels), strict=True):
        assert not torch.allclose(first, second, rtol=1e-4)


def test_wide_conditioning_needs_clean_widths():
    with pytest.raises(UserError, match="needs clean widths"):
        NNiTConfig(padded=True)


# What it sees of a network


def test_standardised_networks_have_one_size_at_every_fan_in_and_come_back():
    wide, narrow = Architecture(5, (64, 64), 3), Architecture(5, (16, 64), 3)
    made = {each: gaussian_batch(each, 50) for each in (wide, narrow)}
    for batch in made.values():
        for layer in batch.layers:  # as a GHN makes them: weights shrink with the root of the fan-in, biases do not
            layer[:, :, :-1] *= 0.5 * (layer.shape[2] - 1) ** -0.5
            layer[:, :, -1] *= 0.2
    form = Form.of(TrainingView("Push", made), fan_in_scaling=True)
    for batch in made.values():
        standardised = form.standardised(batch)
        for layer in standardised.layers:
            assert layer[:, :, :-1].std().item() == pytest.approx(1, abs=0.05)
            assert layer[:, :, -1].std().item() == pytest.approx(1, abs=0.15)
        torch.testing.assert_close(form.restored(standardised).flat(), batch.flat())


def test_the_paper_divides_all_parameters_by_one_number(view):
    form = Form.of(view, fan_in_scaling=False)
    flat = torch.cat([form.standardised(view.batch(each)).flat().flatten() for each in view.architectures])
    assert flat.std().item() == pytest.approx(1, abs=1e-5)
    batch = view.batch(view.architectures[0])
    ratio = form.standardised(batch).flat() / batch.flat()
    torch.testing.assert_close(ratio, torch.full_like(ratio, 1 / form.weight_std))


def test_codes_are_told_apart_by_the_nearest():
    codes = torch.stack([FORM.codes(each) for each in (ARCHITECTURE, Architecture(5, (16, 16), 3))])
    assert codes.square().mean().item() == pytest.approx(1)
    assert set(codes.unique().tolist()) == set(FORM.code_values.tolist())
    noisy = codes + 0.3 * torch.randn(codes.shape, generator=torch.Generator().manual_seed(0))
    assert [str(each) for each in FORM.decode(noisy)] == ["32-16", "16-16"]


def test_places_of_patches_are_those_of_the_paper_s_grid():
    """A network's packed patches, put to their places on the padded grid, are its canvas cut into squares."""
    batch = gaussian_batch(ARCHITECTURE, 2)
    where = Places.of(ARCHITECTURE, FORM, PADDED)
    squares = canvas.pack(batch, 32).reshape(2, 3, 2, 16, 3, 16).transpose(3, 4).reshape(2, 18, 256)
    assert torch.equal(squares[:, where.places[:, 0]], patches.pack(batch))
    assert squares.count_nonzero() == batch.flat().count_nonzero()


# Training


def test_it_learns_to_sample_the_networks_it_was_shown(view, tmp_path):
    """Two networks of one architecture: every sample comes close to one of them, and both come up."""
    architecture = view.architectures[0]
    shown = TrainingView("Push", {architecture: view.batch(architecture)[:2]})
    settings = {"width": 48, "steps": 150, "batch": 8, "warmup": 20, "ema": 0.95, "sampling_steps": 10}
    generator = NNiT(PACKED.model_copy(update={**settings, "learning_rate": 3e-3}))
    generator.fit(shown, FitOptions(folder=tmp_path))
    logged = json.loads((tmp_path / training.LOG).read_text().splitlines()[-1])["quality"]
    made, stored = generator.sample(SampleRequest(architecture, 16, 0)).flat(), shown.batch(architecture).flat()
    nearest = torch.cdist(made, stored).min(dim=1)
    distances = nearest.values / stored[nearest.indices].norm(dim=1)
    assert distances.mean() < 0.15 and logged < 0.15
    assert set(nearest.indices.tolist()) == {0, 1}


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        pytest.param(PACKED, 150, id="packed"),
        pytest.param(PADDED.model_copy(update={"objective": "clean"}), 300, id="padded"),
        pytest.param(PADDED, 2500, id="paper", marks=pytest.mark.slow),
    ],
)
def test_it_learns_a_known_joint_distribution(settings, steps):
    """All weights of 4-4 are +1 and those of 8-4 are -1, and both are equally frequent."""
    one, other = Architecture(3, (4, 4), 2), Architecture(3, (8, 4), 2)
    shown = {
        each: PolicyBatch(each, tuple(torch.full((4, *shape), size) for shape in each.block_shapes))
        for each, size in ((one, 1.0), (other, -1.0))
    }
    # A prediction of noise has to carry every entry of a patch through a token: the width exceeds their number.
    sizes = {"patch": 4, "canvas": 8, "width": 48, "depth": 1, "fan_in_scaling": False}
    schedule = {"steps": steps, "batch": 32, "warmup": 20, "ema": 0.95, "sampling_steps": 25, "learning_rate": 3e-3}
    generator = NNiT(settings.model_copy(update=sizes | schedule))
    generator.fit(TrainingView("Push", shown))
    batches = generator.sample_joint(60, 0)
    found = Counter({batch.architecture: len(batch) for batch in batches})
    assert found.total() == 60 and found[one] + found[other] >= 54 and min(found[one], found[other]) >= 15
    for batch in (each for each in batches if each.architecture in shown):
        assert (batch.flat() - shown[batch.architecture].flat()[0]).abs().mean(dim=1).median() < 0.3
    conditional = generator.sample(SampleRequest(other, 8, 0)).flat()
    assert (conditional + 1).abs().mean() < 0.3


@BOTH
def test_stopping_and_resuming_changes_nothing(settings, view, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "LOG_STEPS", 1)
    straight, resumed = NNiT(settings), NNiT(settings)
    straight.fit(view, FitOptions(seed=3))

    def stop(step, steps):
        if step == 4:
            raise KeyboardInterrupt

    saves = iter([0.0, 0.0, 1e9, 1e9])  # the last save before the stop is after step 2
    monkeypatch.setattr(training, "SAVE_SECONDS", 0.0)
    save = training.Trainer.save
    monkeypatch.setattr(training.Trainer, "save", lambda self, path: next(saves) or save(self, path))
    with pytest.raises(KeyboardInterrupt):
        resumed.fit(view, FitOptions(seed=3, folder=tmp_path, progress=stop))
    monkeypatch.setattr(training.Trainer, "save", save)
    tracked = []
    resumed.fit(view, FitOptions(seed=3, folder=tmp_path, track=tracked.append))
    assert all(torch.equal(value, resumed.tensors()[name]) for name, value in straight.tensors().items())
    lines = [json.loads(line) for line in (tmp_path / training.LOG).read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert ["quality" in line for line in lines] == [False] * 5 + [True]
    assert tracked == lines[2:]


def test_another_seed_gives_another_model_and_refuses_the_state(view, tmp_path):
    first, second = NNiT(PACKED), NNiT(PACKED)
    first.fit(view, FitOptions(seed=0, folder=tmp_path))
    second.fit(view, FitOptions(seed=1))
    assert not torch.equal(first.tensors()["patch_in.weight"], second.tensors()["patch_in.weight"])
    with pytest.raises(UserError, match="other settings, seed or data"):
        second.fit(view, FitOptions(seed=1, folder=tmp_path))


def test_changed_code_of_nnit_refuses_the_state(view, tmp_path, monkeypatch):
    """A finished training would be given the new code's name."""
    NNiT(PACKED).fit(view, FitOptions(seed=0, folder=tmp_path / "state"))
    monkeypatch.setattr(training, "__file__", str(tmp_path / "nnit" / "training.py"))
    with pytest.raises(UserError, match="or by other code of NNiT"):
        NNiT(PACKED).fit(view, FitOptions(seed=0, folder=tmp_path / "state"))


@pytest.mark.parametrize(("decay", "half"), [("linear", 6.5e-5), ("cosine", 6.5e-5)])
def test_the_learning_rate_rises_then_falls_to_its_last_value(decay, half):
    settings = NNiTConfig(decay=decay, learning_rate=1e-4, last_learning_rate=3e-5, warmup=500, steps=10_000)
    trainer = SimpleNamespace(settings=settings, step=0)
    rates = {}
    for trainer.step in (0, 249, 5000, 7500, 10_000):
        rates[trainer.step] = training.Trainer.rate(trainer)
    assert rates[0] == pytest.approx(1e-4 / 500, rel=1e-3)
    assert rates[249] == pytest.approx(0.5e-4, rel=0.02)
    assert rates[5000] == pytest.approx(half)
    quarter = 0.5 - 0.5 * math.cos(math.pi / 4) if decay == "cosine" else 0.25
    assert rates[7500] == pytest.approx(3e-5 + quarter * 7e-5)
    assert rates[10_000] == pytest.approx(3e-5)


def test_training_in_bfloat16_gives_a_model(view):
    generator = NNiT(PADDED.model_copy(update={"precision": "bfloat16"}))
    generator.fit(view)
    assert generator.sample(SampleRequest(view.architectures[0], 1, 0)).finite().all()


# Sampling and storing


@BOTH
def test_a_checkpoint_samples_the_same_networks(settings, view, tmp_path):
    generator, request = NNiT(settings), SampleRequest(view.architectures[1], 3, seed=5)
    generator.fit(view, FitOptions(steps=2))
    generator.save_pretrained(tmp_path)
    back = NNiT.from_pretrained(tmp_path, view.task)
    assert back.settings == generator.settings and back.capabilities == generator.capabilities
    assert torch.equal(back.sample(request).flat(), generator.sample(request).flat())
    for first, second in zip(back.sample_joint(5, 0), generator.sample_joint(5, 0), strict=True):
        assert first.architecture == second.architecture and torch.equal(first.flat(), second.flat())
    for name, tensor in back.tensors().items():
        assert torch.equal(tensor, generator.tensors()[name])


@BOTH
def test_it_samples_an_architecture_that_it_has_not_seen(settings, view):
    generator = NNiT(settings)
    generator.fit(view)
    assert generator.supports(ARCHITECTURE)
    assert generator.sample(SampleRequest(ARCHITECTURE, 2, 0)).finite().all()


@pytest.mark.parametrize(
    ("architecture", "message"),
    [
        (Architecture(6, (16, 16), 3), "5 inputs"),
        (Architecture(5, (16, 16, 16), 3), "3 layers"),
        (Architecture(5, (16, 24), 3), r"knows the hidden widths \(16, 32\), not \[24\]"),
    ],
)
def test_a_request_it_cannot_meet_gets_an_answer(architecture, message, view):
    generator = NNiT(PACKED)
    generator.fit(view, FitOptions(steps=1))
    assert architecture.inputs == 6 or not generator.supports(architecture)
    with pytest.raises(UserError, match=message):
        generator.sample(SampleRequest(architecture, 1, 0))


def test_without_joint_training_it_does_not_choose_architectures(view):
    generator = NNiT(PACKED.model_copy(update={"joint": False}))
    generator.fit(view, FitOptions(steps=1))
    assert not generator.capabilities.joint
    with pytest.raises(UserError, match="not trained to choose"):
        generator.sample_joint(3, 0)


def test_an_unknown_preset_gets_an_answer():
    with pytest.raises(UserError, match="no preset of nnit named 'gpu'"):
        NNiT.from_preset("gpu")


def test_the_preset_paper_holds_the_paper_s_hyperparameters():
    """NNiT, table 8, PickCube."""
    paper = NNiT.from_preset("paper").settings
    assert (paper.objective, paper.chain, paper.precision, paper.decay) == ("noise", 1000, "bfloat16", "cosine")
    assert (paper.learning_rate, paper.last_learning_rate, paper.warmup) == (7e-5, 3e-5, 500)
    assert (paper.clip, paper.ema, paper.batch, paper.steps) == (1.0, 0.9999, 16, 1300 * 6400 // 16)
    assert paper.joint and paper.padded


def test_a_class_with_settings_of_its_own_comes_back_from_its_checkpoint(view, tmp_path):
    generator = Narrow()
    generator.fit(view, FitOptions(steps=1))
    generator.save_pretrained(tmp_path)
    back = Narrow.from_pretrained(tmp_path)
    assert back.settings == generator.settings and back.settings.patch == 8
    assert "preset none; predicts clean weights" in (tmp_path / "README.md").read_text()


class Narrow(NNiT):
    def __init__(self):
        super().__init__(NNiTConfig(**SMALL | {"patch": 8}))
