"""The `nnit-zoo` command; heavy imports happen inside the commands, so that `--help` answers at once."""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, CycloptsError, Parameter
from cyclopts.validators import Number

from nnit_zoo.console import SEVERAL, Json, Names, print_json, print_rows, print_table
from nnit_zoo.errors import UserError

app = App(
    name="nnit-zoo",
    help="List, fetch, check and build zoos of small policies.",
    version=lambda: version("nnit"),
    default_parameter=Parameter(negative=""),
)
app.register_install_completion_command(help="Set up completion in your shell.")
app.command(
    "nnit_zoo.build.command:build",
    name="build",
    help="""Build a task's zoo: what its GHNs learn from, a GHN per seed, every candidate's scores, and those that pass.

    The last stage, pack, puts the zoo into the package, in place of the one that is there. Run the command again after
    a kill, at any moment, and it goes on. With --stage, only that stage. The stage twins is not part of all: it makes
    nothing for the zoo, but NNiT's comparison of networks from GHNs with others, for stats.
    """,
)

Splits = Annotated[tuple[Literal["seen", "unseen", "excluded", "heldout_seed"], ...], SEVERAL]


@app.command(name="list")
def list_zoos(*, as_json: Json = False) -> None:
    """List the zoos that ship with this version of nnit.

    Args:
        as_json: Print JSON.
    """
    from rich.filesize import decimal

    from nnit_zoo import places, summary

    zoos = [summary.describe(task) for task in places.tasks_with_zoo()]
    if as_json:
        print_json(zoos)
        return
    cells = [
        (
            zoo["task"],
            f"{zoo['splits'].get('seen', {}).get('policies', 0):,}",
            f"{zoo['policies']:,}",
            decimal(zoo["bytes"]),
            _downloaded(zoo),
        )
        for zoo in zoos
    ]
    print_table(("task", "training policies", "all policies", "size", "downloaded"), cells)


@app.command
def show(task: str = "PickCube-v1", *, architecture: str | None = None, as_json: Json = False) -> None:
    """Show a zoo's splits with their mean scores and what its policies see, or the policies of one architecture.

    Args:
        task: Name of the task.
        architecture: Hidden widths such as 32-16-64-32.
        as_json: Print JSON.
    """
    from nnit_zoo import files, places, summary
    from nnit_zoo.architecture import check_known

    if architecture is None:
        zoo = summary.describe(task) | {"layout": _layout(task)}
        if as_json:
            print_json(zoo)
            return
        rows = [{"split": split, **row} for split, row in zoo["splits"].items()]
        print_rows(rows, ("split", "architectures", "policies", "episodes", *files.SCORES))
        if len({row["episodes"] for row in rows}) > 1:
            sys.stdout.write("Means of different numbers of episodes are of different starts, so not to be compared.\n")
        rates = zoo["pass_rates"]
        least = min(rates, key=rates.__getitem__)
        mean = sum(rates.values()) / len(rates)
        sys.stdout.write(f"Of the candidates of a seen architecture, {mean:.1%} pass the thresholds; ")
        sys.stdout.write(f"fewest of {least}: {rates[least]:.1%}.\n")
        if zoo["layout"]:
            print_table(("input", "entries"), list(zoo["layout"].items()))
        return
    check_known([architecture])
    policies = places.index(task, architecture).to_pylist()
    if as_json:
        print_json(policies)
        return
    print_rows(policies, ("ghn_seed", "split", *files.SCORES, "episodes"))


@app.command
def download(
    task: str = "PickCube-v1",
    *,
    split: Splits = (),
    source: Annotated[str | None, Parameter(env_var="NNIT_ZOO_SOURCE")] = None,
    revision: str | None = None,
    folder: Path | None = None,
    dry_run: bool = False,
    as_json: Json = False,
) -> None:
    """Bring a zoo to this machine: from a source, or made from the GHNs that ship with nnit, with the same bytes.

    What is there already is kept; after an interruption, run it again.

    Args:
        task: Name of the task.
        split: Only the shards with policies of these splits; repeat the option or use commas.
        source: A data set of the Hub (owner/name or hf://datasets/owner/name), or a folder. With HF_HUB_OFFLINE, a
            data set is not asked, and the zoo in the usual folder is made, with the same bytes.
        revision: Branch, tag or commit of the data set.
        folder: Where to write, instead of the cache of huggingface_hub.
        dry_run: Only say what would be written.
        as_json: Print JSON.
    """
    from rich.filesize import decimal

    from nnit_zoo import files
    from nnit_zoo.display import Display
    from nnit_zoo.download import Download

    zoo = Download(task, folder, source=source or None, revision=revision)
    target, splits = zoo.folder, split or files.SPLITS
    if dry_run:
        count, missing = len(zoo.wanted(splits)), zoo.missing(splits)
        size, free = sum(entry.size for entry in missing.values()), zoo.free_bytes
        if as_json:
            counts = {"files": count, "missing": len(missing), "missing_bytes": size, "free_bytes": free}
            print_json({"task": task, "folder": str(target), **counts})
        else:
            sys.stdout.write(f"{target}: {len(missing)} of {count} files to write, {decimal(size)}; ")
            sys.stdout.write(f"{decimal(free)} free\n")
        return
    zoo.run(Display(quiet=False), splits)
    if as_json:
        print_json({"task": task, "folder": str(target)})
    else:
        sys.stdout.write(f"{target}\n")


@app.command
def verify(
    task: str = "PickCube-v1",
    *,
    split: Splits = (),
    deep: Annotated[int, Parameter(validator=Number(gte=0))] = 0,
    folder: Path | None = None,
    as_json: Json = False,
) -> None:
    """Check every file and every policy of a downloaded zoo.

    Args:
        task: Name of the task.
        split: Only the shards with policies of these splits; repeat the option or use commas.
        deep: Also score this many policies anew, on the episodes of the build, and compare with the index.
        folder: Where the zoo is, if not in the cache of huggingface_hub.
        as_json: Print JSON.
    """
    from nnit_zoo import files
    from nnit_zoo import verify as checks
    from nnit_zoo.display import Display
    from nnit_zoo.zoo import Zoo, locate

    place = locate(task, folder)
    splits = split or files.SPLITS
    total = len(files.Manifest.read(place).shards)
    with Display(quiet=False).stage(f"checking {task}", total) as tell:
        problems = checks.verify(place, tell, splits)
    scored: list[dict[str, Any]] = []
    if deep and not problems:
        episodes = [policy.record["episodes"] for policy in checks.sample(Zoo.open(place), deep, splits)]
        with Display(quiet=False).stage(f"scoring {len(episodes)} policies", sum(episodes)) as tell:
            scored = checks.rescore(place, deep, tell, splits)
        problems = [f"{row['id']} scores otherwise than the index says" for row in scored if not row["agrees"]]
    if as_json:
        print_json({"task": task, "folder": str(place), "rescored": scored, "problems": problems})
    if problems:
        raise UserError("\n".join(problems))
    if not as_json:
        if scored:
            names = ("success_at_end", "return")
            print_rows(scored, ("id", *(f"{when}_{name}" for name in names for when in ("stored", "now"))))
        sys.stdout.write(f"{task}: the zoo in {place} is sound\n")


@app.command
def stats(
    task: str = "PickCube-v1",
    *,
    architecture: Annotated[Names, Parameter(show_default=False)] = (),
    output: Path | None = None,
    folder: Path | None = None,
    as_json: Json = False,
) -> None:
    """Measure how diverse and how aligned a zoo's policies are, next to the paper's numbers, with figures.

    Args:
        task: Name of the task.
        architecture: Hidden widths to look at, three by default; repeat the option or use commas.
        output: Folder for the figures; without it none are drawn.
        folder: Where the zoo is, if not in the cache of huggingface_hub.
        as_json: Print JSON.
    """
    from nnit_zoo import stats as analyses
    from nnit_zoo.display import Display
    from nnit_zoo.zoo import load

    if output is not None:
        analyses.require_matplotlib()
    zoo = load(task, folder)
    chosen = [zoo.parse(text) for text in architecture] or analyses.examples(zoo)
    with Display(quiet=False).stage(f"analysing {task}", len(chosen) + len(zoo.architectures("seen"))) as tell:
        measures = analyses.analyse(zoo, chosen, tell)
    if output is not None:
        for path in analyses.draw(zoo, chosen, output):
            sys.stderr.write(f"{path}\n")
    twins = analyses.twins(task)
    if as_json:
        print_json({"zoo": measures, "twins": twins})
        return
    print_rows(measures, tuple(measures[0]))
    if twins:
        sys.stdout.write("Networks of equal widths, from GHNs and trained by themselves (NNiT 6.1):\n")
        print_rows(twins, tuple(twins[0]))
    elif task in analyses.PAPER_TWINS:
        command = f"nnit-zoo build --task {task} --stage twins"
        sys.stdout.write(f"For NNiT's comparison with networks that are trained by themselves, run: {command}\n")


@app.command
def export(policy: str, output: Path, *, folder: Path | None = None, as_json: Json = False) -> None:
    """Write policies for other software: a policy, an architecture, or the whole zoo of a task.

    A policy (TASK/32-16-64-32/002) becomes a module that takes raw observations: .safetensors (state of an
    nn.Sequential), .pt2 (torch.export) or .onnx. Of an architecture (TASK/32-16-64-32), .safetensors holds all policies
    as stored. A zoo (TASK) becomes a folder that datasets.load_dataset reads.

    Args:
        policy: TASK, TASK/ARCHITECTURE or TASK/ARCHITECTURE/SEED.
        output: File, whose suffix is the format, or folder.
        folder: Where the zoo is, if not in the cache of huggingface_hub.
        as_json: Print JSON.
    """
    from nnit_zoo import export as formats
    from nnit_zoo.zoo import load

    task, *within = policy.split("/")
    if not within and output.suffix in formats.WRITERS:
        raise UserError(f"{policy} is a whole zoo, which becomes a folder; {output.suffix} is for one policy")
    zoo = load(task, folder)
    if within:
        formats.export(zoo, policy, output)
    else:
        from nnit_zoo.card import write_dataset

        write_dataset(output, [zoo])
    if as_json:
        print_json({"exported": policy, "output": str(output)})
    else:
        sys.stdout.write(f"{output}\n")


@app.command
def card(*, task: Names = (), as_json: Json = False) -> None:
    """Print the README card of the data set that `export` and `push` write.

    Args:
        task: Only these tasks; repeat the option or use commas.
        as_json: Print what the card says of each zoo as JSON.
    """
    from nnit_zoo import places, summary

    chosen = dict.fromkeys(task) or places.tasks_with_zoo()
    if as_json:
        print_json([summary.describe(name) for name in chosen])
        return
    from nnit_zoo.card import readme

    sys.stdout.write(readme([(places.manifest(name), places.index(name)) for name in chosen]))


@app.command
def push(repository: str, *, task: Names = (), folder: Path | None = None, as_json: Json = False) -> None:
    """Upload downloaded zoos, as one data set, to the Hub; log in first with `hf auth login`.

    The data set is made, and public, unless it is there already.

    Args:
        repository: owner/name of the data set.
        task: Only these tasks, by default all, or that of the folder; repeat the option or use commas.
        folder: Where the zoo is, if not in the cache of huggingface_hub.
        as_json: Print JSON.
    """
    from tempfile import TemporaryDirectory

    from nnit_zoo import files, hub, places
    from nnit_zoo.card import write_dataset
    from nnit_zoo.zoo import load

    there = places.tasks_with_zoo() if folder is None else (files.Manifest.read(folder).task,)
    zoos = {name: load(name, folder) for name in task or there}
    for zoo in zoos.values():
        zoo.check_whole()
    target = hub.Target(repository, zoos)  # what cannot be is told before the work
    with TemporaryDirectory() as place:
        write_dataset(Path(place), list(zoos.values()), repository)
        commit = target.push(Path(place))
    if as_json:
        print_json({"repository": repository, "commit": commit})
    else:
        sys.stdout.write(f"{commit}\n")


def run(application: App) -> None:
    """Run a command line; a mistake of the user, or what the system refuses, becomes `error: ...` and exit code 2."""
    try:
        application(sys.argv[1:], exit_on_error=False, print_error=False, result_action="return_value")
    except (UserError, CycloptsError) as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
    except OSError as error:
        if error.errno is None:
            raise
        place = f"cannot read or write {error.filename}: " if error.filename else ""
        sys.stderr.write(f"error: {place}{error.strerror}\n")
        sys.exit(2)


def main() -> None:
    """Entry point of `nnit-zoo`."""
    run(app)


def _layout(task: str) -> dict[str, str]:
    """Which entries of the observation hold what, for a task that names them: `{"obj_pose": "29-35"}`."""
    from nnit_zoo.tasks.layouts import LAYOUTS

    entries, start = {}, 0
    for name, size in LAYOUTS.get(task, {}).items():
        entries[name] = f"{start}-{start + size - 1}" if size > 1 else f"{start}"
        start += size
    return entries


def _downloaded(zoo: dict[str, Any]) -> str:
    here, all_ = zoo["shards_downloaded"], zoo["shards"]
    return "no" if not here else "yes" if here == all_ else f"{here} of {all_} shards"
