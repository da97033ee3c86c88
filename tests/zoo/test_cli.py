from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from nnit_zoo.cli import main

Result = tuple[int, str, str]
Command = Callable[..., Result]


@pytest.fixture
def nnit_zoo(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs `nnit-zoo` with the tests' own embedded zoo and cache: (exit code, stdout, stderr)."""

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
    assert stderr.startswith("error: ")
    for part in parts:
        assert part in stderr


def in_its_own_process(*arguments: str) -> Result:
    code = f"import sys; sys.argv = {['nnit-zoo', *arguments]}\nfrom nnit_zoo.cli import main\nmain()"
    command = [sys.executable, "-X", "importtime", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    return result.returncode, result.stdout, result.stderr


@pytest.mark.parametrize(("option", "expected"), [("--help", "download"), ("--version", version("nnit"))])
def test_help_and_version_import_nothing_heavy(option: str, expected: str) -> None:
    code, stdout, stderr = in_its_own_process(option)
    assert code == 0
    assert expected in stdout
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in stderr.splitlines()}
    assert "cyclopts" in imported
    assert not imported & {"torch", "numpy", "pyarrow", "mani_skill", "sapien", "huggingface_hub", "pydantic"}


@pytest.mark.parametrize("arguments", [("download", "--task", "NoSuchTask"), ("download", "--fodler", "x")])
def test_a_mistake_exits_with_2_and_no_traceback(arguments: tuple[str, ...]) -> None:
    code, stdout, stderr = in_its_own_process(*arguments)
    assert (code, stdout) == (2, "")
    assert stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in stderr


def test_list_and_show_need_no_download(nnit_zoo: Command) -> None:
    (zoo,) = json.loads(nnit_zoo("list", "--json")[1])
    assert (zoo["task"], zoo["policies"], zoo["downloaded"]) == ("PickCube-v1", 11, False)
    assert zoo["splits"]["seen"]["policies"] == 3
    assert "PickCube-v1" in nnit_zoo("list")[1]
    assert json.loads(nnit_zoo("show", "PickCube-v1", "--json")[1]) == zoo
    assert "heldout_seed" in nnit_zoo("show")[1]
    policies = json.loads(nnit_zoo("show", "--architecture", "64-64-64-32", "--json")[1])
    assert [policy["id"] for policy in policies] == ["PickCube-v1/64-64-64-32/000", "PickCube-v1/64-64-64-32/128"]


def test_download_then_verify_then_mend(nnit_zoo: Command, home: Path) -> None:
    folder = home / "nnit" / "zoo" / "PickCube-v1"
    assert_error(nnit_zoo("verify"), "no zoo of PickCube-v1", "nnit-zoo download --task PickCube-v1")
    assert "5 of 5 files to write" in nnit_zoo("download", "--dry-run")[1]
    assert not folder.exists()

    assert nnit_zoo("download", "--task", "PickCube-v1")[:2] == (0, f"{folder}\n")
    assert "0 of 5 files to write" in nnit_zoo("download", "--dry-run")[1]
    assert "4 shards" in nnit_zoo("verify")[1]
    assert json.loads(nnit_zoo("list", "--json")[1])[0]["downloaded"]

    (folder / "16-16-16-32.safetensors").write_bytes(b"")
    code, stdout, _ = nnit_zoo("verify", "--json")
    assert code == 2
    assert "16-16-16-32.safetensors" in json.loads(stdout)["problems"][0]
    assert_error(nnit_zoo("verify"), "16-16-16-32.safetensors", "mend it with: nnit-zoo download --task PickCube-v1\n")
    assert nnit_zoo("download")[0] == 0
    assert json.loads(nnit_zoo("verify", "--json")[1])["problems"] == []


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("download", "--task", "PickCub-v1"), ("PickCub-v1", "did you mean PickCube-v1?")),
        (("show", "--architecture", "32-16-64-33"), ("did you mean", "32-16-64-32")),
        (("download", "--fodler", "x"), ("--fodler", "--folder")),
        (("verify", "--folder", "nowhere"), ("no zoo of PickCube-v1 in nowhere", "--folder nowhere")),
    ],
)
def test_mistakes_get_an_answer(nnit_zoo: Command, arguments: tuple[str, ...], parts: tuple[str, ...]) -> None:
    assert_error(nnit_zoo(*arguments), *parts)
