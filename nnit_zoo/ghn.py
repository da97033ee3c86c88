"""The graph hypernetwork: a chain of layer nodes in, one network's blocks out, through a decoder of up-convolutions.

NNiT 4: "the CNN decoder introduces an explicit locality bias". The decoder convolves over neuron indices, as the paper
says; the code it cites does not (docs/deviations.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from nnit_zoo.architecture import Architecture, vocabulary
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch

_START_SIZE = 8  # rows and columns of the first feature map; each block of the decoder doubles them
_WIDTH = 32  # of a node's embedding, and channels of the first feature map
_START_STD = 0.6  # of the raw canvas at the start; with it every seed trained


class GHN(nn.Module):
    """Emits the policy of any architecture with these hidden `widths` and `layers`; its seed draws the initial weights.

    Without `widths`, they are the vocabulary. The decoder's `canvas` is as wide as the widest, and its number of blocks
    follows from that. Raises UserError for tasks with more inputs or outputs than the canvas.
    """

    def __init__(
        self, inputs: int, outputs: int, seed: int, widths: Sequence[int] | None = None, layers: int = 5
    ) -> None:
        super().__init__()
        widths = widths or vocabulary()
        blocks = math.ceil(math.log2(max(widths) / _START_SIZE))
        self.canvas = _START_SIZE * 2**blocks
        if max(inputs, outputs) > self.canvas:
            raise UserError(f"GHNs emit layers up to {self.canvas} wide, not {inputs} inputs to {outputs} outputs")
        self.inputs, self.outputs = inputs, outputs
        self._tokens = {("in", inputs): 0, ("out", outputs): 1}
        self._tokens |= {("hidden", width): 2 + index for index, width in enumerate(widths)}
        channels = [_WIDTH, *(max(32 // 2**block, 8) for block in range(blocks - 1)), 1]
        self._ups = [f"up{number}" for number in range(1, blocks + 1)]
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.embed_in = nn.Embedding(len(self._tokens), _WIDTH)
            self.embed_out = nn.Embedding(len(self._tokens), _WIDTH)
            self.embed_layer = nn.Embedding(layers, _WIDTH)
            self.chain = nn.GRU(_WIDTH, _WIDTH // 2, batch_first=True, bidirectional=True)
            self.norm = nn.LayerNorm(_WIDTH)
            self.lift = nn.Linear(_WIDTH, _WIDTH * _START_SIZE**2)
            for name, (into, out) in zip(self._ups, pairwise(channels), strict=True):
                self.add_module(name, nn.ConvTranspose2d(into, out, 4, 2, 1))
            self.up_bias = nn.ConvTranspose1d(channels[-2], 1, 4, 2, 1)
            self._scale_canvas(max(widths))

    @classmethod
    def from_state(cls, inputs: int, outputs: int, state: Mapping[str, Tensor]) -> GHN:
        """The GHN with these parameters, in float32."""
        ghn = cls(inputs, outputs, seed=0)
        ghn.load_state_dict({name: tensor.float() for name, tensor in state.items()})
        return ghn

    @torch.no_grad()
    def _scale_canvas(self, width: int) -> None:
        """Scale the last kernel so that raw canvases start with standard deviation 0.6."""
        hidden = (width,) * (self.embed_layer.num_embeddings - 1)
        nodes = self.embed([Architecture(self.inputs, hidden, self.outputs)])
        weights, _ = self.decode(nodes.flatten(0, 1))
        self.get_parameter(f"{self._ups[-1]}.weight").mul_(_START_STD / weights.std())

    def embed(self, architectures: Sequence[Architecture]) -> Tensor:
        """Node embeddings [a, layers, 32] of `a` architectures of equal depth: one node per layer, on a chain."""
        into = torch.tensor([self._chain(architecture)[:-1] for architecture in architectures])
        out = torch.tensor([self._chain(architecture)[1:] for architecture in architectures])
        nodes = self.embed_in(into) + self.embed_out(out) + self.embed_layer.weight[: into.shape[1]]
        messages, _ = self.chain(nodes)
        return torch.as_tensor(self.norm(nodes + messages))

    def _chain(self, architecture: Architecture) -> list[int]:
        hidden = [("hidden", width) for width in architecture.hidden]
        names = [("in", architecture.inputs), *hidden, ("out", architecture.outputs)]
        unknown = [f"{kind} width {width}" for kind, width in names if (kind, width) not in self._tokens]
        if unknown or len(names) != self.embed_layer.num_embeddings + 1:
            raise UserError(f"this GHN has no embedding for {', '.join(unknown) or f'{len(names) - 2} hidden layers'}")
        return [self._tokens[name] for name in names]

    def decode(self, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """Raw canvases [n, canvas, canvas] (rows = output neurons), biases [n, canvas] of node embeddings [n, 32]."""
        field = F.silu(self.lift(nodes)).view(-1, _WIDTH, _START_SIZE, _START_SIZE)
        *middle, last = (self.get_submodule(name) for name in self._ups)
        for up in middle:
            field = F.silu(up(field))
        biases = self.up_bias(field.mean(dim=3))
        return last(field)[:, 0], biases[:, 0]

    def forward(self, architectures: Sequence[Architecture]) -> list[list[Tensor]]:
        """Blocks [out, in + 1] of each architecture's layers: the canvas's corner over sqrt(fan-in), and the bias."""
        nodes = self.embed(architectures)
        weights, biases = self.decode(nodes.flatten(0, 1))
        weights = weights.view(*nodes.shape[:2], self.canvas, self.canvas)
        biases = biases.view(*nodes.shape[:2], self.canvas)
        networks = []
        for index, architecture in enumerate(architectures):
            blocks = []
            for layer, (rows, columns) in enumerate(architecture.block_shapes):
                weight = weights[index, layer, :rows, : columns - 1] / (columns - 1) ** 0.5
                blocks.append(torch.cat([weight, biases[index, layer, :rows, None]], dim=1))
            networks.append(blocks)
        return networks

    @torch.no_grad()
    def emit(self, architecture: Architecture) -> PolicyBatch:
        """This GHN's one policy of the architecture, in the GHN's own floating-point type."""
        (blocks,) = self([architecture])
        return PolicyBatch(architecture, tuple(block[None] for block in blocks))
