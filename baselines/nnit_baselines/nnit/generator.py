"""NNiT behind the Generator interface: networks to patches and back, fit, sample, checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from nnit_baselines import diffusion
from nnit_baselines.generator import Capabilities, Generator, Run, SampleRequest, refuse_reference
from nnit_baselines.nnit import training
from nnit_baselines.nnit.config import NNiTConfig
from nnit_baselines.nnit.model import Transformer
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views import patches
from nnit_zoo.zoo import TrainingView


@dataclass(frozen=True)
class Form:
    """The networks that one NNiT can make, and the scale of their weights."""

    inputs: int
    outputs: int
    layers: int
    vocabulary: tuple[int, ...]
    """Hidden widths."""
    weight_std: float
    """Standard deviation, over the training view, of weights times the root of their layer's fan-in."""
    bias_std: float
    """Standard deviation of the biases."""

    @classmethod
    def of(cls, view: TrainingView) -> Form:
        """The form of the networks in a view; raises UserError if they differ in depth, inputs or outputs."""
        shapes = {(each.inputs, each.outputs, len(each.hidden) + 1) for each in view.architectures}
        if len(shapes) != 1:
            raise UserError(f"nnit needs networks with equal inputs, outputs and layers, not {sorted(shapes)}")
        vocabulary = {width for each in view.architectures for width in each.hidden}
        raw = cls(*shapes.pop(), tuple(sorted(vocabulary)), 1.0, 1.0)
        layers = [layer for each in view.architectures for layer in raw.standardised(view.batch(each)).layers]
        weights = torch.cat([layer[:, :, :-1].flatten() for layer in layers])
        biases = torch.cat([layer[:, :, -1].flatten() for layer in layers])
        return replace(raw, weight_std=float(weights.double().std()), bias_std=float(biases.double().std()))

    def standardised(self, batch: PolicyBatch) -> PolicyBatch:
        """The networks with weights and biases of standard deviation one, and weights of one size at every fan-in.

        The paper divides by one global deviation; without the root of the fan-in, a neuron's weights change size with
        the width before it, and the distance to the zoo after equal training is a sixth larger (docs/deviations.md).
        """
        return self._scaled(batch, backwards=False)

    def restored(self, batch: PolicyBatch) -> PolicyBatch:
        """The inverse of `standardised`."""
        return self._scaled(batch, backwards=True)

    def _scaled(self, batch: PolicyBatch, *, backwards: bool) -> PolicyBatch:
        layers = []
        for layer in batch.layers:
            fan_in = layer.shape[2] - 1
            size = torch.tensor([self.weight_std * fan_in**-0.5] * fan_in + [self.bias_std])
            layers.append(layer * size if backwards else layer / size)
        return PolicyBatch(batch.architecture, tuple(layers))

    def tokens(self, architecture: Architecture) -> Tensor:
        """The index of each width, [S]: hidden ones by the vocabulary, then one for inputs and one for outputs.

        Raises UserError for an architecture of another form.
        """
        shape = (architecture.inputs, architecture.outputs, len(architecture.hidden) + 1)
        if shape != (self.inputs, self.outputs, self.layers):
            raise UserError(
                f"this nnit makes networks of {self.inputs} inputs, {self.outputs} outputs and {self.layers} layers; "
                f"{architecture} has {shape[0]}, {shape[1]} and {shape[2]}"
            )
        if strange := set(architecture.hidden) - set(self.vocabulary):
            raise UserError(f"this nnit knows the hidden widths {self.vocabulary}, not {sorted(strange)}")
        hidden = [self.vocabulary.index(width) for width in architecture.hidden]
        return torch.tensor([len(self.vocabulary), *hidden, len(self.vocabulary) + 1])


class NNiT(Generator):
    """Diffusion transformer over the patches of a network, conditioned on its architecture (NNiT 5).

    First cut: conditional generation only; the joint mode of NNiT 5.3 is not there yet.
    """

    capabilities = Capabilities()

    def __init__(self, settings: NNiTConfig | None = None) -> None:
        super().__init__()
        self.settings = settings or NNiTConfig()
        self.form: Form
        self.model: Transformer

    def fit(self, view: TrainingView, run: Run | None = None) -> None:
        """Train on a view, going on from the state in `run.folder` if there is one.

        Stopping and resuming gives the same weights as not stopping. Raises UserError for a reference view, or if the
        state is of another training.
        """
        refuse_reference(view)
        run = run or Run()
        self.task, self.form = view.task, Form.of(view)
        settings = self.settings.model_copy(update={} if run.steps is None else {"steps": run.steps})
        self.settings = settings
        data = [self._packed(view.batch(each)) for each in view.architectures]
        torch.manual_seed(run.seed)  # only the initial weights; a step's batch has a generator of its own
        self.model = self._new_model()
        self.training = training.train(self.model, data, settings, run)
        self._restore(self.tensors())

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """Networks of the requested architecture; raises UserError if its form or widths are not those learned."""
        if request.architecture is None:
            raise UserError("this nnit cannot choose architectures: request one")
        architecture, patch = request.architecture, self.settings.patch
        widths = self.form.tokens(architecture)
        positions = patches.positions(architecture, patch, self.settings.canvas)
        mask = patches.mask(architecture, patch)
        generator = torch.Generator().manual_seed(request.seed)
        noise = torch.randn(request.policies, *mask.shape, generator=generator) * mask

        def denoise(noisy: Tensor, level: Tensor) -> Tensor:
            estimate: Tensor = self.model(noisy, level, positions, widths)
            return estimate * mask

        with torch.inference_mode():
            clean = diffusion.euler(denoise, noise, self.settings.sampling_steps)
        return self.form.restored(patches.unpack(clean, architecture, patch))

    def config(self) -> dict[str, Any]:
        """The form of its networks and the settings."""
        return {**vars(self.form), "settings": self.settings.model_dump()}

    def tensors(self) -> dict[str, Tensor]:
        """The transformer's parameters in float16."""
        return {name: tensor.half().contiguous() for name, tensor in self.model.state_dict().items()}

    @classmethod
    def from_state(cls, config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """The NNiT with this form, these settings and parameters."""
        generator = cls(NNiTConfig.model_validate(config["settings"]))
        inputs, outputs, layers = config["inputs"], config["outputs"], config["layers"]
        deviations = config["weight_std"], config["bias_std"]
        generator.form = Form(inputs, outputs, layers, tuple(config["vocabulary"]), *deviations)
        generator.model = generator._new_model()
        generator._restore(tensors)
        return generator

    def _new_model(self) -> Transformer:
        settings = self.settings
        return Transformer(
            settings.patch,
            settings.width,
            settings.depth,
            settings.heads,
            widths=len(self.form.vocabulary) + 2,
            layers=self.form.layers,
            side=settings.canvas // settings.patch,
        )

    def _restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Take stored parameters; a model just fitted does so too, to be the same as one read from its checkpoint."""
        self.model.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        self.model.eval()

    def _packed(self, batch: PolicyBatch) -> training.Packed:
        architecture, patch = batch.architecture, self.settings.patch
        return training.Packed(
            patches.pack(self.form.standardised(batch), patch),
            patches.mask(architecture, patch),
            patches.positions(architecture, patch, self.settings.canvas),
            self.form.tokens(architecture),
        )
