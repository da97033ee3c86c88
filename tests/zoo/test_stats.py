"""The paper's analyses: twin populations beside the paper's numbers. The zoo's own are tested with the command."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from matplotlib.figure import Figure

from nnit_zoo import diversity, places, stats
from nnit_zoo.architecture import Architecture
from nnit_zoo.cli import main
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import Zoo

SMALL = Architecture(6, (16, 16), 3)


def aligned(count: int, architecture: Architecture = SMALL) -> PolicyBatch:
    """Networks whose weights differ in nothing but their signs."""
    draw = torch.Generator().manual_seed(0)
    layers = []
    for shape in architecture.block_shapes:
        signs = torch.randint(2, (count, *shape), generator=draw) * 2 - 1
        layers.append(torch.randn(shape, generator=draw).abs()[None] * signs)
    return PolicyBatch(architecture, tuple(layers))


def test_the_nearest_neighbour_of_three_points_is_known() -> None:
    """Biases 1 and 2 on one line, and the third at right angles to it."""
    points = torch.tensor([(1.0, 0.0), (2.0, 0.0), (0.0, 2.0)])
    layers = tuple(torch.stack([torch.zeros(3), bias], 1)[:, None] for bias in points.T)
    found = stats.alignment(PolicyBatch(Architecture(1, (1,), 1), layers))
    assert found["nearest L2"] == pytest.approx((1 + 1 + 5**0.5) / 3)
    assert found["nearest cosine"] == pytest.approx((1 + 1 + 0) / 3)


def test_a_population_is_measured_by_its_scores_distances_and_layers() -> None:
    scores = pa.table({"return": [30.0, 40.0], "success_at_end": [True, False]})
    batch = aligned(5)
    batch.layers[0][0] = batch.layers[0][0].flip(1)  # one network sees its observation in another order
    found = stats.population(batch, scores, torch.randn(50, 6, generator=torch.Generator().manual_seed(1)))
    assert (found["return"], found["success_at_end"]) == (35.0, 0.5)
    assert found["|W| r, layer 1"] < 0.9 and found["|W| r, layers 2+"] == pytest.approx(1)
    assert abs(found["nearest cosine"]) < 0.2
    assert 0 < found["CKA, mean"] == pytest.approx((found["CKA, layer 1"] + found["CKA, layer 2"]) / 2)


def test_permuting_the_neurons_takes_the_correlation_away(made_once: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo = Zoo.open(made_once)
    small, large = both = zoo.parse("32-16-64-32"), zoo.parse("64-64-64-32")
    monkeypatch.setattr(zoo, "architectures", lambda split: both)
    monkeypatch.setattr(zoo, "batch", lambda architecture, split: aligned(12, architecture))
    monkeypatch.setattr(zoo, "ghn_seeds", lambda architecture, split: tuple(range(12)))
    rows = {row["measure"]: row for row in stats.analyse(zoo, both)}
    distances = rows["nearest L2"]
    assert distances[str(small)] < distances[str(large)]
    assert distances["all seen"] == pytest.approx((distances[str(small)] + distances[str(large)]) / 2)
    assert rows["|W| r, layers 2+"]["all seen"] == pytest.approx(1)
    permuted = rows["|W| r, permuted"]
    assert max(map(abs, (permuted[str(small)], permuted[str(large)], permuted["all seen"]))) < 0.1
    assert permuted["paper"] == 0


def test_figures_show_the_measures(made_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo = Zoo.open(made_once)
    monkeypatch.setattr(zoo, "batch", lambda architecture, split: aligned(12, architecture))
    drawn: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *rest, **how: drawn.append(self) or save(self, *rest, **how))
    chosen = [zoo.parse("32-16-64-32"), zoo.parse("64-64-64-32")]
    assert [path.read_bytes()[:4] for path in stats.draw(zoo, chosen, tmp_path)] == [b"\x89PNG"] * 2
    magnitudes, pairs = drawn

    maps = [axes.images[0].get_array() for axes in magnitudes.axes]
    expected = [profile for each in chosen for profile in diversity.magnitudes(aligned(12, each))]
    for shown, profile in zip(maps, expected, strict=True):
        np.testing.assert_array_equal(shown, profile)
    for axes, measure in zip(pairs.axes, (diversity.distances, diversity.cosines), strict=True):
        for outline, each in zip(axes.patches, chosen, strict=True):
            values = diversity.pairs(measure(aligned(12, each))).numpy()
            edges = outline.get_xy()[:, 0]
            np.testing.assert_allclose([edges.min(), edges.max()], [values.min(), values.max()])
    assert [text.get_text() for text in pairs.axes[1].get_legend().get_texts()] == [str(each) for each in chosen]


def test_twins_are_shown_beside_the_paper_or_the_command_is_named(
    home: Path, made_once: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["nnit-zoo", "stats", "--architecture", "32-16-64-32", "--folder", str(made_once)]
    monkeypatch.setattr(sys, "argv", command)
    main()
    assert "nnit-zoo build --task PickCube-v1 --stage twins" in capsys.readouterr().out
    measures = dict.fromkeys((*stats.PAPER_TWINS["PickCube-v1"], "|W| r, layer 1"), 0.5)
    monkeypatch.setattr(places, "DATA", home)
    (home / "PickCube-v1").mkdir(parents=True)
    (home / "PickCube-v1" / stats.TWINS).write_text(json.dumps({"populations": {"GHN": measures, "SGD": measures}}))
    main()
    shown = capsys.readouterr().out
    assert "54.660" in shown and "41.730" in shown and "--stage twins" not in shown
    monkeypatch.setattr(sys, "argv", [*command, "--json"])
    main()
    rows = {row["measure"]: row for row in json.loads(capsys.readouterr().out)["twins"]}
    assert rows["CKA, layer 3"] == {
        "measure": "CKA, layer 3",
        "GHN": 0.5,
        "SGD": 0.5,
        "paper, GHN": 0.751,
        "paper, SGD": 0.918,
    }
    assert rows["|W| r, layer 1"]["paper, SGD"] is None
