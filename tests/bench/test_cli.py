"""The `nnit-bench` command, from a fresh machine to the table, and the answers to mistakes."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import save_file

from nnit_bench import cli
from nnit_zoo import files, tasks
from nnit_zoo.architecture import hidden_widths
from nnit_zoo.build.ghn import GHN
from nnit_zoo.materialise import write_manifest

Call = Callable[..., int]
pytestmark = pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch) -> Call:
    """Runs a command line; gives its exit code."""

    def run(*arguments: str | Path) -> int:
        monkeypatch.setattr(sys, "argv", ["nnit-bench", *map(str, arguments)])
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return run


@pytest.fixture
def fresh(task: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with nnit and a task's embedded zoo, and nothing downloaded yet; gives the folder for results."""
    embedded = tmp_path / "embedded" / task.name
    embedded.mkdir(parents=True)
    ghns = [GHN(task.inputs, task.outputs, seed).state_dict() for seed in (0, 1)]
    stacked = {name: torch.stack([ghn[name] for ghn in ghns]).half().contiguous() for name in ghns[0]}
    metadata = {"task": task.name, "inputs": task.inputs, "outputs": task.outputs, "ghn_seeds": [0, 1]}
    save_file(stacked, embedded / "ghns.safetensors", {"nnit": json.dumps(metadata)})
    scores = {"success_once": 1.0, "success_at_end": 0.9, "return": 36.0, "episodes": 64, "kept": True}
    rows = [
        {"architecture": name, "ghn_seed": seed, "split": split, **scores}
        for split, names in {"seen": ["64-64-64-64"], "unseen": hidden_widths("unseen")}.items()
        for name in names
        for seed in (0, 1)
    ]
    pq.write_table(pa.Table.from_pylist(rows), embedded / "selection.parquet")
    write_manifest(embedded)
    monkeypatch.setattr(files, "EMBEDDED", embedded.parent)
    monkeypatch.setattr(files, "default_folder", lambda name: tmp_path / "cache" / name)
    monkeypatch.setattr(tasks, "get", lambda name: task)
    return tmp_path / "results"


def test_a_fresh_machine_gets_its_zoo_and_its_table(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", "--method", f"{plugin}:Zeros,crop", "--episodes", "4", "--policies", "2", "--output", fresh]
    assert call(*arguments) == 0
    out, err = capsys.readouterr()
    assert "making the zoo of Formula-v1" in err
    assert max(map(len, out.splitlines())) <= 80
    for word in ("Zeros", "crop", "zoo *", "90.0", "top-10", "16 policies, 8 architectures"):
        assert word in out
    records = [json.loads(path.read_text()) for path in fresh.rglob("run.json")]
    assert {record["status"] for record in records} == {"success"}

    assert call(*arguments) == 0
    again, err = capsys.readouterr()
    assert again == out
    assert "making the zoo" not in err and err.count("has finished before; --overwrite repeats it") == 2


def test_json_is_all_that_stdout_holds(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    method = f"{plugin}:Zeros"
    arguments = ["--episodes", "4", "--architecture", "32-32-16-64", "--output", fresh, "--json", "--quiet"]
    assert call("run", "--method", method, *arguments) == 0
    out, err = capsys.readouterr()
    printed = json.loads(out)
    assert err == ""
    assert printed["protocol"]["policies"] == {"32-32-16-64": 10}
    assert printed["runs"][0]["results"]["estimates"]["success_at_end"]["mean"] == {"value": 0, "low": 0, "high": 0}
    assert printed["zoo"]["results"]["estimates"]["return"]["worst"]["value"] == 36
    assert (Path(printed["runs"][0]["folder"]) / "episodes.parquet").is_file()


def test_a_changed_plug_in_is_run_again(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", "--method", f"{plugin}:Zeros", "--episodes", "2", "--policies", "1", "--output", fresh]
    assert call(*arguments) == 0
    plugin.write_text(plugin.read_text().replace("torch.zeros", "torch.ones"))
    assert call(*arguments) == 0
    assert "has finished before" not in capsys.readouterr().err
    assert len(list(fresh.rglob("run.json"))) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "PickCub-v1"], "no task named 'PickCub-v1': did you mean PickCube-v1?"),
        (["--method", "nit"], "no method named 'nit': did you mean nnit"),
        (["--architecture", "32-32-16-46"], "no architecture named '32-32-16-46': did you mean"),
        (["--architecture", "64-64-64-64"], "add --split seen"),
        (["--split", "unseeen"], "unseen"),
        (["--method", "nnit,crop", "--checkpoint", "folder"], "--checkpoint belongs to one --method"),
        (["--episodes", "0"], "--episodes must be from 1"),
        (["--workers", "0"], "--workers must be 1 or more"),
        (["--polices", "3"], "--polices"),
    ],
)
def test_mistakes_are_answered(
    call: Call, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("run", *arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ") and message in err and "Traceback" not in err


def test_a_damaged_shard_is_answered(
    call: Call, fresh: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--episodes", "2", "--policies", "1", "--output", fresh]
    assert call("run", "--method", "crop", *arguments) == 0
    shard = tmp_path / "cache" / "Formula-v1" / "64-64-64-64.safetensors"
    shard.write_bytes(shard.read_bytes()[:-1] + b"\x7f")
    assert call("run", "--method", "crop", "--seed", "1", *arguments) == 2
    assert "is missing or damaged; mend it with: nnit-zoo download --task Formula-v1" in capsys.readouterr().err


def test_list_names_methods_and_tasks(call: Call, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("list", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert {"nnit", "crop", "ghn-oracle"} <= set(listed["methods"])
    assert "PickCube-v1" in listed["tasks"]
