"""The network of NNiT: architecture tokens and weight patches in one transformer sequence (NNiT 5.1, 5.2).

Shapes: n policies of one architecture, S widths, L patches, p x p entries in a patch, d the transformer's width.
Only patches that hold parameters are tokens, and a batch has one architecture, so that no attention mask is needed.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, scaled_dot_product_attention, silu

FREQUENCIES = 64


class Transformer(nn.Module):
    """Estimates clean patches from noisy ones, given the noise level and the widths of the architecture.

    `widths` is the number of distinct widths, `layers` of weight layers, `side` of weight patches along the canvas.
    """

    def __init__(self, patch: int, width: int, depth: int, heads: int, *, widths: int, layers: int, side: int) -> None:
        super().__init__()
        self.patch_in = nn.Linear(patch**2, width)
        self.grid = (layers, side, side + 1)  # the last column of patches is the bias
        self.position = nn.Embedding(math.prod(self.grid), width)
        self.width_in = nn.Embedding(widths, width)
        self.width_out = nn.Embedding(widths, width)
        self.widths = nn.Embedding(widths, width)
        self.order = nn.Embedding(layers + 1, width)
        self.level = nn.Sequential(nn.Linear(2 * FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        # Not in the paper, which modulates by the noise level alone: a patch is also modulated by the two widths that
        # its layer joins. They decide how the GHN scales it; halves the distance to the zoo after equal training.
        self.pairs = widths**2 + 1  # the last one stands for "no layer": architecture tokens
        self.blocks = nn.ModuleList(Block(width, heads, self.pairs) for _ in range(depth))
        self.modulation = Modulation(width, self.pairs, parts=2)
        # Not in the paper, which has one linear layer for all patches: each place on the grid has a layer of its own.
        # Networks of a GHN zoo are aligned, so what a place holds is learned apart from what the others hold, at no
        # cost in operations; after equal training the distance to the zoo is less than half (docs/deviations.md).
        self.patch_out = nn.Parameter(torch.empty(math.prod(self.grid), width, patch**2))
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
        # adaLN-Zero: every block starts as the identity, and the estimate as zero, near the mean of the weights (DiT).
        nn.init.zeros_(self.patch_out)
        for module in self.modules():
            if isinstance(module, Modulation):
                nn.init.zeros_(module.by_level.weight)
                nn.init.zeros_(module.by_widths.weight)

    def forward(self, patches: Tensor, level: Tensor, positions: Tensor, widths: Tensor) -> Tensor:
        """Clean patches [n, L, p p] from noisy `patches` [n, L, p p] at noise `level` [n].

        `positions` [L, 3] = (layer, patch row, patch column); `widths` [S] = indices of the architecture's widths.
        """
        layer, row, column = positions.unbind(1)
        _, rows, columns = self.grid
        place = (layer * rows + row) * columns + column  # [L]
        into, out = widths[layer], widths[layer + 1]
        where = self.position(place) + self.width_in(into) + self.width_out(out)  # [L, d]
        pair = into * len(self.widths.weight) + out  # [L]
        pairs = torch.cat([pair.new_full(widths.shape, self.pairs - 1), pair])  # [S + L]
        # The noisy patches have variance (1 - t)^2 + t^2; scaled to one, the first layer sees the same size at all t.
        scale = ((1 - level) ** 2 + level**2).rsqrt()[:, None, None]
        weights = self.patch_in(patches * scale) + where  # [n, L, d]
        architecture = self.widths(widths) + self.order.weight[: len(widths)]  # [S, d]
        tokens = torch.cat([architecture.expand(len(patches), -1, -1), weights], dim=1)  # [n, S + L, d]
        condition = self.level(wave(level))  # [n, d]
        for block in self.blocks:
            tokens = block(tokens, condition, pairs)
        shift, scale = self.modulation(condition, pair)  # [n, L, d] each
        weights = normalised(tokens[:, len(widths) :]) * (1 + scale) + shift
        return torch.einsum("nld,ldp->nlp", weights, self.patch_out[place])


class Modulation(nn.Module):
    """What adaLN multiplies and adds: `parts` vectors for each token, from the noise level and the layer's widths."""

    def __init__(self, width: int, pairs: int, parts: int) -> None:
        super().__init__()
        self.parts = parts
        self.by_level = nn.Linear(width, parts * width)
        self.by_widths = nn.Embedding(pairs, parts * width)

    def forward(self, condition: Tensor, pairs: Tensor) -> tuple[Tensor, ...]:
        """Vectors [n, T, d] for T tokens of `pairs` [T] at the noise level embedded in `condition` [n, d]."""
        both: Tensor = self.by_level(condition)[:, None] + self.by_widths(pairs)
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

    def forward(self, tokens: Tensor, condition: Tensor, pairs: Tensor) -> Tensor:
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
    rates = 20 * torch.exp(-math.log(1000) * torch.arange(FREQUENCIES) / FREQUENCIES)
    angles = level[:, None] * rates
    return torch.cat([angles.cos(), angles.sin()], dim=1)
