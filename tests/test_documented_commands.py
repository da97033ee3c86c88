"""Every command and Python example that README and docs give is run: page by page, in their order, at toy size.

`toy_size` cuts the work, and no command is changed; what ships (zoos, checkpoints) is made at that size too.
"""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import nnit_bench.cli
import nnit_zoo.cli
from nnit_baselines import generator, registry
from nnit_baselines.nnit import generator as nnit
from nnit_baselines.nnit.config import NNiTConfig
from nnit_bench import protocol, results
from nnit_zoo import parallel, places, tasks
from nnit_zoo.architecture import Architecture, hidden_widths
from nnit_zoo.build import builder, distill, expert, mnist, robot
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.build.mnist import MNISTConfig
from nnit_zoo.files import EXPERT
from nnit_zoo.places import data_folder
from nnit_zoo.sim import render
from nnit_zoo.stats import ARCHITECTURES
from nnit_zoo.tasks.mnist import FEATURES, MNISTPCA32
from nnit_zoo.tasks.pick_cube import PickCube
from nnit_zoo.tasks.push_cube import PushCube
from nnit_zoo.tasks.stack_cube_easy import StackCubeEasy
from nnit_zoo.tasks.task import PROBE
from stand_in_hub import Hub, serving

ROOT = Path(__file__).parents[1]
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text()
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
}
PROGRAMS = {"nnit-zoo": nnit_zoo.cli, "nnit-bench": nnit_bench.cli}
BLOCK = re.compile(r"^```(\S*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
NOT_RUN = {"", "toml", "{toctree}", "{eval-rst}"}  # output, and what tools read
INLINE = re.compile(r"`((?:nnit-zoo|nnit-bench) [^`]+)`")
GIVEN = {  # what a build would make first from the original digits, or by a training that PickCube-v1's shows
    "MNIST-PCA32": ("task.json", FEATURES),
    "PushCube-v1": ("task.json", EXPERT, PROBE),
    "StackCubeEasy-v1": ("task.json", EXPERT, PROBE),
}
FEW = {"seen": ("64-64-64-64", *ARCHITECTURES), "unseen": hidden_widths("unseen")[:2], "excluded": ("32-16-16-16",)}
RUN_ID = "0123456789ab"  # of a run that a page supposes to be there

pytestmark = [
    pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:mani_skill"),
]


def steps(page: str) -> list[tuple[str, str]]:
    """The commands and Python blocks of a page in order: `("sh", line)`, `("python", block)`."""
    found = []
    for language, block in BLOCK.findall(page):
        if language == "sh":
            found += [(language, line) for line in block.replace("\\\n", " ").splitlines() if line]
        elif language == "python":
            found.append((language, block))
    return found


def toy_size(patch: pytest.MonkeyPatch, ghns: int) -> None:
    """A few steps of training, two episodes, policies of two architectures, few GHNs; and no processes to wait for."""
    patch.setattr(parallel, "_in_processes", lambda work, units, workers: ((unit, work(unit)) for unit in units))
    for kind in (PickCube, PushCube, StackCubeEasy):
        patch.setattr(kind, "episodes", 2)
        patch.setattr(kind, "scoring_seeds", range(2))
    for kind in (PickCube, PushCube, StackCubeEasy, MNISTPCA32):
        patch.setattr(kind, "thresholds", dict.fromkeys(kind.thresholds, 0.0))  # nobody learns much
    patch.setattr(protocol, "policies_per_architecture", partial(few_policies, protocol.policies_per_architecture))
    patch.setattr(generator, "FitOptions", partial(few_training_steps, generator.FitOptions))
    patch.setattr(nnit, "NNiTConfig", ToyNNiT)

    patch.setattr(expert, "EVALUATION_SEEDS", range(2))
    patch.setattr(builder, "architectures", few_architectures)
    few_steps = {"total_steps": 200, "environments": 2, "hidden": 16, "epochs": 1, "minibatch": 50}
    patch.setattr(robot, "ExpertConfig", partial(ExpertConfig, **few_steps, evaluate_every=1))
    few_steps = {"rounds": 1, "episodes_per_round": 2, "round_steps": 2, "own_episodes": 2, "steps": 3}
    patch.setattr(distill, "CONFIG_BY_TASK", {})
    patch.setattr(robot, "DistillConfig", partial(DistillConfig, **few_steps, architectures_per_step=2))
    patch.setattr(mnist, "MNISTConfig", partial(MNISTConfig, steps=3, states_per_architecture=8))
    start = builder.Builder.__init__
    patch.setattr(
        builder.Builder,
        "__init__",
        lambda self, task, work, seeds, *rest: start(self, task, work, min(seeds, ghns), *rest),
    )


class ToyNNiT(NNiTConfig):
    width: int = 32
    depth: int = 1
    sampling_steps: int = 2


def few_training_steps(kind, **options):
    return kind(**options | {"steps": 2})


def few_policies(per_architecture, split, each, only):
    """One policy of each of two architectures; of those that are named, the four that a film shows."""
    found = list(per_architecture(split, each, only).items())[:2]
    return {name: min(count, 4 if only else 1) for name, count in found}


def few_architectures(split, inputs, outputs):
    return tuple(Architecture.parse(text, inputs, outputs) for text in FEW[split])


def call(command: str, patch: pytest.MonkeyPatch) -> int:
    """Run a command line of ours in this process; gives its exit code."""
    program, *arguments = shlex.split(command, comments=True)
    patch.setattr(sys, "argv", [program, *arguments])
    try:
        PROGRAMS[program].main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """What ships with nnit, at toy size: `zoos` and `checkpoints`; and a downloaded zoo."""
    place = tmp_path_factory.mktemp("shipped")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        toy_size(patch, ghns=3)  # a page has GHN seed 2
        for task, names in GIVEN.items():
            (place / "zoos" / task).mkdir(parents=True)
            for name in names:
                shutil.copy(data_folder(task) / name, place / "zoos" / task)
        patch.setattr(places, "DATA", place / "zoos")
        tasks.get.cache_clear()  # a task keeps the record that it has read
        patch.setattr(places, "CACHE", place / "cache")
        for task in ("PickCube-v1", *GIVEN):
            assert call(f"nnit-zoo build --task {task}", patch) == 0
        for task in ("PickCube-v1", *GIVEN):
            assert call(f"nnit-bench train --task {task} --output checkpoints/nnit/{task} --quiet", patch) == 0
        zoo = places.default_folder("PickCube-v1")
    yield SimpleNamespace(zoos=place / "zoos", checkpoints=place / "checkpoints", zoo=zoo)
    tasks.get.cache_clear()


@pytest.fixture
def machine(shipped, tmp_path, monkeypatch):
    """A machine with nnit and nothing else, at toy size; gives the working folder."""
    toy_size(monkeypatch, ghns=2)
    shutil.copytree(shipped.zoos, tmp_path / "zoos")  # where `nnit-zoo build` writes, too
    monkeypatch.setattr(places, "DATA", tmp_path / "zoos")
    tasks.get.cache_clear()
    monkeypatch.setattr(places, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(registry, "CHECKPOINTS", shipped.checkpoints)
    find = results.find
    monkeypatch.setattr(results, "find", lambda folders: find(set(folders) - {results.SHIPPED}))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return work


@pytest.fixture
def hub(shipped, monkeypatch):
    """The stand-in for the Hub, with the toy zoo in the data set `owner/name`."""
    server = Hub()
    server.files["owner/name"] = {f"PickCube-v1/{path.name}": path.read_bytes() for path in shipped.zoo.iterdir()}
    with serving(server, monkeypatch):
        yield server


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if steps(text)])
def test_what_a_page_says_works(page, machine, hub, monkeypatch, capsys):
    monkeypatch.setattr(render, "camera", blank_pictures)  # real ones are a slow test's
    for language, text in steps(PAGES[page]):
        if language == "python":
            run_python(text, machine, monkeypatch)
        elif text.startswith("make "):
            # Not for real: `bench` is `nnit-bench run`, and the others are this suite, the docs' test and a download.
            subprocess.run(["make", "--dry-run", *shlex.split(text, comments=True)[1:]], cwd=ROOT, check=True)
        elif "--parallel ray" not in text:  # that is a slow test's
            prepare(text, machine)
            check(text, call(text, monkeypatch), *capsys.readouterr())


def run_python(block, machine, patch):
    """A method goes to the file that the page calls it, and into the package of another example; the rest is run."""
    if "(Generator)" not in block:
        exec(compile(block, "example", "exec"), {"__name__": "__main__"})
        return
    (machine / "my_method.py").write_text(block)
    (machine / "my_package").mkdir()
    (machine / "my_package" / "module.py").write_text(re.sub(r"^class \w+", "class Class", block, flags=re.MULTILINE))
    for name in ("my_package", "my_package.module"):
        patch.delitem(sys.modules, name, raising=False)


def prepare(command, machine):
    """What a command supposes: a run of a certain id; a download from a source is one of everything."""
    if RUN_ID in command:
        (folder,) = (Path(word).parent for word in shlex.split(command) if RUN_ID in word)
        next(folder.iterdir()).rename(folder / RUN_ID)
    if "--source" in command:
        shutil.rmtree(machine.parent / "cache")


def check(command, code, out, err):
    """It succeeds, and prints something or writes the file that it names."""
    assert code == 0, f"{command}\n{err}"
    if command.startswith("nnit-zoo build"):
        assert "candidates of seen architectures pass" in err, command
    else:
        assert out.strip(), f"{command} prints nothing"
    *_, last = shlex.split(command, comments=True)
    if "--output" in command or " export " in command:
        assert Path(last).exists(), f"{command} does not write {last}"


@contextmanager
def blank_pictures(task):
    yield lambda seed, actions, rewards: np.zeros((len(actions) + 1, render.SIZE, render.SIZE, 3), np.uint8)


def commands_with(text):
    return [command for page in PAGES.values() for _, command in steps(page) if text in command]


@pytest.mark.slow
@pytest.mark.parametrize("command", commands_with("nnit-bench render"))
def test_rendering_works_or_says_what_is_missing(command, machine, monkeypatch, capsys):
    code, (out, err) = call(command, monkeypatch), capsys.readouterr()
    if render.driver().is_file() or code == 0:  # the system may have a driver too
        check(command, code, out, err)
        assert all(Path(line).stat().st_size > 10_000 for line in out.splitlines())
    else:
        assert code == 2 and "nothing here can render" in err and str(render.SETUP) in err


@pytest.mark.slow
@pytest.mark.skipif(not importlib.util.find_spec("ray"), reason="needs Ray")
@pytest.mark.parametrize("command", commands_with("--parallel ray"))
def test_ray_works(command, machine, monkeypatch, capsys):
    import ray

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(num_cpus=2, log_to_driver=False)
    try:
        check(command, call(command, monkeypatch), *capsys.readouterr())
    finally:
        ray.shutdown()


@pytest.mark.parametrize("page", PAGES)
def test_no_block_is_left_out(page):
    assert {language for language, _ in BLOCK.findall(PAGES[page])} <= {"sh", "python", *NOT_RUN}


@pytest.mark.parametrize("command", sorted({each for page in PAGES.values() for each in INLINE.findall(page)}))
def test_a_command_in_the_text_parses(command):
    program, name, *options = shlex.split(command)
    app = PROGRAMS[program].app
    assert name in app
    if options:
        app.parse_args([name, *options], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("target", sorted(set(re.findall(r"(?:`|^)make ([a-z-]+)", "".join(PAGES.values()), re.M))))
def test_a_make_target_in_the_text_exists(target):
    subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, check=True)
