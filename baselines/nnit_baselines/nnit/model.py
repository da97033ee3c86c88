"""The network of NNiT: architecture tokens and weight patches in one transformer sequence (NNiT 5.1, 5.2).

Shapes: n policies, S widths of an architecture and V in the vocabulary, L patches, p x p entries in a patch, d the
transformer's width, C channels: what the objective wants for each entry.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, scaled_dot_product_attention, silu

from nnit_baselines.nnit.config import NNiTConfig

FREQUENCIES = 64


class Transformer(nn.Module):
    """Says of noisy widths and patches what the objective wants to know, given the noise level of each of the two.

    `channels` is C, `widths` V, `layers` the number of weight layers.
    """

    def __init__(self, settings: NNiTConfig, *, channels: int, widths: int, layers: int) -> None:
        super().__init__()
        width, entries, side = settings.width, settings.patch**2, settings.canvas // settings.patch
        self.channels = channels
        self.cells = layers * side * (side + 1)  # places on the grid; the last column of each layer is the bias
        self.patch_in = nn.Linear(entries, width)
        self.position = nn.Embedding(self.cells, width)
        self.widths = nn.Embedding(widths, width)
        self.order = nn.Embedding(layers + 1, width)
        # One embedding for each of the noise levels; together they are as wide as a token.
        self.level = level_embedding(width // 2 if settings.joint else width)
        self.architecture_level = level_embedding(width // 2) if settings.joint else None
        # Not in the paper, which modulates by the noise levels alone: a patch also knows, and is modulated by, the two
        # widths that its layer joins. They decide how the GHN scales it (what it gains: docs/nnit.md).
        # The last pair stands for "no layer": architecture tokens.
        self.pairs = widths**2 + 1 if settings.width_conditioning else 0
        self.width_in = nn.Embedding(widths, width) if self.pairs else None
        self.width_out = nn.Embedding(widths, width) if self.pairs else None
        self.blocks = nn.ModuleList(Block(width, settings.heads, self.pairs) for _ in range(settings.depth))
        self.modulation = Modulation(width, self.pairs, parts=2)
        # Not in the paper, which has one linear layer for all patches: each place on the grid has a layer of its own.
        # Networks of a GHN zoo are aligned, so what a place holds is learned apart from what the others hold, at no
        # cost in operations (what it gains: docs/nnit.md).
        outputs = self.cells if settings.place_outputs else 1
        self.patch_out = nn.Parameter(torch.empty(outputs, width, channels * entries))
        self.widths_out = nn.Linear(width, channels * widths) if settings.joint else None
        self.initialise()

    def initialise(self) -> None:
        """Set every parameter once, in one place."""
        for module in self.modules():
            if isinstance(module, nn.Linear):  # variance kept from input to output
                nn.init.normal_(module.weight, std=module.in_features**-0.5)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
            elif isinstance(module, nn.Embedding):  # a sum of three is half as large as an embedded patch
                nn.init.normal_(module.weight, std=0.3)
        # adaLN-Zero: every block starts as the identity, and the output as zero (DiT).
        nn.init.zeros_(self.patch_out)
        if self.widths_out is not None:
            nn.init.zeros_(self.widths_out.weight)
        for module in self.modules():
            if isinstance(module, Modulation):
                nn.init.zeros_(module.by_level.weight)
                if module.by_widths is not None:
                    nn.init.zeros_(module.by_widths.weight)

    def forward(self, codes: Tensor, patches: Tensor, places: Tensor, levels: Tensor) -> tuple[Tensor | None, Tensor]:
        """The outputs for noisy codes [n, S, V] and patches [n, L, p p]: [n, C, S, V] (or None) and [n, C, L, p p].

        `places` [L, 3] = (cell of the grid, index of the width into the patch's layer, index of the width out of it);
        `levels` [n, 2] = noise levels of architecture and weights.
        """
        cell, into, out = places.unbind(1)
        where = self.position(cell)  # [L, d]
        pairs = None
        if self.width_in is not None and self.width_out is not None:
            where = where + self.width_in(into) + self.width_out(out)
            pair = into * len(self.widths.weight) + out
            pairs = torch.cat([pair.new_full((codes.shape[1],), self.pairs - 1), pair])  # [S + L]
        # A clean code has one entry, the root of V: divided by it, it picks its row of the embedding table.
        architecture = codes / len(self.widths.weight) ** 0.5 @ self.widths.weight + self.order.weight[: codes.shape[1]]
        tokens = torch.cat([architecture, self.patch_in(patches) + where], dim=1)  # [n, S + L, d]
        condition = self.level(wave(levels[:, 1]))
        if self.architecture_level is not None:
            condition = torch.cat([self.architecture_level(wave(levels[:, 0])), condition], dim=1)
        for block in self.blocks:
            tokens = block(tokens, condition, pairs)
        shift, scale = self.modulation(condition, pairs)  # [n, S + L, d] each
        tokens = normalised(tokens) * (1 + scale) + shift
        architecture, weights = torch.split(tokens, [codes.shape[1], len(places)], dim=1)
        if not len(cell):  # spares patch_out a gradient full of zeros
            output = weights.new_zeros(len(weights), 0, self.patch_out.shape[2])
        elif len(self.patch_out) == 1:
            output = weights @ self.patch_out[0]
        else:
            output = torch.einsum("nld,ldp->nlp", weights, self.patch_out.index_select(0, cell))
        widths = None if self.widths_out is None else self._channels(self.widths_out(architecture))
        return widths, self._channels(output)

    def _channels(self, output: Tensor) -> Tensor:
        """[n, T, C e] as [n, C, T, e]."""
        n, length, entries = output.shape
        return output.view(n, length, self.channels, entries // self.channels).transpose(1, 2)


def level_embedding(width: int) -> nn.Sequential:
    """Takes the wave of a noise level, [n, 2 FREQUENCIES], to a vector [n, d]."""
    return nn.Sequential(nn.Linear(2 * FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())


class Modulation(nn.Module):
    """What adaLN multiplies and adds: `parts` vectors for each token, from the noise levels and the layer's widths.

    `pairs` is the number of pairs of widths; with 0, they play no part.
    """

    def __init__(self, width: int, pairs: int, parts: int) -> None:
        super().__init__()
        self.parts = parts
        self.by_level = nn.Linear(width, parts * width)
        self.by_widths = nn.Embedding(pairs, parts * width) if pairs else None

    def forward(self, condition: Tensor, pairs: Tensor | None) -> tuple[Tensor, ...]:
        """Vectors [n, T, d], or [n, 1, d] for all tokens, at the levels embedded in `condition` [n, d]; `pairs` [T]."""
        both: Tensor = self.by_level(condition)[:, None]
        if self.by_widths is not None:
            both = both + self.by_widths(pairs)
        return both.chunk(self.parts, dim=-1)


class Block(nn.Module):
    """Self-attention, then a SwiGLU layer, each scaled, shifted and gated by its modulation (adaLN-Zero)."""

    def __init__(self, width: int, heads: int, pairs: int) -> None:
        super().__init__()
        hidden = width * 8 // 3 // 32 * 32  # SwiGLU has three matrices: 8/3 gives it the size of a 4 d layer
        self.heads = heads
        self.modulation = Modulation(width, pairs, parts=6)
        self.query_key_value = nn.Linear(width, 3 * width, bias=False)
        self.attention_out = nn.Linear(width, width, bias=False)
        self.gate_and_value = nn.Linear(width, 2 * hidden, bias=False)
        self.hidden_out = nn.Linear(hidden, width, bias=False)

    def forward(self, tokens: Tensor, condition: Tensor, pairs: Tensor | None) -> Tensor:
        """Tokens [n, T, d] after this block; `condition` [n, d] and `pairs` [T] as for Modulation."""
        shift, scale, gate, shift_hidden, scale_hidden, gate_hidden = self.modulation(condition, pairs)
        tokens = tokens + gate * self.attend(normalised(tokens) * (1 + scale) + shift)
        hidden = self.gate_and_value(normalised(tokens) * (1 + scale_hidden) + shift_hidden)
        switch, value = hidden.chunk(2, dim=-1)
        change: Tensor = gate_hidden * self.hidden_out(silu(switch) * value)
        return tokens + change

    def attend(self, tokens: Tensor) -> Tensor:
        """Multi-head self-attention over all T tokens: [n, T, d] -> [n, T, d]."""
        n, length, width = tokens.shape
        split = self.query_key_value(tokens).view(n, length, 3, self.heads, width // self.heads)
        query, key, value = split.permute(2, 0, 3, 1, 4)  # [n, heads, T, d / heads] each
        mixed = scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(n, length, width)
        attended: Tensor = self.attention_out(mixed)
        return attended


def normalised(tokens: Tensor) -> Tensor:
    """Layer norm without parameters: adaLN gives scale and shift."""
    return layer_norm(tokens, tokens.shape[-1:])


def wave(level: Tensor) -> Tensor:
    """Cosines and sines of noise levels, [n] -> [n, 2 FREQUENCIES], at wavelengths from about 0.3 to 300."""
    rates = 20 * torch.exp(-math.log(1000) * torch.arange(FREQUENCIES, device=level.device) / FREQUENCIES)
    angles = level[:, None] * rates
    return torch.cat([angles.cos(), angles.sin()], dim=1)
