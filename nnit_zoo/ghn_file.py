"""ghns.safetensors: the GHNs that made a task's zoo, in float16, each parameter stacked over their seeds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError

State = Mapping[str, Tensor]


@dataclass(frozen=True)
class GHNs:
    """The parameters of each seed's GHN, for a task with so many inputs and outputs."""

    task: str
    inputs: int
    outputs: int
    states: Mapping[int, State]


def write(path: Path, ghns: GHNs) -> None:
    """Write the file, atomically; the same bytes for the same GHNs."""
    first = next(iter(ghns.states.values()))
    stacked = {name: torch.stack([state[name].half() for state in ghns.states.values()]) for name in first}
    sizes = {"inputs": ghns.inputs, "outputs": ghns.outputs}
    # One entry, because safetensors writes several in an order that changes from run to run.
    note = {"nnit": json.dumps({"task": ghns.task, **sizes, "ghn_seeds": list(ghns.states)})}
    write_bytes(path, save(stacked, note))


def read(path: Path) -> GHNs:
    """The file's GHNs, in float16; raises UserError if it is missing or damaged."""
    try:
        with safe_open(path, framework="pt") as file:
            note = json.loads(file.metadata()["nnit"])
            stacked = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path} is missing or damaged ({error}); install nnit again") from None
    states = {
        seed: {name: tensor[number] for name, tensor in stacked.items()}
        for number, seed in enumerate(note["ghn_seeds"])
    }
    return GHNs(note["task"], note["inputs"], note["outputs"], states)
