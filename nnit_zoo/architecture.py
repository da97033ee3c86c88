"""What a network's shape is, and the committed lists of which shapes are seen, unseen and excluded."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal, get_args

from nnit_zoo.errors import UserError, unknown_name

Split = Literal["seen", "unseen", "excluded"]
SPLITS: tuple[Split, ...] = get_args(Split)


@dataclass(frozen=True, order=True)
class Architecture:
    """An MLP's widths: `inputs`, the `hidden` widths in order, and `outputs` (NNiT 5.1.1)."""

    inputs: int
    hidden: tuple[int, ...]
    outputs: int

    def __post_init__(self) -> None:
        if not self.hidden or min(self.inputs, self.outputs, *self.hidden) < 1:
            raise UserError(f"an architecture needs positive widths and a hidden layer, not {self.widths}")

    @classmethod
    def parse(cls, text: str, inputs: int, outputs: int) -> Architecture:
        """The architecture with the hidden widths that `text` lists, such as `32-16-64-32`.

        Raises UserError if `text` is not whole numbers joined by dashes.
        """
        try:
            hidden = tuple(int(width) for width in text.split("-"))
        except ValueError:
            raise UserError(
                f"'{text}' is not an architecture; write hidden widths joined by dashes, such as 32-16-64-32"
            ) from None
        return cls(inputs, hidden, outputs)

    def __str__(self) -> str:
        return "-".join(map(str, self.hidden))

    @property
    def widths(self) -> tuple[int, ...]:
        """All widths from inputs to outputs; their count is the paper's S."""
        return (self.inputs, *self.hidden, self.outputs)

    @property
    def block_shapes(self) -> tuple[tuple[int, int], ...]:
        """(out, in + 1) of each layer's block of weights and bias (NNiT 5.1.2, rows = outputs)."""
        return tuple((out, into + 1) for into, out in zip(self.widths, self.widths[1:], strict=False))

    @property
    def parameters(self) -> int:
        """Number of weights and biases."""
        return sum(rows * columns for rows, columns in self.block_shapes)


@cache
def _lists() -> dict[str, list[str]]:
    text = resources.files("nnit_zoo").joinpath("data/architectures.json").read_text()
    return dict(json.loads(text))


def vocabulary() -> tuple[int, ...]:
    """The hidden widths that zoo networks use (NNiT 6.2)."""
    return tuple(int(width) for width in _lists()["vocabulary"])


def hidden_widths(split: str) -> tuple[str, ...]:
    """The hidden widths, as text, of the 64 `seen`, 8 `unseen` or 9 `excluded` architectures.

    The four unseen ones that the paper does not name are ours, and `excluded` is h3 = h4 = 16 (docs/deviations.md).
    Raises UserError for another split.
    """
    if split not in SPLITS:
        raise unknown_name("split", split, SPLITS)
    return tuple(_lists()[split])


def architectures(split: str, inputs: int, outputs: int) -> tuple[Architecture, ...]:
    """The architectures of a split for a task with these input and output sizes."""
    return tuple(Architecture.parse(text, inputs, outputs) for text in hidden_widths(split))


def split_of(architecture: Architecture | str) -> str:
    """The split that lists this architecture's hidden widths; `other` if none does."""
    text = str(architecture)
    return next((split for split in SPLITS if text in _lists()[split]), "other")


def check_known(texts: Iterable[str]) -> None:
    """Raise UserError, naming near ones, unless each text is one of the 81 listed architectures."""
    known = [text for split in SPLITS for text in hidden_widths(split)]
    for text in texts:
        if text not in known:
            raise unknown_name("architecture", text, known)
