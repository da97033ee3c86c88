"""What ships fits together: each zoo's GHNs, its manifest, the checkpoints trained on it, and the official results."""

import re
from pathlib import Path

import pytest
from safetensors.torch import load_file

from nnit_baselines import SampleRequest, registry
from nnit_baselines.generator import WEIGHTS
from nnit_bench.records import RECORD, RunRecord
from nnit_bench.results import SHIPPED
from nnit_zoo import files, tasks
from nnit_zoo.architecture import architectures
from nnit_zoo.files import MANIFEST, sha256_of
from nnit_zoo.materialise import materialise
from nnit_zoo.places import data_folder, tasks_with_zoo
from nnit_zoo.zoo import Zoo, policy_hashes

ROOT = Path(__file__).parents[1]
TEXTS = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "nnit_zoo").glob("*.py")]
POLICY = re.compile(r"\b([\w-]+)/\d+(?:-\d+)+/\d{3}\b")
CHECKPOINTS = [path.parent for path in sorted(registry.CHECKPOINTS.glob(f"*/*/{WEIGHTS}"))]
RESULTS = sorted(path.parent for path in SHIPPED.rglob(RECORD))


def manifest_of(task: str) -> str:
    return sha256_of(data_folder(task) / MANIFEST)


@pytest.mark.parametrize("task", tasks_with_zoo())
def test_a_zoo_follows_from_its_ghns(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shown for its smallest shard."""
    shards = files.Manifest.read(data_folder(task)).shards
    smallest = min(shards, key=lambda name: shards[name].size)
    monkeypatch.setattr(files, "shards_of", lambda index, splits: {smallest})
    materialise(data_folder(task), tmp_path)
    zoo, architecture = Zoo.open(tmp_path), Path(smallest).stem
    listed = files.read_index(data_folder(task) / files.INDEX, architecture)
    assert policy_hashes(zoo.batch(architecture)) == listed["sha256"].to_pylist()


def test_policies_that_are_named_as_examples_ship() -> None:
    texts = (path.read_text().replace("TASK/", "PickCube-v1/") for path in TEXTS)
    named = {found[0]: found[1] for text in texts for found in POLICY.finditer(text)}
    assert named
    for policy, task in named.items():
        assert policy in files.read_index(data_folder(task) / files.INDEX)["id"].to_pylist()


def test_there_are_checkpoints_and_results() -> None:
    assert CHECKPOINTS and RESULTS


@pytest.mark.parametrize("folder", CHECKPOINTS, ids=lambda folder: "-".join(folder.parts[-2:]))
def test_a_checkpoint_is_small_samples_and_is_of_the_zoo_that_ships(folder: Path, tmp_path: Path) -> None:
    generator = registry.get(folder.parent.name).from_pretrained(folder, folder.name)
    assert generator.training_facts["zoo_manifest_sha256"] == manifest_of(folder.name)
    assert max(tensor.element_size() for tensor in load_file(folder / WEIGHTS).values()) <= 2
    generator.save_pretrained(tmp_path)  # its hash is how a run says which one it scored
    assert sha256_of(tmp_path / WEIGHTS) == sha256_of(folder / WEIGHTS)
    generator.sampling_steps = 2
    task = tasks.get(folder.name)
    wanted = architectures("unseen", task.inputs, task.outputs)[0]
    assert generator.sample(SampleRequest(wanted, 2, seed=0)).finite().all()


@pytest.mark.parametrize("folder", RESULTS, ids=lambda folder: "-".join(folder.parts[-4:]))
def test_an_official_result_is_of_the_zoo_and_the_checkpoint_that_ship(folder: Path) -> None:
    record = RunRecord.read(folder)
    assert folder == SHIPPED.joinpath(*folder.parts[-4:]) and folder.name == record.run_id
    assert record.zoo.sha256 == manifest_of(record.protocol.task)
    checkpoint = registry.checkpoint(record.method.name, record.protocol.task)
    assert record.method.checkpoint_sha256 == (sha256_of(checkpoint / WEIGHTS) if checkpoint else None)
