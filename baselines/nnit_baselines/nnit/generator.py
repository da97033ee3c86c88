"""NNiT behind the Generator interface: fit, sample, checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, Self

import torch
from torch import Tensor

from nnit_baselines.generator import Capabilities, FitOptions, Generator, SampleRequest, refuse_reference
from nnit_baselines.nnit import training
from nnit_baselines.nnit.config import NNiTConfig, preset, preset_name
from nnit_baselines.nnit.form import Form
from nnit_baselines.nnit.mixture import Mixture, Packed, PackedMixture, PaddedMixture
from nnit_baselines.nnit.model import Transformer
from nnit_baselines.quantise import quantised, restored
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views import patches
from nnit_zoo.zoo import TrainingView


class NNiT(Generator):
    """Diffusion transformer over architecture tokens and weight patches: p(w | a) and p(a, w) (NNiT 5)."""

    capabilities = Capabilities(joint=True)
    licence = "cc-by-4.0"

    def __init__(self, settings: NNiTConfig | None = None) -> None:
        self.settings = settings or NNiTConfig()
        self.form: Form
        self.model: Transformer
        self.stored: dict[str, Tensor]

    @property
    def description(self) -> str:
        """What it is, and how far it is the paper's."""
        settings = f"preset {preset_name(self.settings) or 'none'}"
        predicts = "clean weights, not the noise as in the paper" if self.settings.objective == "clean" else "the noise"
        joint = "can" if self.settings.joint else "cannot"
        return f"{super().description} Its settings: {settings}; predicts {predicts}; {joint} choose architectures."

    @classmethod
    def from_preset(cls, name: str) -> Self:
        """An NNiT with the settings `cpu` (ours, the default) or `paper`; raises UserError for another name."""
        return cls(preset(name))

    def fit(self, view: TrainingView, options: FitOptions | None = None) -> None:
        """Train on a view, going on from the state in `options.folder` if there is one.

        Stopping and resuming gives the same weights as not stopping. Raises UserError for a reference view, or if the
        state is of another training.
        """
        refuse_reference(view)
        options = options or FitOptions()
        if options.steps is not None:
            self.settings = self.settings.model_copy(update={"steps": options.steps})
        self.task = view.task
        with torch.random.fork_rng():
            torch.manual_seed(options.seed)  # only the initial weights; a step's batch has a generator of its own
            self._take(Form.of(view, fan_in_scaling=self.settings.fan_in_scaling))
        data = [Packed.of(view.batch(each), self.form, self.settings) for each in view.architectures]
        facts = training.train(self.model, data, self.mixture, options)
        settings = preset_name(self.settings)
        self.training_facts = {**({"preset": settings} if settings else {}), **facts}
        self._restore(quantised({name: tensor.cpu() for name, tensor in self.model.state_dict().items()}))

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """Networks of the requested architecture; raises UserError if its form or widths are not those learned."""
        generator = torch.Generator().manual_seed(request.seed)
        with torch.inference_mode():
            clean = self.mixture.sample(self.model, request.architecture, request.policies, generator)
        return self._policies(clean, request.architecture)

    def sample_joint(self, policies: int, seed: int) -> list[PolicyBatch]:
        """Networks of architectures drawn with them; raises UserError if the settings leave that out."""
        if not self.settings.joint:
            raise UserError("this nnit was not trained to choose architectures: request one")
        generator = torch.Generator().manual_seed(seed)
        with torch.inference_mode():
            clean = self.mixture.sample_joint(self.model, policies, generator)
        return [self._policies(tokens, architecture) for architecture, tokens in clean.items()]

    def config(self) -> dict[str, Any]:
        """The form of its networks and the settings."""
        return {"form": asdict(self.form), "settings": self.settings.model_dump()}

    def tensors(self) -> dict[str, Tensor]:
        """The transformer's parameters as its checkpoint has them: quantised, or all in float16."""
        return self.stored

    @classmethod
    def from_state(cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """The NNiT with this form, these settings and parameters."""
        generator = cls()
        generator.settings = NNiTConfig.model_validate(config["settings"])
        form = dict(config["form"])
        generator._take(Form(**form | {"vocabulary": tuple(form["vocabulary"])}))
        generator._restore(tensors)
        return generator

    @property
    def sampling_steps(self) -> int:
        """In how many steps it samples."""
        return self.settings.sampling_steps

    @sampling_steps.setter
    def sampling_steps(self, steps: int) -> None:
        self.settings = self.settings.model_copy(update={"sampling_steps": steps})

    @property
    def mixture(self) -> Mixture:
        """How this NNiT's settings mix noise levels."""
        return (PaddedMixture if self.settings.padded else PackedMixture)(self.settings, self.form)

    def _take(self, form: Form) -> None:
        """A new model for networks of this form, and what it can do."""
        self.form = form
        channels = self.mixture.objective.channels
        self.model = Transformer(self.settings, channels=channels, widths=form.widths, layers=form.layers)
        self.model.to("cuda" if torch.cuda.is_available() else "cpu")
        depths = (form.layers - 1,)
        self.capabilities = replace(NNiT.capabilities, joint=self.settings.joint, widths=form.vocabulary, depths=depths)

    def _restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take stored parameters; a model just fitted does so too, to be the same as one read from its checkpoint."""
        self.stored = dict(tensors)
        self.model.load_state_dict(restored(tensors))
        self.model.eval()

    def _policies(self, tokens: Tensor, architecture: Architecture) -> PolicyBatch:
        return self.form.restored(patches.unpack(tokens, architecture, self.settings.patch))
