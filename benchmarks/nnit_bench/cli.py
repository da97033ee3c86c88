"""The `nnit-bench` command; heavy imports happen inside the commands, so that `--help` answers at once."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from nnit_zoo.architecture import Split
from nnit_zoo.cli import run as run_application
from nnit_zoo.errors import UserError

if TYPE_CHECKING:
    from nnit_bench.display import Display
    from nnit_bench.protocol import Protocol
    from nnit_bench.runner import Outcome, ZooRow
    from nnit_zoo.tasks.task import Task
    from nnit_zoo.zoo import Zoo

app = App(
    name="nnit-bench",
    help="Score generators of neural-network weights on the tasks of nnit-zoo.",
    version=lambda: version("nnit"),
    default_parameter=Parameter(negative=""),
)


Json = Annotated[bool, Parameter(name="--json")]
Names = Annotated[tuple[str, ...], Parameter(show_default=lambda names: ", ".join(names) or "all")]


@Parameter(name="*")
@dataclass(frozen=True)
class What:
    """What is scored; the defaults are the benchmark's."""

    method: Names = ("nnit",)
    """Name, package.module:Class or path/to/file.py:Class of a generator; for several, repeat it or use commas."""
    task: str = "PickCube-v1"
    """The task to score on."""
    split: Split = "unseen"
    """The architectures to generate policies for."""
    policies: int | None = None
    """Policies per architecture; by default 10, and on the seen split 100 spread over all."""
    episodes: int = 50
    """Episodes per policy."""
    seed: int = 0
    """Seed of the generator's sampling."""
    architecture: Names = ()
    """Only this architecture of the split, such as 32-32-16-64; may be repeated."""
    steps: int | None = None
    """Sampling steps, for a method that takes them."""
    checkpoint: str | None = None
    """Checkpoint folder, or id on the Hugging Face Hub; by default the checkpoint that ships with nnit."""


@Parameter(name="*")
@dataclass(frozen=True)
class How:
    """How it is done; none of this changes a number."""

    workers: int = 2
    """Processes that simulate."""
    output: Path = Path("results")
    """Folder of the result files."""
    overwrite: bool = False
    """Repeat a run even if an identical one has finished."""
    as_json: Json = False
    """Print JSON instead of the table."""
    quiet: bool = False
    """Print no progress and no notes."""


DEFAULT_WHAT, DEFAULT_HOW = What(), How()


@app.command
def run(*, what: What = DEFAULT_WHAT, how: How = DEFAULT_HOW) -> None:
    """Generate policies with a method, score them, and print the table.

    A finished run is kept under results/ and found again: the same command prints it at once.
    """
    from nnit_baselines import generator
    from nnit_bench import display, runner
    from nnit_zoo import tasks

    task = tasks.get(what.task)
    task.check_installed()
    methods = [name for text in what.method for name in text.split(",") if name]
    for name in methods:
        generator.get(name)  # a wrong name is told now, not after the work for the names before it
    if not methods or (what.checkpoint and len(methods) > 1):
        raise UserError("--checkpoint belongs to one --method" if methods else "--method needs a name")
    if how.workers < 1:
        raise UserError(f"--workers must be 1 or more, not {how.workers}")
    protocol = _protocol(task, what)
    screen = display.Display(how.quiet)
    zoo = _zoo(task.name, screen)
    outcomes = [_run_one(name, zoo, protocol, what, how, screen) for name in methods]
    zoo_row = runner.zoo_row(zoo.index, protocol)
    if how.as_json:
        _print_json(protocol, outcomes, zoo_row)
        return
    display.print_table(protocol, outcomes, zoo_row)
    for outcome in outcomes:
        screen.note(f"{outcome.record.method.name}: {outcome.folder}")


@app.command
def train(
    *,
    method: str = "nnit",
    task: str = "PickCube-v1",
    steps: int | None = None,
    seed: int = 0,
    output: Path | None = None,
) -> None:
    """Train a method on a task's zoo and write its checkpoint; after an interruption, the same command goes on.

    Args:
        method: Name, package.module:Class or path/to/file.py:Class of a generator.
        task: Name of the task.
        steps: Optimiser steps, instead of the method's own number.
        seed: Seed of the training.
        output: Folder of the checkpoint; by default runs/METHOD/TASK.
    """
    from nnit_baselines import generator, training
    from nnit_bench.display import Display
    from nnit_bench.records import folder_name
    from nnit_zoo import tasks

    task = tasks.get(task).name
    generator.get(method)
    folder = output or Path("runs") / folder_name(method) / task
    screen = Display(quiet=False)
    zoo = _zoo(task, screen)
    with screen.steps(f"training {method}") as progress:
        settings = generator.Run(steps=steps, seed=seed, folder=folder / "state", progress=progress)
        training.train(method, task, settings, folder, zoo.folder)
    sys.stdout.write(f"{folder}\n")
    screen.note(f"score it with: nnit-bench run --method {method} --task {task} --checkpoint {folder}")


@app.command(name="list")
def list_names(*, as_json: Json = False) -> None:
    """List the methods and tasks, and which checkpoints ship with nnit."""
    from nnit_baselines import generator
    from nnit_zoo import tasks

    methods = {name: [task for task in tasks.names() if generator.checkpoint(name, task)] for name in generator.names()}
    if as_json:
        _write_json({"methods": methods, "tasks": tasks.names()})
        return
    for name, shipped in methods.items():
        checkpoints = f"checkpoint for {', '.join(shipped)}" if shipped else "no checkpoint"
        needed = generator.get(name).capabilities.checkpoint
        sys.stdout.write(f"method  {name:12}  {checkpoints if needed else 'needs no training'}\n")
    for name in tasks.names():
        sys.stdout.write(f"task    {name}\n")


def main() -> None:
    """Entry point of `nnit-bench`."""
    run_application(app)


def _protocol(task: Task, what: What) -> Protocol:
    from nnit_bench.protocol import Protocol, policies_per_architecture

    return Protocol(
        task=task.name,
        task_version=task.version,
        split=what.split,
        policies=policies_per_architecture(what.split, what.policies, what.architecture),
        episodes=what.episodes,
        seed=what.seed,
    )


def _zoo(task: str, screen: Display) -> Zoo:
    """The task's zoo in its usual folder; made there first if it is not there, or is another version's."""
    import nnit_zoo
    from nnit_zoo import files
    from nnit_zoo.materialise import materialise

    source, target = files.embedded(task), files.default_folder(task)
    promised, found = source / files.MANIFEST, target / files.MANIFEST
    if not found.is_file() or found.read_bytes() != promised.read_bytes():
        screen.note(f"making the zoo of {task} in {target}, as nnit-zoo download does")
        with screen.stage("shards", len(files.Manifest.read(source).shards)) as advance:
            materialise(source, target, advance)
    return nnit_zoo.load(task)


def _run_one(name: str, zoo: Zoo, protocol: Protocol, what: What, how: How, screen: Display) -> Outcome:
    from nnit_baselines import generator
    from nnit_bench import records, runner
    from nnit_zoo import tasks
    from nnit_zoo.files import MANIFEST, sha256_of

    start = time.perf_counter()
    prepared = generator.prepare(name, zoo, protocol.split, what.checkpoint)
    if what.steps is not None:
        runner.set_steps(name, prepared, what.steps)
    entrant = runner.contestant(name, prepared, time.perf_counter() - start)
    code = records.this_code(type(prepared))
    identity = records.Identity(
        protocol=protocol,
        method=entrant.method,
        zoo_sha256=sha256_of(zoo.folder / MANIFEST),
        code_sha256=code.sha256,
        packages=records.numeric_packages(),
    )
    earlier = None if how.overwrite else runner.finished(identity, how.output)
    if earlier:
        screen.note(f"{name}: this run has finished before; --overwrite repeats it")
        return earlier
    task = tasks.get(protocol.task)
    return runner.run(task, entrant, identity, code, how.output, workers=how.workers, stage=screen.stage)


def _print_json(protocol: Protocol, outcomes: list[Outcome], zoo_row: ZooRow | None) -> None:
    from nnit_bench.records import plain

    _write_json(
        {
            "protocol": protocol.model_dump(mode="json"),
            "runs": [
                {"folder": str(outcome.folder), "reused": outcome.reused, **outcome.record.model_dump(mode="json")}
                for outcome in outcomes
            ],
            "zoo": zoo_row and {"episodes": zoo_row.episodes, "results": plain(zoo_row.summary)},
        }
    )


def _write_json(content: Any) -> None:
    sys.stdout.write(json.dumps(content, indent=2) + "\n")
