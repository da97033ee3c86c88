"""The `nnit-bench` command; heavy imports happen inside the commands, so that `--help` answers at once."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from nnit_bench.execution import Execution
from nnit_zoo.cli import run as run_application
from nnit_zoo.console import Json, Names, print_json
from nnit_zoo.errors import UserError

if TYPE_CHECKING:
    from nnit_bench.tables import Results
    from nnit_zoo.display import Display
    from nnit_zoo.tasks.task import Simulator, Task
    from nnit_zoo.zoo import Zoo

app = App(
    name="nnit-bench",
    help="Score generators of neural-network weights on the tasks of nnit-zoo.",
    version=lambda: version("nnit"),
    default_parameter=Parameter(negative=""),
)
app.register_install_completion_command(help="Set up completion in your shell.")
app.command(
    "nnit_bench.compare:compare",
    name="compare",
    help="Say whether two methods can be told apart, pairing their architectures and episodes.",
)
app.command(
    "nnit_bench.check:check",
    name="check",
    help="""Say whether a method keeps to the contract of a generator, on a tiny synthetic zoo, without a simulator.

    Exit code 1 means that it does not.
    """,
)
app.command(
    "nnit_bench.report:report",
    name="report",
    help="""Write all stored results as tables and figures: of every method its newest whole run on each task and split.

    Runs that ship with the project are among them, and marked.
    """,
)
app.command(
    "nnit_bench.paper:reproduce",
    name="reproduce",
    help="Print a table of the paper with our row under each of its rows, from stored runs.",
)


DEFAULT_EXECUTION = Execution()


@app.command
def run(
    *,
    method: Names = ("nnit",),
    task: Names = ("PickCube-v1",),
    split: Names = ("unseen",),
    policies: int | None = None,
    episodes: int | None = None,
    seed: int = 0,
    architecture: Names = (),
    protocol: Literal["paper", "heldout"] = "heldout",
    sim: Literal["fast", "stock", "stock-gpu"] = "fast",
    sampling_steps: int | None = None,
    checkpoint: str | None = None,
    execution: Annotated[Execution, Parameter(name="*")] = DEFAULT_EXECUTION,
    as_json: Json = False,
    quiet: bool = False,
) -> None:
    """Generate policies with a method, score them, and print the table.

    A finished run is kept under results/ and found again: the same command prints it at once. An interrupted one goes
    on where it stopped. For several names, repeat an option or use commas. Exit code 1 means that a run failed, 2 that
    the command makes no sense.

    Args:
        method: Name, package.module:Class or path/to/file.py:Class of a generator.
        task: The task to score on.
        split: The architectures to generate policies for: unseen, seen, excluded; joint, where the generator chooses
            them; or beyond the zoo's, offgrid, wide, deep, shallow.
        policies: Policies per architecture, or in all on joint; by default 10, and 100 in all on the seen split and on
            joint.
        episodes: Episodes per policy; by default the task's number, 50 for a robot task.
        seed: Seed of the generator's sampling.
        architecture: Only this architecture of the split, such as 32-32-16-64.
        protocol: How the ten best are scored: on the episodes that selected them, as in the paper, or on others as
            well.
        sim: What plays a robot task's episodes: ours, or plain ManiSkill on a CPU or a GPU (the last is untested).
        sampling_steps: Sampling steps, for a method that takes them.
        checkpoint: Checkpoint folder, or id on the Hugging Face Hub; by default the checkpoint that ships with nnit.
        execution: How it is done; none of this changes a number.
        as_json: Print JSON instead of tables.
        quiet: Print no progress and no notes.
    """
    from nnit_baselines import registry
    from nnit_bench import runner, tables
    from nnit_bench.protocol import Protocol
    from nnit_zoo.display import Display

    for name in method:
        runner.code_of(registry.get(name))  # a wrong name is told now, and what a file holds now is what counts
    if checkpoint is not None and len(method) * len(task) > 1:
        raise UserError("--checkpoint belongs to one --method and one --task")
    if execution.workers < 1:
        raise UserError(f"--workers must be 1 or more, not {execution.workers}")
    screen = Display(quiet)
    protocol_of = partial(
        Protocol.of, selection=protocol, policies=policies, only=architecture, episodes=episodes, seed=seed
    )
    tasks = [_task(name, sim) for name in task]
    protocols = {each: [protocol_of(each, name) for name in split] for each in tasks}
    if checkpoint is None and not any(registry.is_ready(name, each) for name in method for each in task):
        raise registry.no_checkpoint(method[0], task[0])
    zoos = {each: _zoo(each.name, screen) for each in tasks}
    results: list[tables.Results] = []
    errors: list[str] = []
    for scored, zoo in zoos.items():
        for wanted in protocols[scored]:
            outcomes: list[runner.Outcome] = []
            for name in method:
                with _noted(errors, f"{name} on {wanted.task}, {wanted.split}"):
                    entry = runner.enter(name, zoo, wanted, checkpoint=checkpoint, sampling_steps=sampling_steps)
                    outcomes.append(runner.run(scored, zoo, entry, wanted, execution, screen.stage))
            results.append(tables.Results(wanted, outcomes, runner.zoo_row(zoo.index, wanted)))
    if as_json:
        print_json({"tables": [tables.plain(each) for each in results], "errors": errors})
    else:
        _print(results, screen)
    if errors:
        sys.stderr.write("".join(f"error: {text}\n" for text in errors))
        sys.exit(1)


@app.command
def train(
    *,
    method: str = "nnit",
    task: str = "PickCube-v1",
    preset: str | None = None,
    steps: int | None = None,
    seed: int = 0,
    output: Path | None = None,
    trackio: str | None = None,
    quiet: bool = False,
) -> None:
    """Train a method on a task's zoo and write its checkpoint; after an interruption, the same command goes on.

    Args:
        method: Name, package.module:Class or path/to/file.py:Class of a generator.
        task: Name of the task.
        preset: The method's settings of this name, such as nnit's paper, instead of its default ones.
        steps: Optimiser steps, instead of the method's own number.
        seed: Seed of the training.
        output: Folder of the checkpoint; by default runs/METHOD/TASK.
        trackio: Project of trackio that the training's log also goes to, live; needs the extra `trackio`.
        quiet: Print no progress and no notes.
    """
    from nnit_baselines import training
    from nnit_baselines.generator import FitOptions
    from nnit_bench.protocol import check_seed
    from nnit_bench.records import folder_name
    from nnit_zoo import tasks
    from nnit_zoo.display import Display

    if steps is not None and steps < 1:
        raise UserError(f"--steps must be 1 or more, not {steps}")
    check_seed(seed)
    task = tasks.get(task).name
    generator = training.untrained(method, preset)  # a wrong name is told before the zoo is made
    folder = output or Path("runs") / folder_name(method) / task
    screen = Display(quiet)
    zoo = _zoo(task, screen)
    name = f"{folder_name(method)}-{task}-{seed}"
    with _tracking(trackio, name) as track, screen.steps(f"training {method}") as progress:
        options = FitOptions(steps=steps, seed=seed, folder=folder / "state", progress=progress, track=track)
        training.train(generator, zoo, options, folder, preset)
    sys.stdout.write(f"{folder}\n")
    screen.note(f"score it with: nnit-bench run --method {method} --task {task} --checkpoint {folder}")


@app.command
def render(
    *,
    method: str = "nnit",
    task: str = "PickCube-v1",
    split: str = "unseen",
    architecture: Names = (),
    policies: int = 1,
    episode_seed: int | None = None,
    seed: int = 0,
    checkpoint: str | None = None,
    output: Path = Path("renders"),
    quiet: bool = False,
) -> None:
    """Film generated policies at work: an MP4 of all side by side, and a PNG with a snapshot every ten steps.

    The episodes are those that `run` scores, replayed in ManiSkill. A machine without a GPU needs `make render-setup`.

    Args:
        method: Name, package.module:Class or path/to/file.py:Class of a generator.
        task: A robot task.
        split: The architectures to generate policies for, as of `run`.
        architecture: Only this architecture of the split, such as 32-32-16-64.
        policies: Policies per architecture, or in all on joint; by default the first that `run` scores.
        episode_seed: Seed of the episode, as in a run's episodes.parquet; by default the first that `run` scores.
        seed: Seed of the generator's sampling.
        checkpoint: Checkpoint folder, or id on the Hugging Face Hub; by default the checkpoint that ships with nnit.
        output: Folder of the pictures.
        quiet: Print no progress.
    """
    found = _task(task, "fast")  # before what the simulator's extra brings is imported

    from nnit_baselines import registry
    from nnit_bench import film, runner
    from nnit_bench.protocol import Protocol
    from nnit_bench.records import folder_name
    from nnit_zoo.atomic import write_bytes
    from nnit_zoo.display import Display
    from nnit_zoo.sim.render import camera

    screen = Display(quiet)
    robot = film.robot_task(found)
    if checkpoint is None and not registry.is_ready(method, robot.name):
        raise registry.no_checkpoint(method, robot.name)
    protocol = Protocol.of(robot, split, only=architecture, seed=seed)
    episode = protocol.select.first if episode_seed is None else episode_seed
    with camera(robot.name) as take:  # what cannot render is told before any other work
        zoo = _zoo(robot.name, screen)
        entry = runner.enter(method, zoo, protocol, checkpoint=checkpoint)
        chosen = film.choose(robot, entry, protocol, policies, screen.stage)
        scenes = []
        with screen.stage(f"{robot.name}: filming", len(chosen)) as advance:
            for title, policy in chosen:
                scenes.append(film.shoot(robot, policy, episode, title, take))
                advance(1)
    for suffix, make in ((".png", film.strip), (".mp4", film.video)):
        path = output / f"{robot.name}-{folder_name(method)}{suffix}"
        write_bytes(path, make(scenes))
        sys.stdout.write(f"{path}\n")


@app.command(name="list")
def list_names(*, as_json: Json = False) -> None:
    """List the methods and tasks, and which checkpoints and zoos ship with nnit."""
    from nnit_baselines import registry
    from nnit_zoo import places, tasks

    found = registry.available()
    methods = {name: [task for task in tasks.names() if registry.checkpoint(name, task)] for name in found}
    zoos = places.tasks_with_zoo()
    if as_json:
        print_json({"methods": methods, "tasks": tasks.names(), "zoos": zoos})
        return
    for name, shipped in methods.items():
        checkpoints = f"checkpoint for {', '.join(shipped)}" if shipped else "no checkpoint"
        kind = found[name]
        what = (kind.__doc__ or "").partition("\n")[0]
        sys.stdout.write(f"method  {name:12}  {checkpoints if kind.capabilities.checkpoint else 'needs no training'}\n")
        sys.stdout.write(f"{'':22}{what}\n")
    for name in tasks.names():
        zoo = "its zoo ships" if name in zoos else f"no zoo yet; nnit-zoo build --task {name} makes one"
        sys.stdout.write(f"task    {name:16}  {zoo}\n")


def main() -> None:
    """Entry point of `nnit-bench`."""
    # Before PyTorch's first operation: its kernels for AVX-512 round otherwise, and networks sampled on one processor
    # would not be the same as on another.
    os.environ.setdefault("ATEN_CPU_CAPABILITY", "avx2")
    run_application(app)


@contextmanager
def _noted(errors: list[str], what: str) -> Iterator[None]:
    """Note an error instead of stopping at it: other methods' work should not be lost to it."""
    try:
        yield
    except UserError as error:
        errors.append(f"{what}: {error}")
    except Exception as error:  # a crash, whose place the method's author needs
        traceback.print_exc()
        errors.append(f"{what}: {type(error).__name__}: {error}")


@contextmanager
def _tracking(project: str | None, name: str) -> Iterator[Callable[[dict[str, float]], None] | None]:
    """What takes a line of a training's log to the run `name` of a trackio project, which goes on if it is there."""
    if project is None:
        yield None
        return
    try:
        import trackio
    except ImportError:
        raise UserError("--trackio needs trackio; install it with: pip install 'nnit[trackio]'") from None
    with redirect_stdout(sys.stderr):  # where trackio talks; ours is for data
        trackio.init(project=project, name=name, resume="allow")
    try:
        yield lambda line: trackio.log({key: value for key, value in line.items() if key != "step"}, int(line["step"]))
    finally:
        with redirect_stdout(sys.stderr):
            trackio.finish()


def _task(name: str, simulator: Simulator) -> Task:
    from nnit_zoo import tasks

    task = tasks.get(name)
    if simulator != "fast":
        task = task.simulated_by(simulator)
    task.check_installed()
    return task


def _zoo(task: str, screen: Display) -> Zoo:
    """The task's zoo in its usual folder; made there first if it is not there, or is another version's."""
    import nnit_zoo
    from nnit_zoo.download import Download

    Download(task).ensure(screen)
    return nnit_zoo.load(task)


def _print(results: list[Results], screen: Display) -> None:
    from nnit_bench import tables

    for number, each in enumerate(results):
        if number:
            sys.stdout.write("\n")
        tables.show(each)
    for each in results:
        for outcome in each.outcomes:
            done = ", which had finished before; --overwrite always repeats it" if outcome.reused else ""
            screen.note(f"{outcome.record.method.name}: {outcome.folder}{done}")
