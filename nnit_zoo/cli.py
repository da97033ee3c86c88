"""The `nnit-zoo` command; heavy imports happen inside the commands, so that `--help` answers at once."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Parameter

from nnit_zoo.errors import UserError

app = App(
    name="nnit-zoo",
    help="List, fetch, check and build zoos of small robot policies.",
    version=lambda: version("nnit"),
    default_parameter=Parameter(negative=""),
)
app.command("nnit_zoo.build.stages:build", name="build", help="Build a task's zoo: expert, GHNs, selection, manifest.")

Json = Annotated[bool, Parameter(name="--json")]


@app.command(name="list")
def list_zoos(*, as_json: Json = False) -> None:
    """List the zoos that this version of nnit embeds.

    Args:
        as_json: Print JSON.
    """
    from nnit_zoo import files

    zoos = [_describe(task) for task in files.tasks_with_zoo()]
    if as_json:
        _print_json(zoos)
        return
    cells = [
        (
            zoo["task"],
            f"{zoo['splits'].get('seen', {}).get('policies', 0)}",
            f"{zoo['policies']}",
            files.readable(zoo["bytes"]),
            "yes" if zoo["downloaded"] else "no",
        )
        for zoo in zoos
    ]
    _print_table(("task", "training policies", "all policies", "size", "downloaded"), cells)


@app.command
def show(task: str = "PickCube-v1", *, architecture: str | None = None, as_json: Json = False) -> None:
    """Show what a zoo holds: its splits with their mean scores, or the policies of one architecture.

    Args:
        task: Name of the task.
        architecture: Hidden widths such as 32-16-64-32.
        as_json: Print JSON.
    """
    from nnit_zoo import files
    from nnit_zoo.architecture import check_known

    if architecture is None:
        zoo = _describe(task)
        if as_json:
            _print_json(zoo)
            return
        numbers = [
            (split, *(_text(value) for value in split_row.values())) for split, split_row in zoo["splits"].items()
        ]
        _print_table(("split", "architectures", "policies", "success at end", "success once", "return"), numbers)
        return
    check_known([architecture])
    policies = files.read_index(files.embedded(task) / files.INDEX, architecture).to_pylist()
    if as_json:
        _print_json(policies)
        return
    columns = ("ghn_seed", "split", "success_at_end", "success_once", "return", "episodes")
    _print_table(columns, [tuple(_text(policy[column]) for column in columns) for policy in policies])


@app.command
def download(task: str = "PickCube-v1", *, folder: Path | None = None, dry_run: bool = False) -> None:
    """Make a zoo's shards from the GHNs that nnit embeds; what is there already is kept.

    Args:
        task: Name of the task.
        folder: Where to write, instead of the cache of huggingface_hub.
        dry_run: Only say what would be written.
    """
    from nnit_zoo import files

    source = files.embedded(task)
    manifest = files.Manifest.read(source)
    target = files.default_folder(task) if folder is None else folder
    if dry_run:
        missing = manifest.missing(target)
        size = files.readable(sum(entry.size for entry in missing.values()))
        sys.stdout.write(f"{target}: {len(missing)} of {len(manifest.files)} files to write, {size}; ")
        sys.stdout.write(f"{files.readable(files.free_bytes(target))} free\n")
        return
    from nnit_zoo.materialise import materialise

    with _progress(f"making {task}", len(manifest.shards)) as progress:
        materialise(source, target, progress)
    sys.stdout.write(f"{target}\n")


@app.command
def verify(task: str = "PickCube-v1", *, folder: Path | None = None, as_json: Json = False) -> None:
    """Check every file and every policy of a downloaded zoo.

    Args:
        task: Name of the task.
        folder: Where the zoo is, if not in the cache of huggingface_hub.
        as_json: Print JSON.
    """
    from nnit_zoo import files
    from nnit_zoo.verify import verify as find_problems
    from nnit_zoo.zoo import locate

    place = locate(task, folder)
    shards = len(files.Manifest.read(place).shards)
    with _progress(f"checking {task}", shards) as progress:
        problems = find_problems(place, progress)
    if as_json:
        _print_json({"task": task, "folder": str(place), "shards": shards, "problems": problems})
    if problems:
        raise UserError("\n".join(problems))
    if not as_json:
        sys.stdout.write(f"{task}: {shards} shards in {place} are sound\n")


def run(application: App) -> None:
    """Run a command line; a mistake of the user becomes `error: ...` on stderr and exit code 2."""
    try:
        application(sys.argv[1:], exit_on_error=False, print_error=False, result_action="return_value")
    except (UserError, CycloptsError) as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)


def main() -> None:
    """Entry point of `nnit-zoo`."""
    run(app)


def _describe(task: str) -> dict[str, Any]:
    """A zoo's splits with their sizes and mean scores, from the embedded index."""
    from nnit_zoo import files

    manifest = files.Manifest.read(files.embedded(task))
    index = files.read_index(files.embedded(task) / files.INDEX)
    splits: dict[str, list[dict[str, Any]]] = {}
    for row in index.to_pylist():
        splits.setdefault(row["split"], []).append(row)
    place = files.default_folder(task)
    return {
        "task": task,
        "inputs": manifest.inputs,
        "outputs": manifest.outputs,
        "policies": index.num_rows,
        "bytes": manifest.size,
        "folder": str(place),
        "downloaded": (place / files.MANIFEST).is_file() and files.Manifest.read(place) == manifest,
        "splits": {
            split: {
                "architectures": len({row["architecture"] for row in rows}),
                "policies": len(rows),
                **{
                    score: sum(row[score] for row in rows) / len(rows)
                    for score in ("success_at_end", "success_once", "return")
                },
            }
            for split, rows in splits.items()
        },
    }


def _print_json(content: Any) -> None:
    sys.stdout.write(json.dumps(content, indent=2) + "\n")


def _text(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _print_table(columns: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns, box=SIMPLE)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


@contextmanager
def _progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar on stderr, if that is a terminal; yields the function that advances it."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        line = bar.add_task(what, total=total)
        yield lambda done: bar.advance(line, done)
