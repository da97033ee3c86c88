from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
import torch

import nnit_zoo
from nnit_zoo import files, tasks
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError
from nnit_zoo.ghn import GHN
from nnit_zoo.materialise import stored
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView, Zoo


def plain_batch(hidden: tuple[int, ...]) -> PolicyBatch:
    architecture = Architecture(42, hidden, 8)
    return PolicyBatch(architecture, tuple(torch.ones(2, *shape) for shape in architecture.block_shapes))


def test_the_zoo_gives_back_what_the_ghns_emit(zoo_folder: Path) -> None:
    zoo = Zoo.open(zoo_folder)
    assert (zoo.task, len(zoo)) == ("PickCube-v1", 11)
    batch = zoo.batch("32-16-64-32")
    assert len(batch) == 3
    ghn = GHN(42, 8, 1)
    assert torch.equal(stored(ghn, batch.architecture).flat(), batch[1].flat())
    rounded = {name: tensor.half() for name, tensor in ghn.state_dict().items()}
    exact = GHN.from_state(42, 8, rounded).double().emit(batch.architecture).flat().numpy()
    assert np.array_equal(exact.astype(np.float16), batch[1].flat().numpy())
    row = {row["id"]: row for row in zoo.index.to_pylist()}["PickCube-v1/32-16-64-32/001"]
    assert (row["split"], row["row"], row["shard"], row["episodes"]) == ("seen", 1, "32-16-64-32.safetensors", 64)
    assert row["success_at_end"] == pytest.approx(0.75 + 1 / 512)


def test_splits_select_policies_in_index_order(zoo_folder: Path) -> None:
    zoo = Zoo.open(zoo_folder)
    assert list(map(str, zoo.architectures("seen"))) == ["32-16-64-32", "64-64-64-32"]
    assert list(map(str, zoo.architectures("unseen"))) == ["16-16-16-32"]
    assert len(zoo.architectures("heldout_seed")) == 4
    assert zoo.ghn_seeds("64-64-64-32", "seen") == (0,)  # seed 1 was dropped
    assert zoo.ghn_seeds("64-64-64-32", "heldout_seed") == (128,)
    held_out = zoo.batch("32-16-64-32", split="heldout_seed")
    assert torch.equal(held_out.flat(), zoo.batch("32-16-64-32")[2].flat())
    with pytest.raises(UserError, match="32-16-64-32"):
        zoo.batch("32-16-64-33", "seen")
    with pytest.raises(UserError, match="unseen"):
        zoo.architectures("unsen")


def test_the_training_view_holds_seen_policies_of_training_seeds_only(zoo_folder: Path) -> None:
    zoo = Zoo.open(zoo_folder)
    view = zoo.training_view()
    assert (view.task, len(view), view.reference) == ("PickCube-v1", 3, False)
    first, second = view.architectures
    assert (view.ghn_seeds(first), view.ghn_seeds(second)) == ((0, 1), (0,))
    assert view.batch(first).layers[0].dtype == torch.float32
    assert torch.equal(view.batch("32-16-64-32").flat(), view.batch(first).flat())
    assert view.ghn_seeds("64-64-64-32") == (0,)
    with pytest.raises(UserError, match="did you mean 32-16-64-32"):
        view.batch("32-16-64-33")
    for text in ("16-16-16-32", "32-16-16-16"):
        with pytest.raises(UserError, match="never for training"):
            view.batch(Architecture.parse(text, 42, 8))


def test_a_training_view_refuses_reference_policies(zoo_folder: Path) -> None:
    zoo = Zoo.open(zoo_folder)
    for split in ("unseen", "excluded", "heldout_seed"):
        reference = zoo.reference_view(split)
        assert reference.reference
        assert len(reference) > 0
        with pytest.raises(UserError, match="never for training"):
            TrainingView(reference.task, reference.batches, reference.seeds)
    seen = plain_batch((32, 16, 64, 32))
    with pytest.raises(UserError, match="held out"):
        TrainingView("PickCube-v1", {seen.architecture: seen}, {seen.architecture: (0, 130)})


def test_policies_are_iterated_found_and_filtered(made_once: Path) -> None:
    zoo = Zoo.open(made_once)
    policies = list(zoo)
    assert [policy.record["id"] for policy in policies] == zoo.index["id"].to_pylist()
    for policy in policies:
        batch = zoo.batch(policy.record["architecture"])
        assert torch.equal(policy.weights.flat(), batch[policy.record["row"]].flat())
    one = zoo["PickCube-v1/32-16-64-32/001"]
    assert torch.equal(one.weights.flat(), zoo.batch("32-16-64-32")[1].flat())
    with pytest.raises(UserError, match="did you mean PickCube-v1/32-16-64-32/001"):
        zoo["PickCube-v1/32-16-64-32/01"]

    ends = zoo.filter((pc.field("ghn_seed") != 1) & (pc.field("architecture") == "32-16-64-32"))
    assert torch.equal(ends.batch("32-16-64-32").flat(), zoo.batch("32-16-64-32")[[0, 2]].flat())
    assert ends.ghn_seeds("32-16-64-32") == (0, 128)
    assert len(ends.filter(pc.field("success_at_end") > 0.8)) == 1
    for wrong in (pc.field("sucess") > 0.5, pc.field("id") > 0.5):
        with pytest.raises(UserError, match="cannot filter by"):
            zoo.filter(wrong)


def test_a_module_of_raw_observations_computes_what_the_task_computes(made_once: Path) -> None:
    policy = Zoo.open(made_once)["PickCube-v1/64-64-64-32/000"]
    task = tasks.get("PickCube-v1")
    draws = np.random.default_rng(0).normal(size=(20, 42)).astype(np.float32)
    raw = task.observation_mean + task.observation_std * draws
    expected = policy.to_module(standardised=True)(torch.from_numpy(draws))
    torch.testing.assert_close(policy.to_module()(torch.from_numpy(raw)), expected, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(expected, policy.weights(torch.from_numpy(draws))[0])
    assert [type(layer) for layer in policy.to_module()] == [torch.nn.Linear, torch.nn.Tanh] * 4 + [torch.nn.Linear]


def test_a_view_can_be_made_of_plain_batches() -> None:
    batch = plain_batch((8, 8))
    view = TrainingView("PickCube-v1", {batch.architecture: batch})
    assert view.architectures == (batch.architecture,)
    assert view.ghn_seeds(batch.architecture) == (0, 1)
    with pytest.raises(UserError, match="8-8"):
        view.batch(Architecture(42, (8, 9), 8))


def test_load_says_what_to_do(zoo_folder: Path, home: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="PickCube-v1"):
        nnit_zoo.load("PickCub-v1")
    with pytest.raises(UserError, match=r"nnit-zoo download --task PickCube-v1$"):
        nnit_zoo.load("PickCube-v1")
    with pytest.raises(UserError, match=f"--folder {tmp_path}/none"):
        nnit_zoo.load("PickCube-v1", tmp_path / "none")
    with pytest.raises(UserError, match="holds the zoo of PickCube-v1"):
        nnit_zoo.load("PushCube-v1", zoo_folder)
    assert len(nnit_zoo.load("PickCube-v1", zoo_folder)) == 11

    older = files.Manifest.read(zoo_folder)
    older.shards.pop("16-16-16-32.safetensors")
    place = home / "nnit" / "zoo" / "PickCube-v1"
    place.mkdir(parents=True)
    (place / files.MANIFEST).write_bytes(older.to_bytes())
    with pytest.raises(UserError, match="another version"):
        nnit_zoo.load("PickCube-v1")


def test_load_makes_a_zoo_that_is_not_there(home: Path, zoo_folder: Path, tmp_path: Path) -> None:
    for folder in (None, str(tmp_path / "mine")):
        assert len(nnit_zoo.load("PickCube-v1", folder, download=True)) == len(nnit_zoo.load("PickCube-v1", folder))
    older = files.Manifest.read(zoo_folder)
    older.shards.pop("16-16-16-32.safetensors")
    for folder in (home / "nnit" / "zoo" / "PickCube-v1", zoo_folder):
        (folder / files.MANIFEST).write_bytes(older.to_bytes())
        nnit_zoo.load("PickCube-v1", None if folder != zoo_folder else folder, download=True)
    assert files.Manifest.read(home / "nnit" / "zoo" / "PickCube-v1") != older
    assert files.Manifest.read(zoo_folder) == older  # a user's own
    with pytest.raises(UserError, match="PickCube-v1"):
        nnit_zoo.load("PickCub-v1", download=True)


def test_what_is_printed_of_a_zoo_is_short_and_says_what_it_is(made_once: Path) -> None:
    zoo = Zoo.open(made_once)
    assert repr(zoo) == (
        f"<Zoo of PickCube-v1 in {made_once}: 11 policies (3 seen, 2 unseen, 2 excluded, 4 heldout_seed)>"
    )
    assert repr(zoo.training_view()) == "<TrainingView of PickCube-v1: 3 policies of 2 architectures, to learn from>"
    assert repr(zoo.reference_view("unseen")).endswith("2 policies of 1 architectures, for comparison only>")
    assert repr(zoo["PickCube-v1/32-16-64-32/000"]) == (
        "<Policy PickCube-v1/32-16-64-32/000: seen, success_at_end 0.75, success_once 1, return 38>"
    )
    batch = zoo.batch("32-16-64-32")
    assert repr(batch) == "<PolicyBatch: 3 networks 32-16-64-32, 42 inputs, 8 outputs, float16>"


def test_the_package_gives_its_main_names_and_imports_them_when_asked() -> None:
    for name in nnit_zoo.__all__:
        assert getattr(nnit_zoo, name).__name__ == name and name in dir(nnit_zoo)
    with pytest.raises(AttributeError, match="no attribute 'Zo'"):
        nnit_zoo.Zo  # type: ignore[attr-defined]  # noqa: B018


def test_policies_for_another_standardisation_are_refused(zoo_folder: Path) -> None:
    manifest = files.Manifest.read(zoo_folder)
    manifest.standardisation = tasks.get("PickCube-v1").standardisation
    (zoo_folder / files.MANIFEST).write_bytes(manifest.to_bytes())
    assert len(Zoo.open(zoo_folder)) == 11
    manifest.standardisation = "another"
    (zoo_folder / files.MANIFEST).write_bytes(manifest.to_bytes())
    with pytest.raises(UserError, match="standardised otherwise"):
        Zoo.open(zoo_folder)


def test_a_damaged_file_is_named_with_the_command_that_mends_it(zoo_folder: Path) -> None:
    shard = zoo_folder / "32-16-64-32.safetensors"
    content = bytearray(shard.read_bytes())
    content[-1] ^= 1
    shard.write_bytes(content)
    zoo = Zoo.open(zoo_folder)
    with pytest.raises(UserError, match=f"32-16-64-32.safetensors.*nnit-zoo download .* --folder {zoo_folder}"):
        zoo.batch("32-16-64-32")
    (zoo_folder / files.INDEX).unlink()
    with pytest.raises(UserError, match=r"index.parquet is missing or damaged"):
        Zoo.open(zoo_folder)
    (zoo_folder / files.MANIFEST).write_text("{")
    with pytest.raises(UserError, match=r"manifest.json is damaged"):
        Zoo.open(zoo_folder)
