"""`nnit-bench check`: a generator that keeps the contract passes, and each way to break it is told in words."""

import json

import numpy as np
import pytest
import torch

from nnit_baselines import Capabilities, Generator, get, refuse_reference
from nnit_baselines.registry import BUILT_IN
from nnit_bench import check
from nnit_bench.check import SEEN, examine, synthetic_view
from nnit_zoo.architecture import Architecture, hidden_widths
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch


class Good(Generator):
    """Fresh networks, conditional and joint, with a checkpoint."""

    capabilities = Capabilities(joint=True, widths=(16, 32, 64), depths=(4,))
    scale = 1.0

    def fit(self, view, options=None):
        refuse_reference(view)
        self.task = view.task
        self.known = view.architectures

    def sample(self, request):
        if not self.supports(request.architecture):
            raise UserError("no")
        return self.fresh(request.architecture, request.policies, torch.Generator().manual_seed(request.seed))

    def sample_joint(self, policies, seed):
        generator = torch.Generator().manual_seed(seed)
        first = policies // 2
        one, other = (Architecture.parse(text, 42, 8) for text in sorted(SEEN[1:3]))
        sizes = [(one, first), (other, policies - first)]
        return [self.fresh(each, count, generator) for each, count in sizes if count]

    def fresh(self, architecture, policies, generator):
        shapes = architecture.block_shapes
        drawn = (self.scale * torch.randn(policies, *shape, generator=generator) for shape in shapes)
        return PolicyBatch(architecture, tuple(drawn))

    def config(self):
        return {"scale": self.scale}

    def tensors(self):
        return {"unused": torch.zeros(1)}

    @classmethod
    def from_state(cls, config, tensors):
        generator = cls()
        generator.scale = config["scale"]
        return generator


def problems(kind):
    return [verdict.problem for verdict in examine(kind) if verdict.problem]


def doctored(batch, change):
    return PolicyBatch(batch.architecture, tuple(change(layer) for layer in batch.layers))


def test_the_synthetic_zoo_trains_on_seen_architectures_only():
    view = synthetic_view()
    assert {str(each) for each in view.architectures} <= set(hidden_widths("seen"))
    assert view.batches[view.architectures[0]].layers[0].dtype == torch.float16


def test_a_good_generator_keeps_every_clause():
    verdicts = list(examine(Good))
    assert [verdict.problem for verdict in verdicts] == [None] * len(check.CLAUSES)


@pytest.mark.parametrize("name", sorted(set(BUILT_IN) - {"nnit"}))
def test_the_controls_keep_the_contract(name):
    assert problems(get(name)) == []


def test_nnit_keeps_the_contract(monkeypatch):
    small = {"width": 16, "depth": 1, "heads": 1, "batch": 4, "sampling_steps": 2}
    kind = get("nnit")
    make = kind.__init__

    def shrunk(self, settings=None):
        make(self, settings)
        self.settings = self.settings.model_copy(update=small)

    monkeypatch.setattr(kind, "__init__", shrunk)
    assert problems(kind) == []


class NeedsArguments(Good):
    def __init__(self, size):
        super().__init__()


class Undeclared(Good):
    capabilities = None


class DoesNothing(Good):
    capabilities = Capabilities(conditional=False)


class LearnsYardsticks(Good):
    def fit(self, view, options=None):
        self.task, self.known = view.task, view.architectures


class ForgetsTask(Good):
    def fit(self, view, options=None):
        refuse_reference(view)


class FailsToFit(Good):
    def fit(self, view, options=None):
        refuse_reference(view)
        return {}["missing"]


class WrongCount(Good):
    def sample(self, request):
        return super().sample(request)[:2]


class WrongJointCount(Good):
    def sample_joint(self, policies, seed):
        return super().sample_joint(policies, seed)[:1]


class Unordered(Good):
    def sample_joint(self, policies, seed):
        return super().sample_joint(policies, seed)[::-1]


class Doubles(Good):
    def sample(self, request):
        return super().sample(request).to(torch.float64)


class NotFinite(Good):
    def sample(self, request):
        return doctored(super().sample(request), lambda layer: layer / 0)


class NotABatch(Good):
    def sample(self, request):
        return super().sample(request).layers


class FitsAtRandom(Good):
    def fit(self, view, options=None):
        super().fit(view, options)
        self.scale = float(np.random.default_rng().normal())


class GlobalDraws(Good):
    def fresh(self, architecture, policies, generator):
        return super().fresh(architecture, policies, torch.default_generator)


class Remembers(Good):
    def fresh(self, architecture, policies, generator):
        self.seen = {*getattr(self, "seen", ()), int(generator.initial_seed())}
        return doctored(super().fresh(architecture, policies, generator), lambda layer: layer * len(self.seen))


class SeedsNothing(Good):
    def fresh(self, architecture, policies, generator):
        return super().fresh(architecture, policies, torch.Generator().manual_seed(0))


class Copies(Good):
    def fresh(self, architecture, policies, generator):
        return super().fresh(architecture, 1, generator)[[0] * policies]


class ClaimsDeterministic(Good):
    capabilities = Capabilities(widths=(16, 32, 64), depths=(4,), deterministic=True)


class SeedsGlobally(Good):
    def fit(self, view, options=None):
        super().fit(view)
        torch.manual_seed(0)


class ScalesTheZoo(Good):
    def fit(self, view, options=None):
        super().fit(view)
        view.batches[view.architectures[0]].layers[0].mul_(2)


class AnswersWithAnother(Good):
    """Asked for widths that it does not know, it gives others; so it seems to support all."""

    capabilities = Capabilities(depths=(4,))

    def sample(self, request):
        known = request.architecture if set(request.architecture.hidden) <= {16, 32, 64} else self.known[0]
        return self.fresh(known, request.policies, torch.Generator().manual_seed(request.seed))


class Overclaims(Good):
    capabilities = Capabilities()

    def sample(self, request):
        if request.architecture not in self.known:
            raise UserError("not that one")
        return self.fresh(request.architecture, request.policies, torch.Generator().manual_seed(request.seed))


class Underclaims(Good):
    def sample(self, request):
        return self.fresh(request.architecture, request.policies, torch.Generator().manual_seed(request.seed))


class DisownsTheZoo(Good):
    capabilities = Capabilities(widths=(16,))


class Crashes(Good):
    def sample(self, request):
        return super().sample(request) if self.supports(request.architecture) else request.nonsense


class ComesBackOther(Good):
    @classmethod
    def from_state(cls, config, tensors):
        generator = cls()
        generator.scale = 2.0
        return generator


class CrashesInTorch(Good):
    def sample(self, request):
        return torch.nn.Linear(2, 2)(torch.zeros(1, 3))


class Learns(Good):
    def fresh(self, architecture, policies, generator):
        return doctored(super().fresh(architecture, policies, generator), lambda layer: layer.requires_grad_())


class OtherTask(Good):
    def sample_joint(self, policies, seed):
        draws = torch.Generator().manual_seed(seed)
        return [self.fresh(Architecture.parse("16-16-32-16", 7, 3), policies, draws)]


class ForgetsItsLimits(Good):
    def fit(self, view, options=None):
        super().fit(view)
        self.capabilities = Capabilities(joint=True, widths=(16, 32, 64), depths=(4,), deterministic=False)

    def from_state(config, tensors):
        generator = ForgetsItsLimits()
        generator.capabilities = Capabilities(joint=True)
        return generator


class ForgetsWhatItSupports(Good):
    limit = 64

    def supports(self, architecture):
        return super().supports(architecture) and max(architecture.hidden) <= self.limit

    @classmethod
    def from_state(cls, config, tensors):
        generator = cls()
        generator.limit = 16
        return generator


class KeepsNothing(Good):
    def tensors(self):
        return Generator.tensors(self)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (NeedsArguments, "missing 1 required positional argument: 'size'"),
        (Undeclared, r"must be a Capabilities\(...\), not None"),
        (DoesNothing, "there is nothing to ask it for"),
        (LearnsYardsticks, r"begin fit with: refuse_reference\(view\)"),
        (ForgetsTask, "task is '', not 'PickCube-v1'"),
        (FailsToFit, "KeyError: 'missing'"),
        (WrongCount, "sample gave 2 of"),
        (WrongJointCount, "asked for 11 networks, sample_joint gave 5"),
        (Unordered, "in the order of architectures"),
        (Doubles, r"gave torch.float64; end with: batch.to\(torch.float32\)"),
        (NotFinite, "with NaN or infinite"),
        (NotABatch, "gave a tuple, not a PolicyBatch"),
        (GlobalDraws, "two calls of sample with one seed"),
        (FitsAtRandom, "two fits with one seed gave different generators"),
        (Remembers, "other networks after other requests"),
        (SeedsNothing, "same networks for two seeds"),
        (Copies, "same network twice"),
        (ClaimsDeterministic, "declares deterministic=True, but"),
        (SeedsGlobally, "fit used the global random numbers"),
        (ScalesTheZoo, "fit changed the view's policies"),
        (Overclaims, "supports 16-16-16-32, but sample answers: not that one"),
        (AnswersWithAnother, "sample was asked for 2 of 24-16-40-24, and gave 2 of"),
        (Underclaims, "it made 24-16-40-24, which it says that it does not support"),
        (DisownsTheZoo, "does not support 64-64-64-64, an architecture that it was fitted on"),
        (Crashes, r"AttributeError.*nonsense.*\(test_check.py, line"),
        (CrashesInTorch, r"RuntimeError: mat1.*\(test_check.py, line"),
        (Learns, r"sample gave layers that require a gradient; sample under torch.inference_mode\(\)"),
        (OtherTask, "sample_joint gave networks of 7 inputs and 3 outputs, but the task has 42 and 8"),
        (ForgetsItsLimits, "let from_state narrow them as fit does"),
        (ForgetsWhatItSupports, "supports answers otherwise for 64-64-64-64"),
        (ComesBackOther, "after save_pretrained and from_pretrained, sample gives other networks"),
        (KeepsNothing, "keeps no checkpoint"),
    ],
)
def test_what_is_broken_is_said(kind, words):
    with pytest.raises(AssertionError, match=words):
        assert problems(kind) == []


def test_the_command_prints_verdicts_and_says_it_with_its_exit_code(plugin, capsys):
    check.check(method="crop")
    assert capsys.readouterr().out.endswith("crop keeps the contract\n")
    broken = plugin.parent / "broken.py"
    broken.write_text(plugin.read_text().replace("torch.zeros(", "torch.rand("))
    with pytest.raises(SystemExit, match="1"):
        check.check(method=f"{broken}:Zeros", as_json=True)
    answer = json.loads(capsys.readouterr().out)
    assert not answer["kept"] and any("two calls of sample" in str(each["problem"]) for each in answer["clauses"])
