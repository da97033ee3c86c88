"""A tiny zoo from untrained GHNs: two training seeds and a held-out one, three architectures, one policy dropped."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import save_file

from nnit_zoo import files
from nnit_zoo.build.ghn import GHN
from nnit_zoo.materialise import materialise, write_manifest

SEEDS = (0, 1, 128)
ARCHITECTURES = {"32-16-64-32": "seen", "64-64-64-32": "seen", "16-16-16-32": "unseen", "32-16-16-16": "excluded"}
DROPPED = ("64-64-64-32", 1)


def make_data_folder(folder: Path, task: str = "PickCube-v1") -> Path:
    folder.mkdir(parents=True)
    states = [GHN(42, 8, seed).state_dict() for seed in SEEDS]
    stacked = {name: torch.stack([state[name] for state in states]).half() for name in states[0]}
    metadata = {"task": task, "inputs": 42, "outputs": 8, "ghn_seeds": SEEDS}
    save_file(stacked, folder / "ghns.safetensors", {"nnit": json.dumps(metadata)})
    rows = [
        {
            "architecture": architecture,
            "ghn_seed": seed,
            "split": split,
            "success_once": 1.0,
            "success_at_end": 0.75 + seed / 512,
            "return": 38.0,
            "episodes": 64,
            "kept": (architecture, seed) != DROPPED,
        }
        for seed in SEEDS
        for architecture, split in ARCHITECTURES.items()
    ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "selection.parquet")
    write_manifest(folder)
    return folder


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_data_folder(tmp_path_factory.mktemp("embedded") / "PickCube-v1")


@pytest.fixture
def zoo_folder(data_folder: Path, tmp_path: Path) -> Path:
    materialise(data_folder, tmp_path / "zoo")
    return tmp_path / "zoo"


@pytest.fixture
def home(data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, and the tiny zoo as the only embedded one."""
    monkeypatch.setattr(files, "EMBEDDED", data_folder.parent)
    monkeypatch.setattr(files, "cached_assets_path", (tmp_path / "home").joinpath)
    return tmp_path / "home"
