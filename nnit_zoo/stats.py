"""The paper's analyses of a zoo, each measure beside the paper's number, and its figures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from torch import Tensor

from nnit_zoo import diversity, tasks
from nnit_zoo.architecture import Architecture
from nnit_zoo.atomic import write_atomically
from nnit_zoo.errors import UserError
from nnit_zoo.files import Progress
from nnit_zoo.places import data_folder
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.views.permuted import permuted
from nnit_zoo.zoo import TrainingView, Zoo

ARCHITECTURES = ("32-16-64-32", "32-64-16-32", "64-64-16-32")  # the paper does not name its three
ALL = "all seen"
NEAREST_L2, NEAREST_COSINE = "nearest L2", "nearest cosine"
# Layer 1 reads the observation, whose entries no permutation of neurons moves: it is left out of these.
CORRELATION, PERMUTED = "|W| r, layers 2+", "|W| r, permuted"
PAPER = {  # NNiT's tables of data set diversity and CKA, and its permutation ablation
    "PickCube-v1": {
        NEAREST_L2: 46.94,
        NEAREST_COSINE: 0.17,
        CORRELATION: 0.65,
        PERMUTED: 0.0,
        "CKA, layer 1": 0.917,  # of 35 networks 256-256-256
        "CKA, layer 2": 0.880,
        "CKA, layer 3": 0.751,
        "CKA, mean": 0.849,
    },
    "PushCube-v1": {NEAREST_L2: 49.66, NEAREST_COSINE: 0.12},
    "StackCubeEasy-v1": {NEAREST_L2: 72.79, NEAREST_COSINE: 0.21},
}
TWINS = "twins.json"
PAPER_TWINS = {  # NNiT's tables 1 and of CKA, and its permutation ablation: of GHNs, and trained by themselves
    "PickCube-v1": {
        "return": (39.35, 39.49),
        "success_at_end": (0.990, 0.989),
        NEAREST_L2: (54.66, 41.73),
        NEAREST_COSINE: (0.07, 0.02),
        CORRELATION: (0.65, 0.0),
        "CKA, layer 1": (0.917, 0.957),
        "CKA, layer 2": (0.880, 0.926),
        "CKA, layer 3": (0.751, 0.918),
        "CKA, mean": (0.849, 0.933),
    }
}


def examples(zoo: Zoo) -> list[Architecture]:
    """The architectures to look at if none are named; raises UserError if none has two policies."""
    able = [each for each in zoo.architectures("seen") if len(zoo.ghn_seeds(each, "seen")) > 1]
    if not able:
        raise UserError(f"no seen architecture in the zoo of {zoo.task} has two policies to compare")
    return [each for each in able if str(each) in ARCHITECTURES] or able[:3]


def analyse(zoo: Zoo, chosen: Sequence[Architecture], progress: Progress | None = None) -> list[dict[str, Any]]:
    """Rows of a table: `measure`, its value for each chosen architecture and on average over `all seen`, and `paper`.

    CKA only for the chosen ones, and for tasks with probe states. `progress` is called with the number of newly
    finished architectures. Raises UserError for a chosen architecture with fewer than two policies.
    """
    observations = tasks.get(zoo.task).probe_states()
    columns: dict[str, dict[str, float]] = {}
    for architecture in dict.fromkeys([*chosen, *zoo.architectures("seen")]):
        batch = zoo.batch(architecture, "seen")
        if len(batch) > 1 or architecture in chosen:
            shuffled = _correlations(_shuffled(zoo, architecture))
            columns[str(architecture)] = alignment(batch) | {PERMUTED: fmean(shuffled[1:])}
        if progress:
            progress(1)
    averages = {
        measure: fmean(column[measure] for column in columns.values()) for measure in next(iter(columns.values()))
    }
    for architecture in chosen:
        if observations is not None:
            columns[str(architecture)] |= similarity(zoo.batch(architecture, "seen"), observations)
        if progress:
            progress(1)
    names = [str(architecture) for architecture in chosen]
    return [
        {
            "measure": measure,
            **{name: columns[name][measure] for name in names},
            ALL: averages.get(measure),
            "paper": PAPER.get(zoo.task, {}).get(measure),
        }
        for measure in columns[names[0]]
    ]


def _shuffled(zoo: Zoo, architecture: Architecture) -> PolicyBatch:
    batch, seeds = zoo.batch(architecture, "seen"), zoo.ghn_seeds(architecture, "seen")
    view = TrainingView(zoo.task, {architecture: batch}, {architecture: seeds})
    return permuted(view, "policy", seed=0).batches[architecture]


def alignment(batch: PolicyBatch) -> dict[str, float]:
    """Distances to the nearest neighbour and correlations of |W|; raises UserError for fewer than two policies."""
    layers = _correlations(batch)
    return {
        NEAREST_L2: float(diversity.off_diagonal(diversity.distances(batch)).amin(1).mean()),
        NEAREST_COSINE: float(diversity.off_diagonal(diversity.cosines(batch)).amax(1).mean()),
        **{f"|W| r, layer {number}": value for number, value in enumerate(layers, 1)},
        CORRELATION: fmean(layers[1:]),
    }


def _correlations(batch: PolicyBatch) -> list[float]:
    return [diversity.mean_correlation(layer) for layer in diversity.magnitudes(batch)]


def similarity(batch: PolicyBatch, observations: Tensor) -> dict[str, float]:
    """CKA of each hidden layer on standardised observations [b, inputs], mean over pairs, and the layers' mean."""
    layers = diversity.cka(batch, observations).mean(1)
    measures = {f"CKA, layer {number}": float(value) for number, value in enumerate(layers, 1)}
    return measures | {"CKA, mean": float(layers.mean())}


def population(batch: PolicyBatch, scores: pa.Table, observations: Tensor) -> dict[str, float]:
    """All measures of a population of twins, with its mean `scores`, a table in EPISODE_SCHEMA."""
    means = {column: pc.mean(scores[column]).as_py() for column in ("return", "success_at_end")}
    return means | alignment(batch) | similarity(batch, observations)


def twins(task: str) -> list[dict[str, Any]]:
    """Rows of a table: `measure`, its value for twins of each kind, and the paper's; empty if they were not built."""
    path = data_folder(task) / TWINS
    if not path.exists():
        return []
    found = json.loads(path.read_text())["populations"]
    return [
        {
            "measure": measure,
            **{kind: values[measure] for kind, values in found.items()},
            **dict(zip((f"paper, {kind}" for kind in found), paper, strict=True)),
        }
        for measure in next(iter(found.values()))
        for paper in [PAPER_TWINS.get(task, {}).get(measure, (None, None))]
    ]


def require_matplotlib() -> None:
    """Raise UserError if matplotlib, which is an extra, is not installed."""
    if find_spec("matplotlib") is None:
        raise UserError("figures need matplotlib; run: pip install 'nnit[figures]'")


def draw(zoo: Zoo, chosen: Sequence[Architecture], folder: Path) -> Iterator[Path]:
    """Write magnitudes.png (heat maps of |W| over seeds) and pairs.png (histograms over pairs); gives their paths.

    It needs matplotlib: `require_matplotlib` says so.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  an extra

    batches = [zoo.batch(architecture, "seen") for architecture in chosen]
    pictures = (
        ("magnitudes", "mean |W| of each input neuron", (CORRELATION,), _magnitudes),
        ("pairs", "all pairs of an architecture's policies", (NEAREST_L2, NEAREST_COSINE), _pairs),
    )
    here = [alignment(batch) for batch in batches]
    for name, title, measures, picture in pictures:
        figure = Figure(layout="constrained", dpi=150)
        picture(figure, batches)
        lines = (_beside_paper(zoo.task, each, here) for each in measures)
        figure.suptitle("\n".join([f"{zoo.task}: {title}", *lines]), fontsize="medium")
        path = folder / f"{name}.png"
        write_atomically(path, partial(figure.savefig, format="png"))
        yield path


def _beside_paper(task: str, measure: str, here: Sequence[Mapping[str, float]]) -> str:
    """A measure of the architectures shown, and the paper's, in words."""
    values = ", ".join(f"{each[measure]:.2f}" for each in here)
    paper = PAPER.get(task, {}).get(measure)
    return f"{measure}: {values}; NNiT: {'not given' if paper is None else f'{paper:g}'}"


def _magnitudes(figure: Any, batches: Sequence[PolicyBatch]) -> None:
    """A row per architecture, a column per layer: mean |W| of each input neuron (across) for each seed (down)."""
    depth = max(len(batch.layers) for batch in batches)
    figure.set_size_inches(2.2 * depth, 1.9 * len(batches))
    axes = figure.subplots(len(batches), depth, squeeze=False)
    for row, batch in zip(axes, batches, strict=True):
        row[0].set_ylabel(f"{batch.architecture}\n{len(batch)} seeds")
        for number, (axis, profile) in enumerate(zip(row, diversity.magnitudes(batch), strict=False), 1):
            axis.imshow(profile.numpy(), aspect="auto", cmap="magma", interpolation="nearest")
            axis.set_yticks([])
            if batch is batches[0]:
                axis.set_title(f"layer {number}", fontsize="medium")
            if batch is batches[-1]:
                axis.set_xlabel("input neuron")


def _pairs(figure: Any, batches: Sequence[PolicyBatch]) -> None:
    """Histograms of L2 distance and cosine similarity over all pairs of an architecture's policies."""
    figure.set_size_inches(8, 3)
    for axis, measure, label in zip(
        figure.subplots(1, 2),
        (diversity.distances, diversity.cosines),
        ("L2 distance", "cosine similarity"),
        strict=True,
    ):
        for batch in batches:
            values = diversity.pairs(measure(batch))
            axis.hist(values.numpy(), bins="auto", density=True, histtype="step", label=str(batch.architecture))
        axis.set_xlabel(label)
        axis.set_yticks([])
        axis.spines[["top", "right", "left"]].set_visible(False)
    figure.axes[0].set_ylabel("share of pairs")
    figure.axes[1].legend(frameon=False)
