"""`nnit-zoo build`: its stages, each resumable; a killed build goes on where it stopped.

Robot tasks: expert, states, ghns, scores, pack, and twins if asked for. MNIST-PCA32: features, ghns, scores, pack.

Intermediate states go to the work folder, finished artifacts to the package's data folder of the task.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch

from nnit_zoo import tasks
from nnit_zoo.build.builder import ZOO, Builder
from nnit_zoo.build.mnist import MNISTBuilder
from nnit_zoo.build.robot import RobotBuilder
from nnit_zoo.console import Json, print_json
from nnit_zoo.errors import UserError
from nnit_zoo.files import SELECTION
from nnit_zoo.parallel import Backend
from nnit_zoo.places import data_folder
from nnit_zoo.sim.tabletop import require_simulator
from nnit_zoo.summary import ghns_of
from nnit_zoo.tasks.mnist import MNISTPCA32
from nnit_zoo.tasks.robot import RobotPolicyTask

Stage = Literal["all", "expert", "states", "features", "ghns", "scores", "pack", "twins"]


def build(
    *,
    task: str = "PickCube-v1",
    stage: Stage = "all",
    seeds: int | None = None,
    workers: int = 2,
    parallel: Backend = "processes",
    work: Path = Path("runs/build"),
    source: str | None = None,
    as_json: Json = False,
) -> None:
    """Build a task's zoo: what its GHNs learn from, one GHN per seed, every candidate's scores, and those that pass.

    Args:
        task: Name of the task.
        stage: Only this stage, of those that the task has.
        seeds: GHNs; by default as many as the zoo that ships was made by, or as there are in the work folder, or 16.
        workers: Processes that train and score.
        parallel: Where candidates are scored: on this machine, or on a Ray cluster.
        work: Folder of intermediate states; a killed build resumes from it.
        source: MNIST-PCA32's digits: a folder with the original IDX files, or ylecun/mnist.
        as_json: At the end, print as JSON what was built.
    """
    torch.set_num_threads(1)
    chosen = tasks.get(task)
    if workers < 1 or (seeds is not None and seeds < 1):
        raise UserError("--workers and --seeds must be 1 or more")
    shipped = data_folder(task) / SELECTION
    packed, made = ghns_of(shipped) if shipped.exists() else 0, len(list((work / task / "ghns").glob("*.safetensors")))
    seeds = seeds or max(packed, made) or 16
    for there, place, parts in ((packed, shipped.parent, ZOO), (made, work / task, ("ghns", "scores"))):
        if seeds < there:
            raise UserError(
                f"{place} is of {there} GHNs, and {seeds} would take their place; "
                f"if that is meant, first move elsewhere, from there, {', '.join(parts)}"
            )
    builder: Builder
    if isinstance(chosen, RobotPolicyTask) and source is None:
        require_simulator()
        builder = RobotBuilder(chosen, work / task, seeds, workers, parallel)
    elif isinstance(chosen, MNISTPCA32):
        builder = MNISTBuilder(chosen, work / task, seeds, workers, parallel, source)
    else:
        raise UserError(f"--source is not for {task}" if source else f"this command cannot build {task}")
    known = (*builder.stages, *builder.analyses)
    if stage not in ("all", *known):
        raise UserError(f"building {task} has no stage '{stage}': there are {', '.join(known)}")
    stages = builder.stages if stage == "all" else (stage,)
    for name in stages:
        getattr(builder, name)()
    if as_json:
        where = {"work": str(builder.work), "folder": str(builder.data)}
        print_json({"task": task, "stages": stages, "seeds": seeds, **where})
