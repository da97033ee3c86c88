"""A tiny zoo from untrained GHNs: two training seeds and a held-out one, four architectures, one policy dropped."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from nnit_zoo import files, ghn_file, places
from nnit_zoo.ghn import GHN
from nnit_zoo.materialise import materialise, write_manifest
from stand_in_hub import Hub, serving

SHIPPED = places.DATA
SEEDS = (0, 1, 128)
ARCHITECTURES = {"32-16-64-32": "seen", "64-64-64-32": "seen", "16-16-16-32": "unseen", "32-16-16-16": "excluded"}
DROPPED = ("64-64-64-32", 1)


def make_data_folder(folder: Path, task: str = "PickCube-v1", inputs: int = 42, outputs: int = 8) -> Path:
    """A task's data folder; MNIST-PCA32 has an accuracy in `return` and no notion of success."""
    folder.mkdir(parents=True)
    shutil.copy(SHIPPED / task / "task.json", folder)
    states = {seed: GHN(inputs, outputs, seed).state_dict() for seed in SEEDS}
    ghn_file.write(folder / files.GHNS, ghn_file.GHNs(task, inputs, outputs, states))
    robot = task != "MNIST-PCA32"
    rows = [
        {
            "architecture": architecture,
            "ghn_seed": seed,
            "split": split,
            "success_once": 1.0 if robot else None,
            "success_at_end": 0.75 + seed / 512 if robot else None,
            "return": 38.0 if robot else 0.96,
            "episodes": 64 if seed < files.HELDOUT_SEEDS_FROM else 16,
            "passed": (architecture, seed) != DROPPED,
            "kept": (architecture, seed) != DROPPED,
        }
        for seed in SEEDS
        for architecture, split in ARCHITECTURES.items()
    ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "selection.parquet")
    write_manifest(folder, None)
    return folder


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_data_folder(tmp_path_factory.mktemp("data") / "PickCube-v1")


@pytest.fixture(scope="session")
def made_once(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny zoo, for tests that only read it."""
    folder = tmp_path_factory.mktemp("made") / "zoo"
    materialise(data_folder, folder)
    return folder


@pytest.fixture
def zoo_folder(data_folder: Path, tmp_path: Path) -> Path:
    materialise(data_folder, tmp_path / "zoo")
    return tmp_path / "zoo"


@pytest.fixture
def home(data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, and the tiny zoo as the only one that ships."""
    monkeypatch.setattr(places, "DATA", data_folder.parent)
    monkeypatch.setattr(places, "CACHE", tmp_path / "home" / "nnit" / "zoo")
    return tmp_path / "home"


@pytest.fixture
def hub(made_once: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """The stand-in, with the tiny zoo in the data set `someone/zoo`."""
    server = Hub()
    server.files["someone/zoo"] = {f"PickCube-v1/{path.name}": path.read_bytes() for path in made_once.iterdir()}
    with serving(server, monkeypatch):
        yield server
