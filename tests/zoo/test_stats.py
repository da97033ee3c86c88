"""The paper's analyses: twin populations beside the paper's numbers. The zoo's own are tested with the command."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pyarrow as pa
import pytest
import torch

from nnit_zoo import files, stats
from nnit_zoo.architecture import Architecture
from nnit_zoo.cli import main
from nnit_zoo.policy import PolicyBatch


def aligned(count: int) -> PolicyBatch:
    """Networks whose weights differ in nothing but their signs."""
    architecture, draw = Architecture(6, (16, 16), 3), torch.Generator().manual_seed(0)
    layers = []
    for shape in architecture.block_shapes:
        signs = torch.randint(2, (count, *shape), generator=draw) * 2 - 1
        layers.append(torch.randn(shape, generator=draw).abs()[None] * signs)
    return PolicyBatch(architecture, tuple(layers))


def test_a_population_is_measured_by_its_scores_distances_and_layers() -> None:
    scores = pa.table({"return": [30.0, 40.0], "success_at_end": [True, False]})
    found = stats.population(aligned(5), scores, torch.randn(50, 6, generator=torch.Generator().manual_seed(1)))
    assert (found["return"], found["success_at_end"]) == (35.0, 0.5)
    assert found["|W| r, layer 1"] == pytest.approx(1) and found["|W| r, layers 2+"] == pytest.approx(1)
    assert abs(found["nearest cosine"]) < 0.2
    assert 0 < found["CKA, mean"] == pytest.approx((found["CKA, layer 1"] + found["CKA, layer 2"]) / 2)


def test_twins_are_shown_beside_the_paper_or_the_command_is_named(
    home: Path, made_once: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["nnit-zoo", "stats", "--architecture", "32-16-64-32", "--folder", str(made_once)]
    monkeypatch.setattr(sys, "argv", command)
    main()
    assert "nnit-zoo build --task PickCube-v1 --stage twins" in capsys.readouterr().out
    measures = dict.fromkeys((*stats.PAPER_TWINS["PickCube-v1"], "|W| r, layer 1"), 0.5)
    monkeypatch.setattr(files, "EMBEDDED", home)
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
