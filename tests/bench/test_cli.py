"""The `nnit-bench` command, from a fresh machine to the table, and the answers to mistakes."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from nnit_baselines import registry
from nnit_baselines.nnit.config import PRESETS, NNiTConfig
from nnit_bench import cli, runner
from nnit_bench.provenance import this_code
from nnit_zoo import places, tasks
from nnit_zoo.architecture import hidden_widths
from nnit_zoo.errors import UserError
from nnit_zoo.files import MANIFEST

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
def fresh(task: Any, embed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with nnit and a task's embedded zoo, and nothing downloaded yet; gives the folder for results."""
    embedded = tmp_path / "embedded" / task.name
    embed(embedded, task, [0, 1], {"seen": ["64-64-64-64"], "unseen": hidden_widths("unseen")})
    monkeypatch.setattr(places, "DATA", embedded.parent)
    monkeypatch.setattr(places, "default_folder", lambda name: tmp_path / "cache" / name)
    get = tasks.get
    monkeypatch.setattr(tasks, "get", lambda name: task if name == task.name else get(name))
    return tmp_path / "results"


def as_in_a_new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the plug-ins that this process has loaded, and what it knows of their code."""
    for name in [name for name in sys.modules if name.startswith((registry.FILE_MODULE, "my_"))]:
        monkeypatch.delitem(sys.modules, name)
    this_code.cache_clear()


def test_a_fresh_machine_gets_its_zoo_and_its_table(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    what = ["--task", "Formula-v1", "--episodes", "4", "--policies", "2", "--output", fresh]
    arguments = ["run", "--method", f"{plugin}:Zeros,crop", *what]
    assert call(*arguments) == 0
    out, err = capsys.readouterr()
    assert "making the zoo of Formula-v1" in err
    assert max(map(len, out.splitlines())) <= 80
    for word in ("Zeros", "crop", "zoo *", "90.0", "top-10", "16 policies, 8 architectures", "copies"):
        assert word in out
    records = [json.loads(path.read_text()) for path in fresh.rglob("run.json")]
    assert {record["status"] for record in records} == {"success"}

    assert call(*arguments) == 0
    again, err = capsys.readouterr()
    assert again == out
    assert "making the zoo" not in err and err.count("finished before; --overwrite always repeats it") == 2

    assert call("compare", "crop", next(fresh.glob("*/*/*Zeros/*")), *what[:2], "--results", fresh) == 0
    assert "my_method.py:Zeros cannot be told apart in mean success at end" in capsys.readouterr().out
    assert call("compare", "crop", "crop", *what[:2], "--results", fresh, "--json") == 0
    compared = json.loads(capsys.readouterr().out)
    assert [Path(folder).parent.name for folder in compared["folders"]] == ["crop", "crop"]
    first = compared["differences"][0]
    assert (first["metric"], first["statistic"], first["separable"]) == ("success_at_end", "mean", False)
    assert first["difference"] == {"value": 0, "low": 0, "high": 0}
    statistics = {each["statistic"] for each in compared["differences"]}
    assert statistics == {"mean", "top", "top_heldout"}


def test_several_splits_and_what_a_method_cannot(call: Call, fresh: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--task", "Formula-v1", "--episodes", "2", "--policies", "1", "--output", fresh, "--quiet"]
    assert call("run", "--method", "ghn-oracle", "--split", "unseen,joint", *arguments) == 0
    out, err = capsys.readouterr()
    assert "Formula-v1, unseen: 8 policies" in out and "Formula-v1, joint: 1 policy, its own" in out
    assert "ghn-oracle: does not choose architectures" in out and "unsupported" in out
    assert err == ""


def test_json_is_all_that_stdout_holds(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    what = ["--task", "Formula-v1", "--episodes", "4", "--architecture", "32-32-16-64", "--protocol", "paper"]
    assert call("run", "--method", f"{plugin}:Zeros", *what, "--output", fresh, "--json", "--quiet") == 0
    out, err = capsys.readouterr()
    (printed,) = json.loads(out)["tables"]
    assert err == ""
    assert printed["protocol"]["policies"] == {"32-32-16-64": 10} and printed["protocol"]["report"] is None
    mean = printed["runs"][0]["results"]["estimates"]["success_at_end"]["mean"]
    assert mean["value"] == mean["low"] == 0 and mean["high"] == pytest.approx(1 - 0.025 ** (1 / 4))
    assert printed["zoo"]["estimates"]["return"]["worst"]["value"] == 36
    assert (Path(printed["runs"][0]["folder"]) / "episodes.parquet").is_file()


def test_a_changed_plug_in_is_run_again(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So is one with a change in a file beside it that it imports, and only such a one."""
    beside = plugin.parent / "my_folder" / "my_helper.py"  # Python needs no __init__.py there
    beside.parent.mkdir()
    (plugin.parent / "torch").mkdir()  # nor does it take a folder of results for a package
    changes = (
        lambda: beside.write_text("BIAS = 0\n"),
        lambda: beside.write_text("BIAS = 1.0\n"),  # of another length, or Python may take the old bytecode for it
        lambda: plugin.write_text(plugin.read_text().replace("BIAS +", "2 * BIAS +")),
        lambda: (plugin.parent / "another.py").write_text("BIAS = 3\n"),
    )
    plugin.write_text(
        "from my_folder.my_helper import BIAS\n" + plugin.read_text().replace("torch.zeros(", "BIAS + torch.zeros(")
    )
    returns = []
    for change in changes:
        change()
        as_in_a_new_process(monkeypatch)
        what = ["--task", "Formula-v1", "--episodes", "2", "--policies", "1", "--output", fresh, "--json"]
        assert call("run", "--method", f"{plugin}:Zeros", *what) == 0
        (run,) = json.loads(capsys.readouterr().out)["tables"][0]["runs"]
        returns.append((run["results"]["estimates"]["return"]["mean"]["value"], run["reused"]))
    assert returns == [(0, False), (40, False), (80, False), (80, True)]


def test_what_a_plug_ins_files_held_when_the_command_began_is_what_counts(
    plugin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (plugin.parent / "my_helper.py").write_text("BIAS = 0\n")
    plugin.write_text("from my_helper import BIAS\n" + plugin.read_text())
    as_in_a_new_process(monkeypatch)
    kind = registry.get(f"{plugin}:Zeros")
    before = runner.code_of(kind)
    for path in plugin.parent.glob("my_*.py"):
        path.write_text(path.read_text() + "NEW = 1\n")
    assert registry.get(f"{plugin}:Zeros") is kind and runner.code_of(kind) == before
    as_in_a_new_process(monkeypatch)
    assert runner.code_of(registry.get(f"{plugin}:Zeros")) != before


def test_a_plug_in_is_not_scored_with_the_code_of_another(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Copies of an experiment's folder have files of the same names."""
    addresses = []
    for scale in (1, 2):
        copy = plugin.parent / str(scale) / plugin.name
        copy.parent.mkdir()
        (copy.parent / "its_scale.py").write_text(f"SCALE = {scale}\n")
        copy.write_text("from its_scale import SCALE\n" + plugin.read_text())
        addresses.append(f"{copy}:Zeros")
    what = ["--task", "Formula-v1", "--episodes", "2", "--policies", "1", "--output", fresh]
    assert call("run", "--method", ",".join(addresses), *what) == 2
    assert "its_scale.py of that name is loaded; use a command for each of them" in capsys.readouterr().err
    assert not fresh.exists()


def test_a_crash_in_a_plug_in_does_not_cost_the_others(
    call: Call, fresh: Path, plugin: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plugin.write_text(plugin.read_text().replace("torch.zeros", "torch.zeroes"))
    what = ["--task", "Formula-v1", "--episodes", "2", "--policies", "1", "--output", fresh, "--quiet"]
    assert call("run", "--method", f"{plugin}:Zeros,crop", *what) == 1
    out, err = capsys.readouterr()
    assert "crop" in out and f'File "{plugin}", line' in err
    why = "AttributeError: module 'torch' has no attribute 'zeroes'"
    assert err.splitlines()[-1].endswith(why)
    assert call("run", "--method", f"{plugin}:Zeros,crop", *what, "--json") == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["errors"] == [f"{plugin}:Zeros on Formula-v1, unseen: {why}"]
    assert [run["method"]["name"] for run in printed["tables"][0]["runs"]] == ["crop"]


def test_one_failure_does_not_cost_the_others(
    call: Call,
    fresh: Path,
    plugin: Path,
    task: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The first method's episodes cannot be played; the second one's can, and the exit code tells."""
    evaluate, calls = task.evaluate, iter([True])

    def broken_once(*arguments: Any, **options: Any) -> Any:
        if next(calls, False):
            raise UserError("the simulator is on fire")
        return evaluate(*arguments, **options)

    monkeypatch.setattr(task, "evaluate", broken_once)
    what = ["--task", "Formula-v1", "--episodes", "2", "--policies", "1", "--output", fresh, "--quiet"]
    assert call("run", "--method", f"crop,{plugin}:Zeros", *what) == 1
    out, err = capsys.readouterr()
    assert err == "error: crop on Formula-v1, unseen: the simulator is on fire\n"
    assert "Zeros" in out and "crop" not in out
    statuses = {path.parts[-3]: json.loads(path.read_text())["status"] for path in fresh.rglob("run.json")}
    assert sorted(statuses.values()) == ["failed", "success"] and statuses["crop"] == "failed"


def test_options_reach_the_work(
    call: Call, fresh: Path, task: Any, generator: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, evaluate = [], task.evaluate

    def note(*arguments: Any, **options: Any) -> Any:
        asked.append((options["workers"], options["parallel"]))
        return evaluate(*arguments, **options)

    monkeypatch.setattr(task, "evaluate", note)
    monkeypatch.setattr(registry, "get", lambda name: type(generator))
    monkeypatch.setattr(registry, "is_ready", lambda *what: True)
    monkeypatch.setattr(registry, "prepare", lambda *how: generator)
    how = ["--workers", "3", "--parallel", "ray", "--sampling-steps", "2", "--protocol", "paper"]
    what = ["run", "--task", "Formula-v1", "--episodes", "2", "--policies", "1", *how, "--output", fresh, "--quiet"]
    assert call(*what) == 0
    assert asked == [(3, "ray")] and generator.sampling_steps == 2
    assert call(*what) == 0
    assert len(asked) == 1
    assert call(*what, "--overwrite", "always") == 0
    assert len(asked) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "PickCub-v1"], "no task named 'PickCub-v1': did you mean PickCube-v1"),
        (["--method", "nit"], "no method named 'nit': did you mean nnit"),
        (["--architecture", "32-32-16-46"], "no architecture named '32-32-16-46': did you mean"),
        (["--architecture", "64-64-64-64"], "use --split seen"),
        (["--split", "unseeen"], "no split named 'unseeen': did you mean unseen"),
        (["--method", "nnit,crop", "--checkpoint", "folder"], "--checkpoint belongs to one --method"),
        (["--method", "nnit,crop", "--checkpoint", ""], "--checkpoint belongs to one --method"),
        (["--episodes", "0"], "is scored on 1 to"),
        (["--policies", "0"], "--policies must be 1 or more"),
        (["--workers", "0"], "--workers must be 1 or more"),
        (["--task", "MNIST-PCA32", "--sim", "stock"], "MNIST-PCA32 is not simulated: leave --sim stock out"),
        (["--overwrite", "sometimes"], "--overwrite"),
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


@pytest.mark.parametrize("command", [("run", "--method", "nnit,nnit"), ("render", "--method", "nnit")])
def test_a_method_that_must_be_trained_first_is_told_before_any_work(
    call: Call, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(registry, "CHECKPOINTS", Path("none"))
    monkeypatch.setattr(cli, "_zoo", Mock(side_effect=AssertionError))
    assert call(*command, "--task", "StackCubeEasy-v1") == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "train one with: nnit-bench train --method nnit --task StackCubeEasy-v1" in told


def test_what_needs_no_training_takes_no_checkpoint(
    call: Call, fresh: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("run", "--task", "Formula-v1", "--method", "crop", "--checkpoint", "mine", "--output", fresh) == 1
    assert "crop has no checkpoint, as it needs no training: leave --checkpoint out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "crop"], "crop needs no training; run: nnit-bench run --method crop"),
        (["--preset", "papers"], "no preset of nnit named 'papers'"),
        (["--seed", "-1"], "--seed must be from 0 to 2147483647, not -1"),
    ],
)
def test_a_training_that_cannot_be_is_refused_before_any_work(
    call: Call, fresh: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("train", "--task", "Formula-v1", "--output", fresh, *arguments) == 2
    err = capsys.readouterr().err
    assert message in err and "making the zoo" not in err


def test_a_damaged_shard_is_answered(
    call: Call, fresh: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    what = ["--task", "Formula-v1", "--episodes", "2", "--policies", "1", "--output", fresh]
    assert call("run", "--method", "crop", *what) == 0
    shard = tmp_path / "cache" / "Formula-v1" / "64-64-64-64.safetensors"
    shard.write_bytes(shard.read_bytes()[:-1] + b"\x7f")
    assert call("run", "--method", "crop", "--seed", "1", *what) == 1
    assert "is missing or damaged; mend it with: nnit-zoo download --task Formula-v1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "offered"), [("nnit-bench re", {"render", "report", "reproduce"}), ("run --met", {"--method"})]
)
def test_completion_is_installed_and_completes(
    call: Call, typed: str, offered: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert call("--install-completion", "--shell", "bash") == 0
    words = ["nnit-bench", *typed.removeprefix("nnit-bench ").split()]
    ask = f"source ~/.bashrc; COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}"
    ask += "; $(complete -p nnit-bench | sed 's/.*-F //; s/ .*//'); echo ${COMPREPLY[@]}"
    answer = subprocess.run(["bash", "--norc", "-c", ask], capture_output=True, text=True, check=True)
    assert set(answer.stdout.split()) == offered


def test_list_names_methods_and_tasks(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "PickCube-v1").mkdir()
    (tmp_path / "PickCube-v1" / MANIFEST).touch()
    monkeypatch.setattr(places, "DATA", tmp_path)
    assert call("list", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert {"nnit", "crop", "ghn-oracle"} <= set(listed["methods"])
    assert {"PickCube-v1", "StackCubeEasy-v1"} <= set(listed["tasks"])
    assert listed["zoos"] == ["PickCube-v1"]
    assert call("list") == 0
    of_task = [line.split(maxsplit=2)[2] for line in capsys.readouterr().out.splitlines() if line.startswith("task")]
    assert of_task[0] == "its zoo ships"
    assert of_task[1] == "no zoo yet; nnit-zoo build --task PushCube-v1 makes one"


def test_a_training_follows_its_options_and_is_tracked_live(
    call: Call, fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against trackio's own names and arguments."""
    calls: list[Any] = []

    def init(project: str, name: str | None = None, resume: str = "never") -> None:
        calls.append((project, name, resume))

    def log(metrics: dict[str, float], step: int | None = None) -> None:
        calls.append((step, metrics["loss"] > 0, "step" in metrics))

    stand_in = SimpleNamespace(init=init, log=log, finish=lambda: calls.append("finish"))
    monkeypatch.setitem(sys.modules, "trackio", stand_in)
    small = NNiTConfig(width=16, depth=1, heads=1, batch=2, sampling_steps=2)
    monkeypatch.setitem(PRESETS, "small", small)
    what = ["--task", "Formula-v1", "--preset", "small", "--steps", "1", "--seed", "3", "--trackio", "mine"]
    assert call("train", *what, "--output", tmp_path / "trained") == 0
    assert calls == [("mine", "nnit-Formula-v1-3", "allow"), (1, True, False), "finish"]
    config = json.loads((tmp_path / "trained" / "config.json").read_text())
    assert config["settings"] == small.model_dump() | {"steps": 1}
    facts = config["training"]
    assert (facts["seed"], facts["steps"], facts["preset"]) == (3, 1, "small")
    assert (tmp_path / "trained" / "state" / "state.pt").is_file()


def test_what_needs_no_training_is_not_trained(call: Call, fresh: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("train", "--method", "crop", "--task", "Formula-v1") == 2
    assert "crop needs no training; run: nnit-bench run --method crop" in capsys.readouterr().err


def test_tracking_without_trackio_says_how_to_get_it(
    call: Call, fresh: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "trackio", None)
    assert call("train", "--task", "Formula-v1", "--trackio", "mine") == 2
    assert "pip install 'nnit[trackio]'" in capsys.readouterr().err
