"""MNIST-PCA32: the shipped features against the original digits, and scoring against closed forms."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from safetensors.torch import load_file as load_state

from nnit_zoo import tasks
from nnit_zoo.architecture import Architecture, architectures
from nnit_zoo.build import mnist
from nnit_zoo.errors import UserError
from nnit_zoo.ghn import GHN
from nnit_zoo.materialise import stored
from nnit_zoo.places import data_folder
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks import mnist as mnist_task
from nnit_zoo.tasks.mnist import FEATURES

SAMPLE = Path(__file__).parent / "mnist"  # the first 16 digits of each part
TASK = tasks.get("MNIST-PCA32")
SHIPPED = load_file(data_folder("MNIST-PCA32") / FEATURES)


def policies(count: int, seed: int = 0) -> list[PolicyBatch]:
    """Random policies of two architectures."""
    draws = torch.Generator().manual_seed(seed)
    batches = []
    for architecture in architectures("unseen", 32, 10)[:2]:
        shapes = [(count, *shape) for shape in architecture.block_shapes]
        layers = tuple(torch.randn(shape, generator=draws) / shape[2] ** 0.5 for shape in shapes)
        batches.append(PolicyBatch(architecture, layers))
    return batches


def linear_policy(weights: torch.Tensor) -> PolicyBatch:
    """A policy that gives `weights` [10, 32] times its input: so small inside that tanh is linear."""
    size = 1e-4
    inside = torch.cat([torch.eye(32, dtype=torch.float64), torch.zeros(32, 1)], dim=1)
    outside = torch.cat([weights / size, torch.zeros(10, 1)], dim=1)
    layers = [inside * size, inside, inside, inside, outside]
    return PolicyBatch(Architecture(32, (32, 32, 32, 32), 10), tuple(layer[None] for layer in layers))


def test_shipped_features_are_the_projected_digits() -> None:
    for part, (images, labels) in mnist.read_digits(str(SAMPLE)).items():
        ours = mnist.project(images, SHIPPED["mean"], SHIPPED["components"])
        assert np.array_equal(ours.view(np.uint16), SHIPPED[f"{part}.features"][:16].view(np.uint16))
        assert np.array_equal(labels, SHIPPED[f"{part}.labels"][:16])
    assert (data_folder("MNIST-PCA32") / FEATURES).stat().st_size < 5e6


def test_the_basis_is_the_principal_one_of_the_training_digits() -> None:
    components = SHIPPED["components"].astype(np.float64)
    np.testing.assert_allclose(components @ components.T, np.eye(32), atol=1e-6)
    features = SHIPPED["train.features"].astype(np.float64)
    assert features.shape == (60_000, 32)
    np.testing.assert_allclose(features.mean(0), 0, atol=1e-4)
    covariance = np.cov(features.T, bias=True)
    variances = np.diag(covariance)
    assert np.all(np.diff(variances) < 0)
    np.testing.assert_allclose(covariance - np.diag(variances), 0, atol=1e-4)


def test_pca_agrees_with_the_singular_values_of_the_centred_images() -> None:
    images = mnist.read_digits(str(SAMPLE))["train"][0]
    mean, components = mnist.fit_pca(images, 5)
    centred = images / 255 - (images / 255).mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    np.testing.assert_allclose(mean, (images / 255).mean(0), atol=1e-7)
    np.testing.assert_allclose(np.abs(np.sum(axes[:5] * components, axis=1)), 1, atol=1e-6)
    assert all(row[np.abs(row).argmax()] > 0 for row in components)


@pytest.mark.skipif("NNIT_MNIST" not in os.environ, reason="NNIT_MNIST names no folder with MNIST's original files")
def test_shipped_features_are_those_of_a_rebuild(tmp_path: Path) -> None:
    constants, _ = mnist.build_features(os.environ["NNIT_MNIST"], tmp_path / FEATURES)
    rebuilt = load_file(tmp_path / FEATURES)
    assert constants == {name: TASK.record[name] for name in ("observation_mean", "observation_std")}
    assert rebuilt.keys() == SHIPPED.keys()
    for name, shipped in SHIPPED.items():
        if shipped.dtype == np.float16:  # another LAPACK may turn a rounding, by one unit in the last place
            apart = np.abs(rebuilt[name].astype(np.float64) - shipped) / np.spacing(np.abs(shipped))
            assert apart.max() <= 1 and (apart > 0).mean() < 1e-3
        else:
            np.testing.assert_allclose(rebuilt[name], shipped, atol=1e-6)


def test_digits_come_from_plain_files_too_and_missing_ones_are_named(tmp_path: Path) -> None:
    for path in SAMPLE.glob("*.gz"):
        (tmp_path / path.stem).write_bytes(gzip.decompress(path.read_bytes()))
    ours, theirs = mnist.read_digits(str(tmp_path)), mnist.read_digits(str(SAMPLE))
    assert all(np.array_equal(ours[part][index], theirs[part][index]) for part in ours for index in (0, 1))
    cut = tmp_path / "t10k-labels-idx1-ubyte"
    for content in (cut.read_bytes()[:-1], cut.read_bytes()[:3]):
        cut.write_bytes(content)
        with pytest.raises(UserError, match=r"t10k-labels-idx1-ubyte cannot be read .*; fetch it again"):
            mnist.read_digits(str(tmp_path))
    (tmp_path / f"{cut.name}.gz").write_bytes(gzip.compress(b"digits")[:-9])
    cut.unlink()
    with pytest.raises(UserError, match=r"t10k-labels-idx1-ubyte\.gz cannot be read .*; fetch it again"):
        mnist.read_digits(str(tmp_path))
    (tmp_path / f"{cut.name}.gz").unlink()
    with pytest.raises(UserError, match="no t10k-labels-idx1-ubyte or"):
        mnist.read_digits(str(tmp_path))


def test_digits_come_from_a_hub_data_set_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import datasets
    from PIL import Image

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    expected = mnist.read_digits(str(SAMPLE))
    for part, (images, labels) in expected.items():
        columns = {"image": [Image.fromarray(image.reshape(28, 28)) for image in images], "label": labels}
        (tmp_path / "hub").mkdir(exist_ok=True)
        datasets.Dataset.from_dict(columns).to_parquet(tmp_path / "hub" / f"{part}.parquet")
    found = mnist.read_digits(str(tmp_path / "hub"))
    assert all(np.array_equal(found[part][index], expected[part][index]) for part in expected for index in (0, 1))
    with pytest.raises(UserError, match="four IDX files, or ylecun/mnist"):
        mnist.read_digits(str(tmp_path / "nothing"))


def test_accuracy_is_that_of_a_known_classifier() -> None:
    inputs, labels = TASK.digits("train")
    weights = torch.linalg.lstsq(inputs.double(), torch.nn.functional.one_hot(labels, 10).double()).solution.T
    policy = linear_policy(weights)
    table = TASK.evaluate([policy], TASK.phase_seeds("select", TASK.episodes))
    inputs, labels = TASK.digits("test")
    right = (inputs.double() @ weights.T).argmax(1) == labels
    assert right.double().mean() > 0.8
    assert table["seed"].to_pylist() == list(range(100))
    blocks = right.view(100, 100).double().mean(1)
    np.testing.assert_allclose(table["return"].to_numpy(), blocks, atol=0.011)  # a near-tie may go the other way
    assert np.mean(table["return"].to_numpy()) == pytest.approx(float(right.double().mean()), abs=2e-4)
    assert table["success_once"].null_count == table["success_at_end"].null_count == 100

    mean, std = torch.from_numpy(TASK.observation_mean), torch.from_numpy(TASK.observation_std)
    module = policy.to_module(0, mean, std)  # takes raw features, as a user has them
    answers = module(torch.from_numpy(SHIPPED["test.features"].astype(np.float32))).argmax(1)
    assert (answers == labels).double().mean() == pytest.approx(float(right.double().mean()), abs=5e-4)


def test_a_policy_scores_the_same_in_any_company_and_order() -> None:
    table = TASK.evaluate(policies(2), range(100)).to_pylist()
    assert [row["policy"] for row in table] == [number for number in range(4) for _ in range(100)]
    backward = TASK.evaluate(policies(2)[::-1], [7, 3]).to_pylist()
    assert {**backward[0], "policy": 2} == table[2 * 100 + 7]
    assert {**backward[-1], "policy": 1} == table[1 * 100 + 3]
    assert len({row["return"] for row in table}) > 5


def test_several_processes_give_the_same_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = TASK.evaluate(policies(2), range(100), workers=1)
    monkeypatch.setattr(mnist_task, "UNIT", 1)
    done: list[int] = []
    assert TASK.evaluate(policies(2), range(100), workers=2, progress=done.append).equals(alone)
    assert done == [100] * 4
    with pytest.raises(UserError, match="1 worker or more"):
        TASK.evaluate(policies(1), [1], workers=0)


def test_a_policy_that_is_not_finite_or_huge_stops_nothing() -> None:
    batch = policies(3)[0]
    for value, row in ((float("nan"), 0), (6e4, 1)):
        batch.layers[1][row, 2, 3] = value
    done: list[int] = []
    rows = TASK.evaluate([batch], [0, 1], progress=done.append).to_pylist()
    assert [(row["return"], row["reason"]) for row in rows[:2]] == [(0, "not finite")] * 2
    assert all(row["reason"] is None for row in rows[2:])
    assert rows[4:] == [{**row, "policy": 2} for row in TASK.evaluate([batch[2]], [0, 1]).to_pylist()]
    assert sum(done) == 6


def test_there_are_100_blocks_and_one_test_set() -> None:
    assert TASK.phase_seeds("select", 100) == TASK.scoring_seeds == range(100)
    assert TASK.phase_seeds("select", 3) == range(3)
    assert not TASK.phase_seeds("report", 100)
    with pytest.raises(UserError, match="1 to 100 episodes, not 101"):
        TASK.phase_seeds("select", 101)
    for seed in (-1, 100):
        with pytest.raises(UserError, match=f"up to 99, not {seed}"):
            TASK.evaluate(policies(1), [5, seed])
    with pytest.raises(UserError, match="32 inputs"):
        TASK.evaluate([PolicyBatch(Architecture(4, (2,), 2), (torch.zeros(1, 2, 5), torch.zeros(1, 2, 3)))], [0])


def test_a_hundred_steps_teach_an_unseen_architecture_to_tell_digits_apart(tmp_path: Path) -> None:
    config = mnist.MNISTConfig(steps=100, states_per_architecture=256, learning_rate=3e-3)
    mnist.train_ghn(config, tmp_path / "ghn.safetensors", seed=0)
    ghn = GHN.from_state(32, 10, load_state(tmp_path / "ghn.safetensors"))
    table = TASK.evaluate([stored(ghn, architectures("unseen", 32, 10)[0])], TASK.scoring_seeds)
    assert np.mean(table["return"].to_numpy()) > 0.4
