"""`nnit-zoo build`: expert, states, ghns, scores, pack, each resumable; a killed build goes on where it stopped.

Intermediate states go to the work folder, finished artifacts to the package's data folder of the task.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from cyclopts import Parameter
from safetensors.torch import load_file, save_file

from nnit_zoo import tasks
from nnit_zoo.architecture import SPLITS, Architecture, architectures
from nnit_zoo.build import distill
from nnit_zoo.build import expert as experts
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.build.files import write_atomically, write_json
from nnit_zoo.build.ghn import GHN
from nnit_zoo.errors import UserError
from nnit_zoo.materialise import stored, write_manifest
from nnit_zoo.policy import concatenate
from nnit_zoo.sim.tabletop import require_simulator
from nnit_zoo.tasks.robot import RobotPolicyTask
from nnit_zoo.tasks.task import data_folder
from nnit_zoo.zoo import HELDOUT_SEEDS_FROM

Stage = Literal["all", "expert", "states", "ghns", "scores", "pack"]
STAGES = ("expert", "states", "ghns", "scores", "pack")
SCORING_SEEDS = range(10_000_000, 10_000_064)  # NNiT appendix C: 64 episodes a candidate
POLICIES_PER_ARCHITECTURE = 100
STD_FLOOR = 0.05  # keeps near-constant observations from being blown up; decides the weight error policies survive


def build(
    *,
    task: str = "PickCube-v1",
    stage: Stage = "all",
    seeds: int = 16,
    workers: int = 2,
    work: Annotated[Path, Parameter(help="Folder of intermediate states; a killed build resumes from it.")] = Path(
        "runs/build"
    ),
) -> None:
    """Build a task's zoo: train the expert, distil one GHN per seed, score every candidate, pack what passes.

    Run it again after a kill, at any moment, and it goes on. With `--stage`, only that stage.
    """
    require_simulator()
    torch.set_num_threads(1)
    chosen = tasks.get(task)
    if not isinstance(chosen, RobotPolicyTask):
        raise UserError(f"{task} cannot be built by this command yet")
    builder = Builder(chosen, work / task, seeds, workers)
    for name in STAGES:
        if stage in ("all", name):
            getattr(builder, name)()


def log(message: str) -> None:
    """Tell the user how a stage goes, on stderr."""
    print(message, file=sys.stderr, flush=True)  # noqa: T201


class Builder:
    """The stages of one task's build over GHN seeds 0 .. `seeds` - 1."""

    def __init__(self, task: RobotPolicyTask, work: Path, seeds: int, workers: int) -> None:
        self.task, self.work, self.workers = task, work, workers
        self.seeds = range(seeds)
        self.data = data_folder(task.name)
        self.expert_config, self.distill_config = ExpertConfig(), DistillConfig()

    def expert(self) -> None:
        """Train the expert, then fix the task's standardisation from the states that it visits."""
        if (self.data / "expert.safetensors").exists():
            log("expert: done")
            return
        record = experts.train(self.task, self.expert_config, self.work / "expert", self.workers, log)
        network = experts.load(self.work / "expert" / "expert.safetensors")
        episodes = experts.play(self.task, network, experts.EVALUATION_SEEDS)
        states = episodes.observations.reshape(-1, self.task.inputs).astype(np.float64)
        write_json(
            self.data / "task.json",
            {
                "name": self.task.name,
                "version": self.task.version,
                "observation_mean": states.mean(0).astype(np.float32).tolist(),
                "observation_std": np.maximum(states.std(0), STD_FLOOR).astype(np.float32).tolist(),
                "build": {"expert": {**record, "config": self.expert_config.model_dump(), "commit": _commit()}},
            },
        )
        experts.save(network, self.data / "expert.safetensors")
        log(f"expert: {json.dumps(record)}")

    def states(self) -> None:
        """Gather the shared buffer of states by DAgger."""
        if (self._states).exists():
            log("states: done")
            return
        distill.gather_states(self.task, self.distill_config, self._expert(), self.work / "states", self.workers, log)

    def ghns(self) -> None:
        """Train one GHN per seed on the buffer, then stack them all into the data folder."""
        from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415  part of the simulator's extra

        network = self._expert()
        missing = [seed for seed in self.seeds if not self._ghn(seed).exists()]
        jobs = (
            delayed(distill.train_ghn)(self.task, self.distill_config, network, self._states, self._ghn(seed), seed)
            for seed in missing
        )
        with parallel_config("loky", n_jobs=self.workers, inner_max_num_threads=1):
            for line in Parallel(return_as="generator_unordered")(jobs):
                log(f"ghns: {line}")
        states = [load_file(self._ghn(seed)) for seed in self.seeds]
        stacked = {name: torch.stack([state[name] for state in states]) for name in states[0]}
        sizes = {"inputs": self.task.inputs, "outputs": self.task.outputs}
        # One entry, because safetensors writes several in an order that changes from run to run.
        note = {"nnit": json.dumps({"task": self.task.name, **sizes, "ghn_seeds": list(self.seeds)})}
        write_atomically(self.data / "ghns.safetensors", lambda temporary: save_file(stacked, temporary, note))
        self._record(distill={**self.distill_config.model_dump(), "states": self._count_states(), "commit": _commit()})

    def scores(self) -> None:
        """Score every candidate, on exactly its stored float16 weights, for 64 episodes; a file per architecture."""
        for split in SPLITS:
            for architecture in architectures(split, self.task.inputs, self.task.outputs):
                self._score(architecture)

    def _score(self, architecture: Architecture) -> None:
        path = self._scores(architecture)
        if path.exists():
            return
        ghns = [GHN.from_state(self.task.inputs, self.task.outputs, load_file(self._ghn(seed))) for seed in self.seeds]
        policies = concatenate(stored(ghn, architecture) for ghn in ghns)
        table = self.task.evaluate([policies], SCORING_SEEDS, workers=self.workers)
        seeds = pa.array([self.seeds[index] for index in table["policy"].to_pylist()], pa.int32())
        table = table.set_column(0, "ghn_seed", seeds).drop_columns(["reason"])
        write_atomically(path, lambda temporary: pq.write_table(table, temporary))
        success = pc.mean(table["success_at_end"]).as_py()
        log(f"scores: {architecture} success at end {success:.3f}, return {pc.mean(table['return']).as_py():.2f}")

    def pack(self) -> None:
        """Select per architecture by the thresholds and write the scores, the selection, the index and the manifest."""
        rows: list[dict[str, Any]] = []
        tables: list[pa.Table] = []
        for split in SPLITS:
            for architecture in architectures(split, self.task.inputs, self.task.outputs):
                if not self._scores(architecture).exists():
                    raise UserError(f"{architecture} is not scored yet; run the stage 'scores' first")
                table = pq.read_table(self._scores(architecture))
                tables.append(table)
                rows += select(self.task, split, str(architecture), table)
        write_atomically(
            self.data / "scores.parquet",
            lambda temporary: pq.write_table(pa.concat_tables(tables), temporary, compression="zstd"),
        )
        write_atomically(
            self.data / "selection.parquet",
            lambda temporary: pq.write_table(pa.Table.from_pylist(rows), temporary, compression="zstd"),
        )
        write_manifest(self.data)
        seen = [row for row in rows if row["split"] == "seen" and row["ghn_seed"] < HELDOUT_SEEDS_FROM]
        passed = sum(row["kept"] for row in seen)
        self._record(scores={"episodes": len(SCORING_SEEDS), "seeds_from": SCORING_SEEDS.start, "commit": _commit()})
        log(f"pack: {passed:,} of {len(seen):,} candidates of seen architectures pass")

    @property
    def _states(self) -> Path:
        return self.work / "states" / "states.safetensors"

    def _ghn(self, seed: int) -> Path:
        return self.work / "ghns" / f"{seed:03d}.safetensors"

    def _scores(self, architecture: Architecture) -> Path:
        return self.work / "scores" / f"{architecture}.parquet"

    def _expert(self) -> experts.Network:
        path = self.data / "expert.safetensors"
        if not path.exists():
            raise UserError(f"{self.task.name} has no expert yet; run the stage 'expert' first")
        return experts.load(path)

    def _count_states(self) -> int:
        return len(load_file(self._states)["states"])

    def _record(self, **entries: dict[str, Any]) -> None:
        content = json.loads((self.data / "task.json").read_text())
        content["build"] |= entries
        write_json(self.data / "task.json", content)


def select(task: RobotPolicyTask, split: str, architecture: str, scores: pa.Table) -> Iterator[dict[str, Any]]:
    """The selection rows of one architecture's candidates, by GHN seed.

    Of a seen architecture, the best 100 that reach both thresholds are kept, by success at the end, then return (NNiT
    appendix C). Of a reference architecture, and of held-out seeds, all are kept: they are a yardstick, which a filter
    would bend.
    """
    means = scores.group_by("ghn_seed").aggregate(
        [("success_once", "mean"), ("success_at_end", "mean"), ("return", "mean"), ("seed", "count")]
    )
    candidates = sorted(
        means.to_pylist(), key=lambda row: (-row["success_at_end_mean"], -row["return_mean"], row["ghn_seed"])
    )
    reference = [row["ghn_seed"] for row in candidates if split != "seen" or row["ghn_seed"] >= HELDOUT_SEEDS_FROM]
    passing = [
        row["ghn_seed"]
        for row in candidates
        if row["success_at_end_mean"] >= task.success_threshold and row["return_mean"] >= task.return_threshold
    ]
    corpus = [seed for seed in passing if seed not in reference][:POLICIES_PER_ARCHITECTURE]
    kept = {*reference, *corpus}
    for row in sorted(candidates, key=lambda row: row["ghn_seed"]):
        yield {
            "architecture": architecture,
            "ghn_seed": row["ghn_seed"],
            "split": split,
            "success_once": row["success_once_mean"],
            "success_at_end": row["success_at_end_mean"],
            "return": row["return_mean"],
            "episodes": row["seed_count"],
            "kept": row["ghn_seed"] in kept,
        }


def _commit() -> str:
    """The commit of the code that builds, with `+` if files differ from it."""
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],  # noqa: S607
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return run.stdout.strip()
