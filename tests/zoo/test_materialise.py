from __future__ import annotations

import errno
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from nnit_zoo import files
from nnit_zoo.architecture import Architecture
from nnit_zoo.atomic import write_atomically, write_bytes
from nnit_zoo.errors import UserError
from nnit_zoo.files import Entry, Manifest
from nnit_zoo.ghn import GHN
from nnit_zoo.hub import Source
from nnit_zoo.materialise import materialise, write_manifest
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.verify import verify
from nnit_zoo.zoo import Zoo

SCRIPT = """
import os, sys, torch
from pathlib import Path
from nnit_zoo.materialise import materialise
torch.set_num_threads(int(sys.argv[3]))
child = os.fork() if sys.argv[4:] == ["twice"] else 0
materialise(Path(sys.argv[1]), Path(sys.argv[2]))
if child:
    sys.exit(os.waitpid(child, 0)[1] != 0)
"""


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def in_another_process(*arguments: object, **variables: str) -> None:
    command = [sys.executable, "-c", SCRIPT, *map(str, arguments)]
    subprocess.run(command, env=os.environ | variables, check=True)


def test_other_machines_and_thread_counts_give_the_same_bytes(
    data_folder: Path, zoo_folder: Path, tmp_path: Path
) -> None:
    # without vector instructions torch and MKL sum in another order, as another processor would
    plain = {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE"}
    in_another_process(data_folder, tmp_path / "other", 2, **plain)
    assert hashes(tmp_path / "other") == hashes(zoo_folder)
    write_manifest(shutil.copytree(data_folder, tmp_path / "again"), None)
    assert hashes(tmp_path / "again") == hashes(data_folder)


def test_the_index_says_how_large_a_policy_is_and_its_weights(made_once: Path) -> None:
    for policy in Zoo.open(made_once):
        flat = policy.weights.flat().double().numpy()[0]
        assert policy.record["n_params"] == flat.size
        assert policy.record["weight_norm"] == pytest.approx(np.linalg.norm(flat), rel=1e-7)


@pytest.mark.parametrize("message", ["has other columns than id, task,", "is not a Parquet file"])
def test_an_index_of_something_else_is_told(zoo_folder: Path, message: str) -> None:
    manifest, path = Manifest.read(zoo_folder), zoo_folder / files.INDEX
    if "columns" in message:
        pq.write_table(files.read_index(path).drop_columns("weight_norm"), path)
    else:
        path.write_bytes(b"garbage")
    manifest.index = Entry.of(path.read_bytes())
    (zoo_folder / files.MANIFEST).write_bytes(manifest.to_bytes())
    (problem,) = verify(zoo_folder)
    assert f"index.parquet {message}" in problem
    with pytest.raises(UserError, match=message):
        Zoo.open(zoo_folder)
    with pytest.raises(UserError, match=message):
        Source(str(zoo_folder), "PickCube-v1").fetch(zoo_folder / "copy")


def test_a_damaged_index_that_ships_is_told_before_it_is_copied(data_folder: Path, tmp_path: Path) -> None:
    damaged = shutil.copytree(data_folder, tmp_path / "damaged")
    pq.write_table(files.read_index(data_folder / files.INDEX), damaged / files.INDEX, compression="none")
    with pytest.raises(UserError, match=r"index.parquet is not what manifest.json promises; install nnit again"):
        materialise(damaged, tmp_path / "zoo")
    assert not (tmp_path / "zoo").exists()


def test_a_zoo_that_is_there_is_not_written_again(data_folder: Path, zoo_folder: Path) -> None:
    """It may be on a disk that is full, or read-only."""
    before = {path.name: path.stat().st_ino for path in zoo_folder.iterdir()}
    materialise(data_folder, zoo_folder, splits=["unseen"])
    assert {path.name: path.stat().st_ino for path in zoo_folder.iterdir()} == before


def test_two_writers_of_a_file_with_the_same_process_number_do_not_meet(tmp_path: Path) -> None:
    def write(temporary: Path) -> None:
        temporary.write_bytes(b"first")
        write_bytes(tmp_path / "x", b"second")

    write_atomically(tmp_path / "x", write)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"first"]


def test_two_processes_at_once_leave_one_sound_zoo(data_folder: Path, zoo_folder: Path, tmp_path: Path) -> None:
    in_another_process(data_folder, tmp_path / "shared", 1, "twice")
    assert hashes(tmp_path / "shared") == hashes(zoo_folder)


def test_shards_are_plain_safetensors(zoo_folder: Path) -> None:
    with safe_open(zoo_folder / "32-16-64-32.safetensors", framework="numpy") as shard:
        assert shard.metadata() == {
            "task": "PickCube-v1",
            "architecture": "32-16-64-32",
            "inputs": "42",
            "outputs": "8",
        }
        assert shard.get_slice("layers.0").get_dtype() == "F16"
        assert shard.get_slice("layers.0").get_shape() == [3, 32, 43]
        assert shard.get_slice("layers.4").get_shape() == [3, 8, 33]


def test_a_killed_run_is_resumed_and_finished_shards_are_kept(data_folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "zoo"
    finished: list[int] = []

    def kill_after_two(shards: int) -> None:
        finished.append(shards)
        if sum(finished) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        materialise(data_folder, target, kill_after_two)
    before = {path.name: path.stat().st_mtime_ns for path in target.iterdir()}
    assert len(before) == 2
    with pytest.raises(UserError, match="no zoo"):  # half a zoo is none
        Zoo.open(target)

    finished.clear()
    materialise(data_folder, target, finished.append)
    assert finished == [2, 1, 1]
    assert {name: (target / name).stat().st_mtime_ns for name in before} == before
    assert verify(target) == []


def test_a_damaged_shard_is_found_and_mended(data_folder: Path, zoo_folder: Path) -> None:
    sound = hashes(zoo_folder)
    (zoo_folder / "32-16-64-32.safetensors").write_bytes(b"no shard")
    (zoo_folder / "16-16-16-32.safetensors").unlink()
    problems = verify(zoo_folder)
    assert len(problems) == 2
    for problem in problems:
        assert f"nnit-zoo download --task PickCube-v1 --folder {zoo_folder}" in problem
    materialise(data_folder, zoo_folder)
    assert hashes(zoo_folder) == sound


def test_a_full_disk_names_the_folder_and_the_bytes_needed(
    data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "write_bytes", full)
    size = Manifest.read(data_folder).size
    with pytest.raises(UserError, match=f"no space left in {tmp_path}/zoo: {size} bytes"):
        materialise(data_folder, tmp_path / "zoo")


def test_a_target_that_is_a_file_is_an_error_with_advice(data_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="--folder"):
        materialise(data_folder, tmp_path / "file")


def test_ghns_that_do_not_give_the_manifests_shards_are_refused(data_folder: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(data_folder, tmp_path / "broken")
    with safe_open(broken / "ghns.safetensors", framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(broken / "ghns.safetensors")
    tensors["lift.bias"][0] += 1
    save_file(tensors, broken / "ghns.safetensors", metadata)
    with pytest.raises(
        UserError, match=r"32-16-64-32.safetensors is not what the manifest promises: it came out different"
    ):
        materialise(broken, tmp_path / "zoo")
    assert not (tmp_path / "zoo" / "32-16-64-32.safetensors").exists()
    (broken / "ghns.safetensors").write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"ghns.safetensors is missing or damaged"):
        materialise(broken, tmp_path / "zoo")


@contextmanager
def planted(monkeypatch: pytest.MonkeyPatch, values: Sequence[float]) -> Iterator[None]:
    """Every GHN emits these parameters at the start of its policies' third layer."""
    emit = GHN.emit

    def emit_with_values(ghn: GHN, architecture: Architecture) -> PolicyBatch:
        batch = emit(ghn, architecture)
        batch.layers[2][0, 0, : len(values)] = torch.tensor(values, dtype=batch.layers[2].dtype)
        return batch

    with monkeypatch.context() as patch:
        patch.setattr(GHN, "emit", emit_with_values)
        yield


def test_policies_that_are_not_finite_are_refused(
    data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with planted(monkeypatch, (1e6,)), pytest.raises(UserError, match=r"PickCube-v1/32-16-64-32/000 .*not finite"):
        write_manifest(shutil.copytree(data_folder, tmp_path / "bad"), None)


def test_machines_that_round_a_tie_to_different_sides_make_the_same_bytes(
    data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tie, last_bit = 1 + 2**-11, 2**-52  # halfway between two float16 numbers, and the float64 next to it
    ours = shutil.copytree(data_folder, tmp_path / "ours")
    with planted(monkeypatch, (tie + last_bit, -tie, 0.25)):
        write_manifest(ours, None)
        materialise(ours, tmp_path / "here")
    with planted(monkeypatch, (tie - last_bit, -tie - last_bit, 0.25)):
        materialise(ours, tmp_path / "there")
    assert hashes(tmp_path / "here") == hashes(tmp_path / "there")
    assert Zoo.open(tmp_path / "there").batch("32-16-64-32").layers[2][0, 0, 0] == 1 + 2**-10
    with planted(monkeypatch, (tie - 1e-6, -tie, 0.25)), pytest.raises(UserError, match="came out different"):
        materialise(ours, tmp_path / "damaged")  # no rounding of another machine moves a parameter that far


def tamper(folder: Path, change: Callable[[list[dict[str, Any]], dict[str, torch.Tensor]], None]) -> None:
    """Change the index or a shard, and make the checksums right again."""
    manifest = Manifest.read(folder)
    name = "32-16-64-32.safetensors"
    rows = files.read_index(folder / files.INDEX).to_pylist()
    tensors = load_file(folder / name)
    change(rows, tensors)
    save_file(tensors, folder / name)
    pq.write_table(pa.Table.from_pylist(rows, files.INDEX_SCHEMA), folder / files.INDEX)
    manifest.shards[name] = Entry.of((folder / name).read_bytes())
    manifest.index = Entry.of((folder / files.INDEX).read_bytes())
    (folder / files.MANIFEST).write_bytes(manifest.to_bytes())


def test_verify_looks_behind_the_checksums(zoo_folder: Path) -> None:
    assert verify(zoo_folder) == []

    def change(rows: list[dict[str, Any]], tensors: dict[str, torch.Tensor]) -> None:
        tensors["layers.0"][1, 0, 0] = np.nan
        heldout = next(row for row in rows if row["split"] == "heldout_seed")
        heldout["split"] = "seen"  # a reference policy smuggled into the training split

    tamper(zoo_folder, change)
    text = "\n".join(verify(zoo_folder))
    assert "PickCube-v1/32-16-64-32/001 in" in text
    assert "gives no finite actions" in text
    assert "is not the one in the index" in text
    assert "PickCube-v1/32-16-64-32/128 has split 'seen' in the index, but should have 'heldout_seed'" in text


def test_a_policy_listed_twice_and_other_numbers_than_float16_are_found(zoo_folder: Path) -> None:
    def widen(rows: list[dict[str, Any]], tensors: dict[str, torch.Tensor]) -> None:
        rows.pop()
        tensors["layers.1"] = tensors["layers.1"].float()

    tamper(zoo_folder, lambda rows, tensors: rows.append(rows[-1]))
    assert f"{zoo_folder / files.INDEX} lists a policy twice" in verify(zoo_folder)
    tamper(zoo_folder, widen)
    assert verify(zoo_folder) == [f"{zoo_folder / '32-16-64-32.safetensors'} does not hold float16 parameters"]
