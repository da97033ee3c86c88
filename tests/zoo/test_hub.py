"""Zoos from and to the Hub, spoken through huggingface_hub to a stand-in on this machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import httpx2
import huggingface_hub
import pytest
from huggingface_hub.constants import ENDPOINT
from huggingface_hub.errors import HfHubHTTPError

from nnit_zoo import card, files
from nnit_zoo.cli import push
from nnit_zoo.display import Display
from nnit_zoo.download import Download
from nnit_zoo.errors import UserError
from nnit_zoo.hub import Source, Target, explained
from nnit_zoo.verify import verify
from nnit_zoo.zoo import Zoo

SHARD = "PickCube-v1/32-16-64-32.safetensors"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def nnit_zoo(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own: huggingface_hub reads its environment once, when it is imported."""
    code = "from nnit_zoo.cli import main; main()"
    variables = os.environ | {"NO_PROXY": "127.0.0.1,localhost"} | environment
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=variables, check=False
    )


@pytest.mark.parametrize(
    "address",
    [
        "someone/zoo",
        "hf://datasets/someone/zoo",
        "hf://datasets/someone/zoo/",
        "datasets/someone/zoo",
        f"{ENDPOINT}/datasets/someone/zoo",
    ],
)
def test_the_hub_gives_the_bytes_that_the_ghns_give(hub, made_once: Path, tmp_path: Path, address: str) -> None:
    finished: list[int] = []
    Source(address, "PickCube-v1", revision="main").fetch(tmp_path / "zoo", finished.append)
    assert contents(tmp_path / "zoo") == contents(made_once)
    assert sum(finished) == 4
    assert f"/objects/someone/zoo/{SHARD}" in hub.asked  # a redirect was followed
    hub.asked.clear()
    Source(address, "PickCube-v1").fetch(tmp_path / "zoo")
    assert not any(path.endswith("safetensors") for path in hub.asked)


def test_a_folder_is_a_source_with_or_without_the_tasks_name(made_once: Path, tmp_path: Path) -> None:
    Source(str(made_once), "PickCube-v1").fetch(tmp_path / "first")
    (tmp_path / "all").mkdir()
    (tmp_path / "first").rename(tmp_path / "all" / "PickCube-v1")
    Source(str(tmp_path / "all"), "PickCube-v1").fetch(tmp_path / "second")
    assert contents(tmp_path / "second") == contents(made_once)


def test_a_split_brings_its_shards_and_a_later_run_the_rest(hub, tmp_path: Path) -> None:
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path, splits=["seen"])
    assert {path.name for path in tmp_path.iterdir()} == {
        "32-16-64-32.safetensors", "64-64-64-32.safetensors", files.INDEX, files.MANIFEST
    }  # fmt: skip
    zoo = Zoo.open(tmp_path)
    assert len(zoo.training_view()) == 3
    with pytest.raises(UserError, match=r"16-16-16-32.safetensors is missing.*nnit-zoo download"):
        zoo.batch("16-16-16-32")
    assert verify(tmp_path, splits=["seen"]) == []
    assert len(verify(tmp_path)) == 2
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path)
    assert verify(tmp_path) == []


def test_a_connection_that_breaks_once_is_taken_up_again(hub, tmp_path: Path) -> None:
    hub.cut[SHARD] = 1
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path)
    assert verify(tmp_path) == []


def test_a_download_that_is_cut_off_leaves_whole_files_and_a_rerun_completes(hub, tmp_path: Path) -> None:
    hub.cut[SHARD] = 10
    with pytest.raises(UserError, match="run the same command again"):
        Source("someone/zoo", "PickCube-v1").fetch(tmp_path)
    for path in tmp_path.iterdir():
        assert hub.files["someone/zoo"][f"PickCube-v1/{path.name}"] == path.read_bytes()
    assert not (tmp_path / files.MANIFEST).exists()
    hub.cut.clear()
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path)
    assert verify(tmp_path) == []


@pytest.mark.parametrize("name", ["32-16-64-32.safetensors", files.INDEX])
def test_a_file_with_another_checksum_is_refused(hub, tmp_path: Path, name: str) -> None:
    sound = hub.files["someone/zoo"][f"PickCube-v1/{name}"]
    hub.files["someone/zoo"][f"PickCube-v1/{name}"] = sound[:-1] + bytes([sound[-1] ^ 1])
    with pytest.raises(UserError, match=f"{name} is not what the manifest promises.*someone/zoo"):
        Source("someone/zoo", "PickCube-v1").fetch(tmp_path)
    assert not (tmp_path / name).exists()
    hub.files["someone/zoo"][f"PickCube-v1/{name}"] = sound
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path)
    assert verify(tmp_path) == []


def test_a_manifest_cannot_write_outside_its_folder(hub, tmp_path: Path) -> None:
    manifest = hub.files["someone/zoo"]["PickCube-v1/manifest.json"]
    evil = manifest.replace(b"32-16-64-32.safetensors", b"../32-16-64-32.safetensors")
    hub.files["someone/zoo"]["PickCube-v1/manifest.json"] = evil
    with pytest.raises(UserError, match=r"manifest.json .* is damaged"):
        Source("someone/zoo", "PickCube-v1")


@pytest.mark.parametrize(
    ("address", "revision", "task", "message"),
    [
        ("someone/zo", None, "PickCube-v1", "someone/zo"),
        ("someone/zoo", "v9", "PickCube-v1", "zoo@v9: .*revision not found"),
        ("someone/zoo", None, "PushCube-v1", "nothing of that kind in someone/zoo"),
        ("nobody", None, "PickCube-v1", "nobody"),
        ("./nowhere", None, "PickCube-v1", "no folder ./nowhere"),
        (".", "main", "PickCube-v1", "leave out --revision"),
    ],
)
def test_places_without_the_zoo_are_named(hub, address: str, revision: str, task: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        Source(address, task, revision)


def test_no_connection_is_an_answer(made_once: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", "http://127.0.0.1:9")  # where nobody listens
    with pytest.raises(UserError, match="the connection to someone/zoo failed"):
        Source("someone/zoo", "PickCube-v1")


def test_what_is_pushed_can_be_downloaded(hub, made_once: Path, tmp_path: Path) -> None:
    card.write_dataset(tmp_path / "set", [Zoo.open(made_once)], "someone/new")
    assert hub.address in Target("someone/new", ["PickCube-v1"]).push(tmp_path / "set")
    assert "someone/new" in hub.files["someone/new"]["README.md"].decode()
    large = {path.read_bytes() for path in (tmp_path / "set").rglob("*") if path.suffix in (".safetensors", ".parquet")}
    assert set(hub.objects.values()) == large
    Source("someone/new", "PickCube-v1").fetch(tmp_path / "zoo")
    assert contents(tmp_path / "zoo") == contents(made_once)


def test_a_push_takes_away_what_a_task_had_else_and_nothing_more(hub, made_once: Path, tmp_path: Path) -> None:
    card.write_dataset(tmp_path / "set", [Zoo.open(made_once)], "someone/new")
    kept = {"notes.md": b"mine", "figures/one.png": b"mine"}
    hub.files["someone/new"] = {"PickCube-v1/build/ghns.safetensors": b"of another zoo", **kept}
    Target("someone/new", ["PickCube-v1"]).push(tmp_path / "set")
    paths = {str(path.relative_to(tmp_path / "set")) for path in (tmp_path / "set").rglob("*") if path.is_file()}
    assert set(hub.files["someone/new"]) == {*paths, *kept}


def test_a_push_does_not_take_other_zoos_off_the_card(hub, made_once: Path, tmp_path: Path) -> None:
    card.write_dataset(tmp_path / "set", [Zoo.open(made_once)], "someone/new")
    Target("someone/new", ["PickCube-v1"]).push(tmp_path / "set")
    with pytest.raises(UserError, match="someone/new also holds PickCube-v1: name all of its tasks"):
        Target("someone/new", ["PushCube-v1"])


def test_a_refused_push_says_how_to_log_in(hub) -> None:
    hub.closed = True
    with pytest.raises(UserError, match=r"(?s)refuses someone/new.*hf auth login"):
        Target("someone/new", ["PickCube-v1"])


@pytest.mark.parametrize(
    ("status", "advice"),
    [(401, "hf auth login"), (404, "check the name"), (503, "run the same command again"), (413, "no$")],
)
def test_what_the_hub_answers_decides_what_is_advised(status: int, advice: str) -> None:
    request = httpx2.Request("GET", "http://127.0.0.1/")
    error = HfHubHTTPError("no", response=httpx2.Response(status, request=request))
    with pytest.raises(UserError, match=f"someone/zoo.*{advice}"), explained("someone/zoo"):
        raise error


def test_offline_the_usual_zoo_is_made_and_the_hub_not_asked(
    hub, home: Path, made_once: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    hub.asked.clear()
    zoo = Download("PickCube-v1", source="someone/zoo")
    zoo.run(Display(quiet=True))
    assert contents(zoo.folder) == contents(made_once) and not hub.asked
    with pytest.raises(UserError, match="HF_HUB_OFFLINE"):
        Download("PickCube-v1", tmp_path / "elsewhere", source="someone/zoo")
    with pytest.raises(UserError, match=r"no folder \./typo"):
        Download("PickCube-v1", source="./typo")


def test_a_push_of_a_zoo_in_part_makes_no_data_set(hub, home: Path, tmp_path: Path) -> None:
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path / "zoo", splits=["seen"])
    with pytest.raises(UserError, match="is missing or damaged"):
        push("someone/new", folder=tmp_path / "zoo")
    assert set(hub.files) == {"someone/zoo"}
    Source("someone/zoo", "PickCube-v1").fetch(tmp_path / "zoo")
    push("someone/new", folder=tmp_path / "zoo")  # of the task that the folder holds
    assert "PickCube-v1/manifest.json" in hub.files["someone/new"]


def test_a_push_to_nobody_makes_nothing(hub) -> None:
    with pytest.raises(UserError, match="'new' names no data set; write owner/name"):
        Target("new", ["PickCube-v1"])
    assert set(hub.files) == {"someone/zoo"}


@pytest.mark.parametrize("error", [ConnectionError, TimeoutError, RuntimeError])
def test_a_push_that_is_cut_off_by_xet_is_answered(
    hub, error: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Xet's own client raises these, without a word of who was asked."""
    target = Target("someone/new", [])
    monkeypatch.setattr(huggingface_hub.HfApi, "create_commit", Mock(side_effect=error("gone")))
    with pytest.raises(UserError, match=r"connection to someone/new failed \(gone\); run the same command again"):
        target.push(tmp_path)


def test_the_command_with_its_environment(hub, made_once: Path, tmp_path: Path) -> None:
    folder = str(tmp_path / "zoo")
    online = {"HF_ENDPOINT": hub.address, "NNIT_ZOO_SOURCE": "someone/zoo"}
    offline = nnit_zoo("download", "--folder", folder, HF_HUB_OFFLINE="1", **online)
    assert offline.returncode == 2
    assert offline.stderr.startswith("error: someone/zoo cannot be reached, as HF_HUB_OFFLINE is set")
    assert not (tmp_path / "zoo").exists()

    plan = nnit_zoo("download", "--folder", folder, "--split", "unseen", "--dry-run", **online)
    assert "2 of 2 files to write" in plan.stdout
    assert not (tmp_path / "zoo").exists()

    done = nnit_zoo("download", "--folder", folder, **online)
    assert (done.returncode, done.stdout) == (0, f"{folder}\n"), done.stderr
    assert contents(tmp_path / "zoo") == contents(made_once)


def test_two_processes_at_once_leave_one_sound_zoo(hub, made_once: Path, tmp_path: Path) -> None:
    code = "from nnit_zoo.cli import main; main()"
    command = [sys.executable, "-c", code, "download", "--folder", str(tmp_path / "zoo"), "--source", "someone/zoo"]
    both = [subprocess.Popen(command, env=os.environ | {"HF_ENDPOINT": hub.address}) for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    assert contents(tmp_path / "zoo") == contents(made_once)
