"""Mixture of noise levels: what is noised when an NNiT trains, and in which order its sampling clears it (NNiT 5.3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nnit_baselines.diffusion import CleanPrediction, Denoiser, NoisePrediction, Objective
from nnit_baselines.draws import draw, shuffled, step_generator
from nnit_baselines.nnit.config import NNiTConfig
from nnit_baselines.nnit.form import Form
from nnit_baselines.nnit.model import Transformer
from nnit_zoo.architecture import Architecture
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views import patches

ARCHITECTURE_STEPS = 4
"""Every how many steps `PackedMixture` learns p(a): each time costs a sixth of a step."""


@dataclass(frozen=True)
class Places:
    """Where an architecture's patches stand: of L patches with parameters, out of all cells of the grid."""

    codes: Tensor
    """One-hot codes of the widths, [S, V]."""
    places: Tensor
    """[L, 3], as `Transformer.forward` takes them."""
    mask: Tensor
    """[L, p p], whether an entry is a parameter."""

    @classmethod
    def of(cls, architecture: Architecture, form: Form, settings: NNiTConfig) -> Places:
        """The places of an architecture; raises UserError if it is not of the form."""
        patch, side = settings.patch, settings.canvas // settings.patch
        layer, row, column = patches.positions(architecture, patch, settings.canvas).unbind(1)
        widths = form.tokens(architecture)
        places = torch.stack([(layer * side + row) * (side + 1) + column, widths[layer], widths[layer + 1]], dim=1)
        return cls(form.codes(architecture), places, patches.mask(architecture, patch))


@dataclass(frozen=True)
class Packed:
    """All policies of one architecture as patches."""

    architecture: Architecture
    where: Places
    patches: Tensor
    """[policies, L, p p], standardised."""

    @classmethod
    def of(cls, batch: PolicyBatch, form: Form, settings: NNiTConfig) -> Packed:
        """The policies of a batch; raises UserError if their architecture is not of the form."""
        where = Places.of(batch.architecture, form, settings)
        return cls(batch.architecture, where, patches.pack(form.standardised(batch), settings.patch))


class Mixture(ABC):
    """How architecture and weights share the noise, for one form of networks."""

    def __init__(self, settings: NNiTConfig, form: Form) -> None:
        self.settings, self.form = settings, form
        self.objective: Objective = (
            CleanPrediction(settings.level_mean, settings.level_std, settings.level_floor)
            if settings.objective == "clean"
            else NoisePrediction(settings.chain)
        )

    @abstractmethod
    def loss(self, model: Transformer, data: Sequence[Packed], step: int, seed: int) -> Tensor:
        """The loss of a training step, whose batch and noise follow from `step` and `seed` alone."""

    @abstractmethod
    def sample(self, model: Transformer, architecture: Architecture, count: int, generator: torch.Generator) -> Tensor:
        """Patches [count, L, p p] of networks of an architecture: p(w | a)."""

    @abstractmethod
    def sample_joint(self, model: Transformer, count: int, generator: torch.Generator) -> dict[Architecture, Tensor]:
        """Architectures in order, and patches [n, L, p p] of n networks of each, `count` in all: p(a, w)."""

    def ask(
        self, model: Transformer, codes: Tensor, weights: Tensor, places: Tensor, levels: tuple[Tensor, Tensor]
    ) -> tuple[Tensor | None, Tensor]:
        """What the network says of noisy codes and patches at the two noise levels [n]: float32, on the CPU.

        Wherever the network runs, and whatever it computes in.
        """
        codes, weights = (
            noisy * self.objective.input_scale(level)[:, None, None]
            for noisy, level in zip((codes, weights), levels, strict=True)
        )
        device = model.patch_out.device
        half = model.training and self.settings.precision == "bfloat16"
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            inputs = (each.to(device) for each in (codes, weights, places, torch.stack(levels, dim=1)))
            widths, patches_out = model(*inputs)
        return None if widths is None else widths.float().cpu(), patches_out.float().cpu()

    def _draw(self, denoise: Denoiser, noise: Tensor, generator: torch.Generator) -> Tensor:
        return self.objective.sample(denoise, noise, self.settings.sampling_steps, generator)


class PackedMixture(Mixture):
    """Ours: the weights of one architecture are noised, and its widths apart from any weights.

    p(a, w) = p(a) p(w | a), with the same network for both: weights learn beside a clean architecture, and the
    architecture without weights, as if theirs were all noise. The second is learned soon: some steps do both.
    """

    def loss(self, model: Transformer, data: Sequence[Packed], step: int, seed: int) -> Tensor:
        """That of the weights of some policies of one architecture, and at times that of as many architectures."""
        generator, objective = step_generator(step, seed), self.objective
        packed = data[shuffled(len(data), 1, step, seed)[0]]
        clean = packed.patches[draw(len(packed.patches), self.settings.batch, generator)]
        level = objective.levels(len(clean), generator)
        noise = torch.randn(clean.shape, generator=generator) * packed.where.mask
        output = self._weights(model, packed.where, objective.noisy(clean, noise, level), level)
        loss = objective.loss(output, clean, noise, level, packed.where.mask)
        if not self.settings.joint or step % ARCHITECTURE_STEPS:
            return loss
        codes = torch.stack([data[each].where.codes for each in draw(len(data), self.settings.batch, generator)])
        level = objective.levels(len(codes), generator)
        noise = torch.randn(codes.shape, generator=generator)
        output = self._widths(model, objective.noisy(codes, noise, level), level)
        return loss + objective.loss(output, codes, noise, level, values=self.form.code_values)

    def sample(self, model: Transformer, architecture: Architecture, count: int, generator: torch.Generator) -> Tensor:
        """Patches of networks of an architecture."""
        where = Places.of(architecture, self.form, self.settings)
        noise = torch.randn(count, *where.mask.shape, generator=generator) * where.mask

        def denoise(noisy: Tensor, level: Tensor) -> Tensor:
            # Steps that add fresh noise add it where there is no parameter too; in training that is always 0.
            return self._weights(model, where, noisy * where.mask, level) * where.mask

        return self._draw(denoise, noise, generator)

    def sample_joint(self, model: Transformer, count: int, generator: torch.Generator) -> dict[Architecture, Tensor]:
        """Architectures first, then weights for each."""
        noise = torch.randn(count, self.form.layers + 1, self.form.widths, generator=generator)
        codes = self._draw(lambda noisy, level: self._widths(model, noisy, level), noise, generator)
        chosen = Counter(self.form.decode(codes))
        return {each: self.sample(model, each, chosen[each], generator) for each in sorted(chosen)}

    def _weights(self, model: Transformer, where: Places, noisy: Tensor, level: Tensor) -> Tensor:
        """What the network says of the noisy patches of a clean architecture."""
        codes = where.codes.expand(len(noisy), -1, -1)
        return self.ask(model, codes, noisy, where.places, (torch.zeros_like(level), level))[1]

    def _widths(self, model: Transformer, noisy: Tensor, level: Tensor) -> Tensor:
        """What the network says of noisy codes, without any weights."""
        nothing, nowhere = noisy.new_zeros(len(noisy), 0, self.settings.patch**2), torch.zeros(0, 3, dtype=torch.long)
        widths, _ = self.ask(model, noisy, nothing, nowhere, (level, torch.ones_like(level)))
        assert widths is not None
        return widths


class PaddedMixture(Mixture):
    """The paper's: the whole grid is noised, for half of the batches together with the architecture (NNiT 5.3, A)."""

    def loss(self, model: Transformer, data: Sequence[Packed], step: int, seed: int) -> Tensor:
        """That of weights and widths: both at one noise level, or the widths clean, and then with no noise to find."""
        generator, objective, batch = step_generator(step, seed), self.objective, self.settings.batch
        owners = [(packed, row) for packed in data for row in range(len(packed.patches))]
        chosen = [owners[number] for number in shuffled(len(owners), batch, step, seed)]
        clean = torch.zeros(batch, *self._grid(model))
        for grid, (packed, row) in zip(clean, chosen, strict=True):
            grid[packed.where.places[:, 0]] = packed.patches[row]
        codes = torch.stack([packed.where.codes for packed, _ in chosen])
        level = objective.levels(batch, generator)
        together = self.settings.joint and bool(torch.rand((), generator=generator) >= 0.5)
        levels = (level * together, level)
        code_noise, noise = (torch.randn(each.shape, generator=generator) for each in (codes, clean))
        noisy = (objective.noisy(codes, code_noise, levels[0]), objective.noisy(clean, noise, level))
        widths, weights = self.ask(model, *noisy, self._places(model), levels)
        loss = objective.loss(weights, clean, noise, level)
        if widths is None:
            return loss
        return loss + objective.loss(widths, codes, code_noise, levels[0], values=self.form.code_values)

    def sample(self, model: Transformer, architecture: Architecture, count: int, generator: torch.Generator) -> Tensor:
        """Patches of networks of an architecture, cut from whole grids."""
        where = Places.of(architecture, self.form, self.settings)
        codes, places = where.codes.expand(count, -1, -1), self._places(model)

        def denoise(noisy: Tensor, level: Tensor) -> Tensor:
            return self.ask(model, codes, noisy, places, (torch.zeros_like(level), level))[1]

        noise = torch.randn(count, *self._grid(model), generator=generator)
        return self._draw(denoise, noise, generator)[:, where.places[:, 0]]

    def sample_joint(self, model: Transformer, count: int, generator: torch.Generator) -> dict[Architecture, Tensor]:
        """Codes and grids at once; the decoded architecture then says which patches of the grid are kept."""
        shapes, places = ((self.form.layers + 1, self.form.widths), self._grid(model)), self._places(model)
        sizes = [rows * columns for rows, columns in shapes]

        def split(state: Tensor) -> list[Tensor]:
            parts = torch.split(state, sizes, dim=1)
            return [part.reshape(-1, *shape) for part, shape in zip(parts, shapes, strict=True)]

        def denoise(noisy: Tensor, level: Tensor) -> Tensor:
            codes, grids = split(noisy)
            widths, weights = self.ask(model, codes, grids, places, (level, level))
            assert widths is not None
            return torch.cat([widths.flatten(2), weights.flatten(2)], dim=2)

        noise = torch.randn(count, sum(sizes), generator=generator)
        codes, grids = split(self._draw(denoise, noise, generator))
        owners = self.form.decode(codes)
        kept = {each: Places.of(each, self.form, self.settings).places[:, 0] for each in sorted(set(owners))}
        return {
            each: torch.stack([grid[cells] for grid, owner in zip(grids, owners, strict=True) if owner == each])
            for each, cells in kept.items()
        }

    def _grid(self, model: Transformer) -> tuple[int, int]:
        return model.cells, self.settings.patch**2

    def _places(self, model: Transformer) -> Tensor:
        """All cells; their layers' widths play no part here."""
        places = torch.zeros(model.cells, 3, dtype=torch.long)
        places[:, 0] = torch.arange(model.cells)
        return places
