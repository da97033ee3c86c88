from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import mlcroissant
import numpy as np
import onnx
import onnx.reference
import pyarrow.compute as pc
import pytest
import torch
from datasets import load_dataset
from safetensors import safe_open
from safetensors.torch import load_file

from nnit_zoo import card, places, tasks
from nnit_zoo.errors import UserError
from nnit_zoo.export import export
from nnit_zoo.materialise import materialise
from nnit_zoo.zoo import Zoo

from .conftest import make_data_folder

ID = "PickCube-v1/32-16-64-32/001"


@pytest.fixture(scope="session")
def dataset(made_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two tasks, of which the second has no notion of success."""
    folder = tmp_path_factory.mktemp("dataset")
    materialise(make_data_folder(folder / "embedded", "MNIST-PCA32", 32, 10), folder / "zoo")
    card.write_dataset(folder / "set", [Zoo.open(made_once), Zoo.open(folder / "zoo")], str(folder / "set"))
    return folder / "set"


@pytest.fixture
def raw() -> torch.Tensor:
    """Raw observations such as the task gives."""
    task = tasks.get("PickCube-v1")
    draws = np.random.default_rng(0).normal(size=(7, 42))
    return torch.from_numpy((task.observation_mean + task.observation_std * draws).astype(np.float32))


def test_a_data_set_holds_every_candidates_scores(
    data_folder: Path, made_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card.write_dataset(tmp_path / "another", [Zoo.open(made_once)])
    assert not (tmp_path / "another" / "PickCube-v1" / "build").exists()
    record = json.loads((tmp_path / "another" / "PickCube-v1" / "task.json").read_text())
    assert "observation_mean" in record and "build" not in record  # which says how the zoo that ships was built
    monkeypatch.setattr(places, "DATA", data_folder.parent)
    card.write_dataset(tmp_path / "ours", [Zoo.open(made_once)])
    for name in ("ghns.safetensors", "selection.parquet"):
        copy = tmp_path / "ours" / "PickCube-v1" / "build" / name
        assert copy.read_bytes() == (data_folder / name).read_bytes()


def test_a_policy_is_the_state_of_a_plain_module(made_once: Path, tmp_path: Path, raw: torch.Tensor) -> None:
    zoo = Zoo.open(made_once)
    export(zoo, ID, tmp_path / "policy.safetensors")
    sizes = (42, 32, 16, 64, 32, 8)
    layers = ([torch.nn.Linear(*pair), torch.nn.Tanh()] for pair in itertools.pairwise(sizes))
    module = torch.nn.Sequential(*itertools.chain(*layers))[:-1]
    module.load_state_dict(load_file(tmp_path / "policy.safetensors"))
    assert torch.equal(module(raw), zoo[ID].to_module()(raw))
    with safe_open(tmp_path / "policy.safetensors", "pt") as file:
        assert json.loads(file.metadata()["nnit"])["id"] == ID


def test_a_policy_as_a_program_of_torch(made_once: Path, tmp_path: Path, raw: torch.Tensor) -> None:
    export(Zoo.open(made_once), ID, tmp_path / "policy.pt2")
    module = torch.export.load(tmp_path / "policy.pt2").module()
    expected = Zoo.open(made_once)[ID].to_module()
    for rows in (raw, raw[:1]):
        torch.testing.assert_close(module(rows), expected(rows))


def test_a_policy_as_onnx(made_once: Path, tmp_path: Path, raw: torch.Tensor) -> None:
    export(Zoo.open(made_once), ID, tmp_path / "policy.onnx")
    model = onnx.load(tmp_path / "policy.onnx")
    (found,) = onnx.reference.ReferenceEvaluator(model).run(None, {"observation": raw.numpy()})
    expected = Zoo.open(made_once)[ID].to_module()(raw)
    np.testing.assert_allclose(found, expected.detach().numpy(), rtol=1e-4, atol=1e-5)
    assert json.loads(model.metadata_props[0].value)["id"] == ID
    assert (model.ir_version, model.opset_import[0].version) == (8, 17)  # onnxruntime 1.12 reads both


def test_an_architecture_is_stacked_as_stored(made_once: Path, tmp_path: Path) -> None:
    zoo = Zoo.open(made_once)
    export(zoo, "PickCube-v1/32-16-64-32", tmp_path / "stack.safetensors")
    tensors = load_file(tmp_path / "stack.safetensors")
    for depth, layer in enumerate(zoo.batch("32-16-64-32").layers):
        assert torch.equal(tensors[f"layers.{depth}"], layer)
    with safe_open(tmp_path / "stack.safetensors", "pt") as file:
        ids = json.loads(file.metadata()["nnit"])["policies"]
    assert ids == [f"PickCube-v1/32-16-64-32/{seed:03d}" for seed in (0, 1, 128)]


@pytest.mark.parametrize(
    ("name", "file", "message"),
    [
        ("PickCube-v1/32-16-64-32/007", "a.onnx", "did you mean PickCube-v1/32-16-64-32/001"),
        ("PickCube-v1/32-16-64-33", "a.safetensors", "did you mean 32-16-64-32"),
        ("PickCube-v1/32-16-64-32", "a.onnx", "PickCube-v1/32-16-64-32/001"),
        (ID, "a.pt", r"no format named '.pt': did you mean .pt2"),
    ],
)
def test_what_cannot_be_exported_is_said(made_once: Path, tmp_path: Path, name: str, file: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        export(Zoo.open(made_once).filter(pc.field("ghn_seed") > 0), name, tmp_path / file)
    assert not any(tmp_path.iterdir())


def test_datasets_reads_the_folder_and_the_cards_example_works(dataset: Path, made_once: Path, tmp_path: Path) -> None:
    zoo = Zoo.open(made_once)
    cache = str(tmp_path / "cache")
    digits = load_dataset(str(dataset), "MNIST-PCA32", split="unseen", cache_dir=cache)
    assert (len(digits), digits[0]["return"], digits[0]["success_at_end"]) == (2, 0.96, None)
    splits = load_dataset(str(dataset), cache_dir=cache)  # the first task is the default
    assert {name: len(rows) for name, rows in splits.items()} == {
        "seen": 3, "unseen": 2, "excluded": 2, "heldout_seed": 4
    }  # fmt: skip
    for rows in splits.values():
        for row in rows:
            stored = zoo[row["id"]]
            assert np.array_equal(np.array(row["parameters"], np.float16), stored.weights.flat()[0].numpy())
            assert row["success_at_end"] == stored.record["success_at_end"]

    (example,) = re.findall(r"```python\n(.*?)```", (dataset / "README.md").read_text(), re.DOTALL)
    example = example.replace('split="seen")', f'split="seen", cache_dir={cache!r})')
    names: dict[str, Any] = {}
    exec(example, names)
    observations = torch.randn(5, 42, generator=torch.Generator().manual_seed(0))
    module = zoo[names["policy"]["id"]].to_module(standardised=True)
    assert torch.equal(names["network"](observations), module(observations))
    features = load_file(dataset / "MNIST-PCA32" / "features.safetensors")
    assert features["mean"].shape == (784,) and features["components"].shape == (32, 784)
    constants = json.loads((dataset / "PickCube-v1" / "task.json").read_text())
    assert np.array_equal(np.float32(constants["observation_std"]), tasks.get("PickCube-v1").observation_std)


def test_the_croissant_file_validates_and_leads_to_the_rows(dataset: Path, made_once: Path) -> None:
    described = mlcroissant.Dataset(dataset / "croissant.json")  # raises if it is not valid
    assert not described.metadata.ctx.issues.errors
    assert {records.uuid for records in described.metadata.record_sets} == {
        f"{task}/{split}"
        for task in ("PickCube-v1", "MNIST-PCA32")
        for split in ("seen", "unseen", "excluded", "heldout_seed")
    }
    (first, *_) = described.records("PickCube-v1/unseen")
    stored = Zoo.open(made_once)[first["PickCube-v1/unseen/id"].decode()]
    assert first["PickCube-v1/unseen/parameters"] == stored.weights.flat()[0].tolist()


def test_a_zoo_that_lacks_a_shard_makes_no_dataset(zoo_folder: Path, tmp_path: Path) -> None:
    (zoo_folder / "16-16-16-32.safetensors").unlink()
    with pytest.raises(UserError, match=r"16-16-16-32.safetensors is missing"):
        card.write_dataset(tmp_path / "set", [Zoo.open(zoo_folder)])


def test_a_dataset_is_not_written_over_that_of_another_task(dataset: Path, made_once: Path) -> None:
    with pytest.raises(UserError, match="holds the data set of MNIST-PCA32"):
        card.write_dataset(dataset, [Zoo.open(made_once)])
