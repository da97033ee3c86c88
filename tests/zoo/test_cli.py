from __future__ import annotations

import errno
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import pyarrow as pa
import pytest

from nnit_zoo import export, files, places
from nnit_zoo.cli import app, main
from nnit_zoo.console import print_table
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks.mnist import MNISTPCA32
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.zoo import Zoo

from .conftest import make_data_folder

Result = tuple[int, str, str]
Command = Callable[..., Result]


@pytest.fixture
def nnit_zoo(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs `nnit-zoo` with the tests' own zoo and cache: (exit code, stdout, stderr)."""

    def run(*arguments: str) -> Result:
        monkeypatch.setattr(sys, "argv", ["nnit-zoo", *arguments])
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        return code, *capsys.readouterr()

    return run


def assert_error(result: Result, *parts: str) -> None:
    code, stdout, stderr = result
    assert (code, stdout) == (2, "")
    assert "\nerror: " in f"\n{stderr}"
    for part in parts:
        assert part in stderr


def in_its_own_process(*arguments: str) -> Result:
    code = f"import sys; sys.argv = {['nnit-zoo', *arguments]}\nfrom nnit_zoo.cli import main\nmain()"
    command = [sys.executable, "-X", "importtime", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    return result.returncode, result.stdout, result.stderr


def imported(stderr: str) -> set[str]:
    """The packages that a process of `in_its_own_process` has imported."""
    return {line.rpartition("|")[2].strip().partition(".")[0] for line in stderr.splitlines()}


@pytest.mark.parametrize(("option", "expected"), [("--help", "download"), ("--version", version("nnit"))])
def test_help_and_version_import_nothing_heavy(option: str, expected: str) -> None:
    code, stdout, stderr = in_its_own_process(option)
    assert code == 0
    assert expected in stdout
    assert "cyclopts" in imported(stderr)
    assert not imported(stderr) & {"torch", "numpy", "pyarrow", "mani_skill", "sapien", "huggingface_hub", "pydantic"}


@pytest.mark.parametrize(
    ("command", "expected"),
    [("list", "training policies"), ("show", "is_grasped"), ("download --dry-run", "files to write")],
)
def test_looking_needs_no_torch(command: str, expected: str) -> None:
    code, stdout, stderr = in_its_own_process(*command.split())
    assert code == 0 and expected in stdout
    assert "pyarrow" in imported(stderr) and "torch" not in imported(stderr)


@pytest.mark.parametrize("arguments", [("download", "--task", "NoSuchTask"), ("download", "--fodler", "x")])
def test_a_mistake_exits_with_2_and_no_traceback(arguments: tuple[str, ...]) -> None:
    code, stdout, stderr = in_its_own_process(*arguments)
    assert (code, stdout) == (2, "")
    assert stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in stderr


def test_list_and_show_need_no_download(nnit_zoo: Command, home: Path) -> None:
    (zoo,) = json.loads(nnit_zoo("list", "--json")[1])
    assert (zoo["task"], zoo["policies"], zoo["shards"], zoo["shards_downloaded"]) == ("PickCube-v1", 11, 4, 0)
    assert zoo["splits"]["seen"]["policies"] == 3
    assert "PickCube-v1" in nnit_zoo("list")[1]
    shown = json.loads(nnit_zoo("show", "PickCube-v1", "--json")[1])
    assert shown == zoo | {"layout": shown["layout"]}
    assert shown["layout"]["obj_pose"] == "29-35"
    assert shown["pass_rates"] == {"32-16-64-32": 1.0, "64-64-64-32": 0.5}
    there = home / "nnit" / "zoo" / "PickCube-v1" / "manifest.json"
    there.parent.mkdir(parents=True)
    there.write_text("{")
    assert nnit_zoo("list", "--json")[0] == 0  # whatever lies where the zoo should
    table = nnit_zoo("show")[1]
    assert "heldout_seed" in table and "75.0% pass the thresholds; fewest of 64-64-64-32: 50.0%" in table
    policies = json.loads(nnit_zoo("show", "--architecture", "64-64-64-32", "--json")[1])
    assert [policy["id"] for policy in policies] == ["PickCube-v1/64-64-64-32/000", "PickCube-v1/64-64-64-32/128"]


def test_scores_of_other_episodes_are_not_to_be_compared(nnit_zoo: Command) -> None:
    splits = json.loads(nnit_zoo("show", "--json")[1])["splits"]
    assert {split: row["episodes"] for split, row in splits.items()} == {
        "seen": 64, "unseen": 64, "excluded": 64, "heldout_seed": 16
    }  # fmt: skip
    assert "Means of different numbers of episodes are of different starts" in nnit_zoo("show")[1]


def test_a_table_fits_a_narrow_screen(nnit_zoo: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = nnit_zoo("show")[1].splitlines()
    table = lines[: next(number for number, line in enumerate(lines) if line.startswith("Means of"))]
    assert "architectures" in table[1] and "return" in table[1] and table[-1].startswith("heldout_seed")
    assert max(map(len, table)) <= 80
    monkeypatch.setenv("COLUMNS", "40")
    narrow = nnit_zoo("show")[1].split("Means of")[0]
    assert narrow.count("000") >= 4  # of 38.000: cells are folded, not cut off


def test_download_then_verify_then_mend(nnit_zoo: Command, home: Path) -> None:
    folder = home / "nnit" / "zoo" / "PickCube-v1"
    assert_error(nnit_zoo("verify"), "no zoo of PickCube-v1", "nnit-zoo download --task PickCube-v1")
    assert "5 of 5 files to write" in nnit_zoo("download", "--dry-run")[1]
    assert not folder.exists()

    assert nnit_zoo("download", "--task", "PickCube-v1")[:2] == (0, f"{folder}\n")
    assert "0 of 5 files to write" in nnit_zoo("download", "--dry-run")[1]
    assert "is sound" in nnit_zoo("verify")[1]
    assert json.loads(nnit_zoo("list", "--json")[1])[0]["shards_downloaded"] == 4

    (folder / "16-16-16-32.safetensors").write_bytes(b"")
    code, stdout, _ = nnit_zoo("verify", "--json")
    assert code == 2
    assert "16-16-16-32.safetensors" in json.loads(stdout)["problems"][0]
    assert_error(nnit_zoo("verify"), "16-16-16-32.safetensors", "mend it with: nnit-zoo download --task PickCube-v1\n")
    assert nnit_zoo("download")[0] == 0
    assert json.loads(nnit_zoo("verify", "--json")[1])["problems"] == []


def test_a_split_can_be_downloaded_and_verified_alone(nnit_zoo: Command) -> None:
    plan = json.loads(nnit_zoo("download", "--split", "unseen", "--dry-run", "--json")[1])
    assert (plan["files"], plan["missing"]) == (2, 2)
    assert nnit_zoo("download", "--split", "unseen,excluded")[0] == 0
    assert "2 of 4 shards" in nnit_zoo("list")[1]
    assert nnit_zoo("verify", "--split", "unseen")[0] == 0
    assert_error(nnit_zoo("verify"), "32-16-64-32.safetensors is missing")
    assert nnit_zoo("download", "--split", "seen,unseen", "--split", "excluded")[0] == 0
    assert nnit_zoo("verify")[0] == 0


def test_a_source_with_another_version_does_not_replace_the_zoo(
    nnit_zoo: Command, zoo_folder: Path, home: Path, tmp_path: Path
) -> None:
    assert nnit_zoo("download", "--source", str(zoo_folder))[:2] == (0, f"{home / 'nnit' / 'zoo' / 'PickCube-v1'}\n")
    manifest = files.Manifest.read(zoo_folder)
    manifest.shards.pop("16-16-16-32.safetensors")
    (zoo_folder / files.MANIFEST).write_bytes(manifest.to_bytes())
    assert_error(nnit_zoo("download", "--source", str(zoo_folder)), "another version of the zoo", "--folder")


def test_a_zoo_does_not_take_the_place_of_another_tasks(nnit_zoo: Command, zoo_folder: Path) -> None:
    manifest = files.Manifest.read(zoo_folder).model_copy(update={"task": "PushCube-v1"})
    (zoo_folder / files.MANIFEST).write_bytes(manifest.to_bytes())
    assert_error(nnit_zoo("download", "--folder", str(zoo_folder)), "holds the zoo of PushCube-v1", "another folder")


def playing(scores: dict[int, tuple[int, float]]) -> Callable[..., pa.Table]:
    """In the place of `Task.evaluate`: how many episodes of so many a policy loses, and its mean return."""

    def evaluate(
        task: object, policies: Sequence[PolicyBatch], seeds: Sequence[int], *, progress: Callable[[int], None]
    ) -> pa.Table:
        count, episodes = sum(map(len, policies)), len(seeds)
        lost, mean = scores[episodes]
        progress(count * episodes)
        columns = {
            "success_once": [1.0] * episodes,
            "success_at_end": [0.0] * lost + [1.0] * (episodes - lost),
            "return": [mean] * episodes,
        }
        numbers = [number for number in range(count) for _ in seeds]
        return pa.table({"policy": numbers} | {name: values * count for name, values in columns.items()})

    return evaluate


def test_deep_verification_scores_a_sample_anew(nnit_zoo: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    assert nnit_zoo("download")[0] == 0
    # the tiny zoo's index says 48 of 64 and a return of 38 for seed 0, 16 of 16 and 38 for seed 128
    scores = {64: (16, 38.0), 16: (0, 38.0)}
    monkeypatch.setattr(PickCube, "evaluate", playing(scores))
    code, stdout, stderr = nnit_zoo("verify", "--deep", "3", "--json")
    rescored = {row["id"]: row["agrees"] for row in json.loads(stdout)["rescored"]}
    assert code == 0
    assert rescored == {
        "PickCube-v1/32-16-64-32/000": True,
        "PickCube-v1/64-64-64-32/000": True,
        "PickCube-v1/16-16-16-32/128": True,
    }
    assert "scoring 3 policies: 144 of 144" in stderr
    scores |= {64: (18, 36.3), 16: (3, 31.0)}  # up to three episodes
    code, stdout, stderr = nnit_zoo("verify", "--deep", "20")
    assert code == 0 and "is sound" in stdout and "…" not in stdout
    assert "scoring 11 policies: 512 of 512" in stderr
    for wrong in ({16: (4, 38.0)}, {16: (0, 30.0)}):  # more than three
        monkeypatch.setattr(PickCube, "evaluate", playing(scores | wrong))
        code, stdout, _ = nnit_zoo("verify", "--deep", "3", "--json")
        assert json.loads(stdout)["problems"] == ["PickCube-v1/16-16-16-32/128 scores otherwise than the index says"]
    monkeypatch.setattr(PickCube, "evaluate", playing(scores | {64: (16, 36.0)}))
    assert_error(nnit_zoo("verify", "--deep", "3"), "PickCube-v1/32-16-64-32/000 scores", "64-64-64-32/000 scores")


def test_a_table_cuts_nothing_off(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    print_table(["id", "return"], [["x" * 100, "0.5"]])
    assert capsys.readouterr().out.count("x") == 100


def test_stats_are_printed_beside_the_papers_numbers(nnit_zoo: Command, tmp_path: Path) -> None:
    assert nnit_zoo("download")[0] == 0
    options = ("--architecture", "32-16-64-32", "--output", str(tmp_path / "figures"))
    code, stdout, stderr = nnit_zoo("stats", *options, "--json")
    assert code == 0, stderr
    rows = {row["measure"]: row for row in json.loads(stdout)["zoo"]}
    zoo = Zoo.open(places.default_folder("PickCube-v1"))
    batch = zoo.batch("32-16-64-32", "seen")
    expected = (batch.flat()[0].double() - batch.flat()[1].double()).norm()
    assert rows["nearest L2"]["32-16-64-32"] == pytest.approx(float(expected))
    assert rows["nearest L2"]["paper"] == 46.94
    for name in ("magnitudes.png", "pairs.png"):
        assert str(tmp_path / "figures" / name) in stderr
        assert (tmp_path / "figures" / name).is_file()
    by_default = nnit_zoo("stats")[1]  # the toy zoo has only one of those that are looked at by default
    assert by_default == nnit_zoo("stats", "--architecture", "32-16-64-32")[1]
    assert "46.940" in by_default
    assert_error(nnit_zoo("stats", "--architecture", "64-64-64-32"), "at least two policies")
    assert_error(nnit_zoo("stats", "--architecture", "64-64-64-33"), "64-64-64-3")


def test_export_and_card(nnit_zoo: Command, tmp_path: Path) -> None:
    assert nnit_zoo("download")[0] == 0
    output = tmp_path / "policy.safetensors"
    assert nnit_zoo("export", "PickCube-v1/32-16-64-32/001", str(output))[:2] == (0, f"{output}\n")
    assert output.is_file()
    assert nnit_zoo("export", "PickCube-v1", str(tmp_path / "set"))[0] == 0
    assert (tmp_path / "set" / "README.md").read_text() == nnit_zoo("card")[1]
    assert nnit_zoo("download", "--folder", str(tmp_path / "again"), "--source", str(tmp_path / "set"))[0] == 0
    assert json.loads(nnit_zoo("card", "--json")[1]) == json.loads(nnit_zoo("list", "--json")[1])


def test_a_full_disk_is_said_without_a_traceback(
    nnit_zoo: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    assert nnit_zoo("download")[0] == 0
    monkeypatch.setattr(export, "write_bytes", full)
    output = str(tmp_path / "policy.safetensors")
    result = nnit_zoo("export", "PickCube-v1/32-16-64-32/001", output)
    assert_error(result, f"cannot read or write {output}: No space left on device")


def test_an_output_that_is_something_else_is_said(nnit_zoo: Command, tmp_path: Path) -> None:
    assert nnit_zoo("download")[0] == 0
    file, folder, policy = tmp_path / "file", tmp_path / "folder.onnx", "PickCube-v1/32-16-64-32/001"
    file.touch()
    folder.mkdir()
    assert_error(nnit_zoo("export", policy, str(folder)), f"cannot read or write {folder}: Is a directory")
    for arguments in (
        ("export", policy, str(file / "policy.onnx")),
        ("export", "PickCube-v1", str(file)),
        ("stats", "--architecture", "32-16-64-32", "--output", str(file)),
    ):
        assert_error(nnit_zoo(*arguments), f"cannot read or write {file}")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder.onnx", "home"}


def test_a_task_without_success_has_no_such_columns(
    nnit_zoo: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_data_folder(tmp_path / "embedded" / "MNIST-PCA32", "MNIST-PCA32", 32, 10)
    monkeypatch.setattr(places, "DATA", tmp_path / "embedded")
    shown = nnit_zoo("show", "MNIST-PCA32")[1]
    assert "0.960" in shown and "success" not in shown
    assert "success" not in nnit_zoo("show", "MNIST-PCA32", "--architecture", "32-16-64-32")[1]
    assert json.loads(nnit_zoo("list", "--json")[1])[0]["splits"]["seen"]["success_at_end"] is None
    assert "| MNIST-PCA32 | seen | 2 | 3 | 64 |  | 0.96 |" in nnit_zoo("card")[1]
    assert nnit_zoo("download", "--task", "MNIST-PCA32")[0] == 0
    for score, code in ((0.96, 0), (0.9601, 2)):  # one of 10,000 digits: what is not simulated is exact
        monkeypatch.setattr(MNISTPCA32, "evaluate", playing({64: (0, score), 16: (0, score)}))
        assert nnit_zoo("verify", "--task", "MNIST-PCA32", "--deep", "3")[0] == code


def test_completion_knows_the_commands() -> None:
    script = app.generate_completion(shell="bash")
    assert "--source" in script and "stats" in script


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("download", "--revision", "v1"), ("--source",)),
        (("download", "--split", "seen,unsen"), ("unseen",)),
        (("download", "--split", ","), ("--split needs a name",)),
        (("download", "--task", "PickCub-v1"), ("PickCub-v1", "did you mean PickCube-v1?")),
        (("download", "--task", "PushCube-v1"), ("build it with: nnit-zoo build --task PushCube-v1",)),
        (("show", "PushCube-v1"), ("build it with: nnit-zoo build --task PushCube-v1",)),
        (("show", "--architecture", "32-16-64-33"), ("did you mean", "32-16-64-32")),
        (("download", "--fodler", "x"), ("--fodler", "--folder")),
        (("verify", "--deep", "-1"), ("--deep", "-1", ">= 0")),
        (("export", "PickCube-v1", "a.onnx"), ("is a whole zoo, which becomes a folder",)),
        (("verify", "--folder", "nowhere"), ("no zoo of PickCube-v1 in nowhere", "--folder nowhere")),
    ],
)
def test_mistakes_get_an_answer(nnit_zoo: Command, arguments: tuple[str, ...], parts: tuple[str, ...]) -> None:
    assert_error(nnit_zoo(*arguments), *parts)
