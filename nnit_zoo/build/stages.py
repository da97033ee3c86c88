"""`nnit-zoo build`: its stages, each resumable; a killed build goes on where it stopped.

Robot tasks: expert, states, ghns, scores, pack, and twins if asked for. MNIST-PCA32: features, ghns, scores, pack.

Intermediate states go to the work folder, finished artifacts to the package's data folder of the task.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from cyclopts import Parameter
from safetensors.torch import load_file, save_file

from nnit_zoo import stats, tasks
from nnit_zoo.architecture import SPLITS, Architecture, architectures
from nnit_zoo.atomic import write_atomically, write_json
from nnit_zoo.build import distill, mnist, twins
from nnit_zoo.build import expert as experts
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.build.ghn import GHN
from nnit_zoo.build.selection import SELECTION_SCHEMA, is_yardstick, select
from nnit_zoo.build.twins import TwinsConfig
from nnit_zoo.display import Display
from nnit_zoo.errors import UserError
from nnit_zoo.files import CANDIDATE_EPISODES, EXPERT, GHNS, SELECTION, ghns_of
from nnit_zoo.materialise import stored, write_manifest
from nnit_zoo.parallel import Backend, unordered
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.provenance import commit
from nnit_zoo.sim.tabletop import require_simulator
from nnit_zoo.tasks.mnist import FEATURES, MNISTPCA32
from nnit_zoo.tasks.robot import RobotPolicyTask
from nnit_zoo.tasks.task import PROBE, Task, data_folder

Stage = Literal["all", "expert", "states", "features", "ghns", "scores", "pack", "twins"]
PROBE_STATES = 2000
STD_FLOOR = 0.05  # keeps near-constant observations from being blown up; decides the weight error policies survive


def build(
    *,
    task: str = "PickCube-v1",
    stage: Stage = "all",
    seeds: Annotated[
        int | None, Parameter(help="GHNs; by default as many as the zoo that ships was made by, or 16.")
    ] = None,
    workers: int = 2,
    parallel: Annotated[
        Backend, Parameter(help="Where candidates are scored: on this machine, or on a Ray cluster.")
    ] = "processes",
    work: Annotated[Path, Parameter(help="Folder of intermediate states; a killed build resumes from it.")] = Path(
        "runs/build"
    ),
    source: Annotated[
        str | None, Parameter(help="MNIST-PCA32's digits: a folder with the original IDX files, or ylecun/mnist.")
    ] = None,
) -> None:
    """Build a task's zoo: what its GHNs learn from, one GHN per seed, every candidate's scores, and those that pass.

    The last stage, `pack`, puts the zoo into the package, in place of the one that is there. Run the command again
    after a kill, at any moment, and it goes on. With `--stage`, only that stage. The stage `twins` is not part of
    `all`: it makes nothing for the zoo, but NNiT's comparison of networks from GHNs with others, for `stats`.
    """
    torch.set_num_threads(1)
    chosen = tasks.get(task)
    if workers < 1 or (seeds is not None and seeds < 1):
        raise UserError("--workers and --seeds must be 1 or more")
    shipped = data_folder(task) / SELECTION
    least = ghns_of(shipped) if shipped.exists() else 0
    seeds = seeds or least or 16
    if seeds < least:
        raise UserError(
            f"the zoo of {task} in {shipped.parent} was made by {least} GHNs, and one of {seeds} would replace it; "
            "move it elsewhere first if that is meant"
        )
    builder: Builder
    if isinstance(chosen, RobotPolicyTask) and source is None:
        require_simulator()
        builder = RobotBuilder(chosen, work / task, seeds, workers, parallel)
    elif isinstance(chosen, MNISTPCA32):
        builder = MNISTBuilder(chosen, work / task, seeds, workers, parallel)
        builder.source = source
    else:
        raise UserError(f"--source is not for {task}" if source else f"this command cannot build {task}")
    known = (*builder.stages, *builder.analyses)
    if stage not in ("all", *known):
        raise UserError(f"building {task} has no stage '{stage}': there are {', '.join(known)}")
    for name in builder.stages if stage == "all" else (stage,):
        getattr(builder, name)()


def log(message: str) -> None:
    """Tell the user how a stage goes, on stderr."""
    print(message, file=sys.stderr, flush=True)  # noqa: T201


class Builder(ABC):
    """The stages of one task's build over GHN seeds 0 .. `seeds` - 1; the last three are the same for all tasks."""

    stages: ClassVar[tuple[str, ...]]
    analyses: ClassVar[tuple[str, ...]] = ()
    """Stages that the zoo can do without."""
    yardstick_episodes: ClassVar[int | None] = None
    """How many of the scoring episodes a policy plays that cannot enter the corpus; all, if None."""

    def __init__(self, task: Task, work: Path, seeds: int, workers: int, parallel: Backend = "processes") -> None:
        self.task, self.work, self.workers, self.parallel = task, work, workers, parallel
        self.seeds = range(seeds)
        self.data = data_folder(task.name)

    @abstractmethod
    def training(self) -> tuple[Callable[[Path, int], str], dict[str, Any]]:
        """What trains the GHN of a seed into a file and returns a log line, and how, for the zoo's record."""

    def ghns(self) -> None:
        """Train one GHN per seed."""
        train, settings = self.training()
        missing = [seed for seed in self.seeds if not self._ghn(seed).exists()]
        self._sign("ghns", settings, works=bool(missing))
        with Display(quiet=False).stage("ghns", len(missing)) as advance:
            for _, line in unordered(lambda seed: train(self._ghn(seed), seed), missing, self.workers):
                log(f"ghns: {line}")
                advance(1)

    def scores(self) -> None:
        """Score every candidate, on exactly its stored float16 weights; a file per architecture."""
        self._require_ghns()
        listed = [(split, each) for split in SPLITS for each in architectures(split, *self._sizes)]
        missing = [(split, architecture) for split, architecture in listed if not self._is_scored(architecture)]
        episodes = self.task.scoring_seeds
        counts = {"episodes": len(episodes), "yardstick_episodes": len(episodes[: self.yardstick_episodes])}
        self._sign("scores", {**counts, "seeds_from": episodes.start}, works=bool(missing))
        count = sum(len(seeds) * len(episodes) for split, _ in missing for seeds, episodes in self._to_score(split))
        with Display(quiet=False).stage("scores: episodes", count) as advance:
            for split, architecture in missing:
                self._score(split, architecture, advance)
        shutil.rmtree(self._units, ignore_errors=True)

    def _to_score(self, split: str) -> list[tuple[list[int], range]]:
        """GHN seeds, in order, and the episodes that their policies of this split's architectures play."""
        candidates = [seed for seed in self.seeds if not is_yardstick(split, seed)]
        yardsticks = [seed for seed in self.seeds if is_yardstick(split, seed)]
        episodes = self.task.scoring_seeds
        groups = [(candidates, episodes), (yardsticks, episodes[: self.yardstick_episodes])]
        return [(seeds, episodes) for seeds, episodes in groups if seeds]

    def _is_scored(self, architecture: Architecture) -> bool:
        path = self._scores(architecture)
        return path.exists() and (pq.read_schema(path).metadata or {}).get(b"ghns") == self._ghns_sha256.encode()

    def _score(self, split: str, architecture: Architecture, advance: Callable[[int], None]) -> None:
        tables = []
        for seeds, episodes in self._to_score(split):
            ghns = (GHN.from_state(*self._sizes, load_file(self._ghn(seed))) for seed in seeds)
            policies = concatenate(stored(ghn, architecture) for ghn in ghns)
            scored = self._evaluate(policies, episodes, self._units, advance)
            ghn_seeds = pa.array([seeds[index] for index in scored["policy"].to_pylist()], pa.int32())
            tables.append(scored.set_column(0, "ghn_seed", ghn_seeds).drop_columns(["reason"]))
        table = pa.concat_tables(tables).replace_schema_metadata({"ghns": self._ghns_sha256})
        write_atomically(self._scores(architecture), lambda temporary: pq.write_table(table, temporary))
        means = ", ".join(f"{metric.label} {pc.mean(table[metric.column]).as_py():.3f}" for metric in self.task.metrics)
        log(f"scores: {architecture} {means}")

    def _evaluate(
        self, policies: PolicyBatch, episodes: range, store: Path, advance: Callable[[int], None]
    ) -> pa.Table:
        return self.task.evaluate(
            [policies], episodes, workers=self.workers, parallel=self.parallel, store=store, progress=advance
        )

    def pack(self) -> None:
        """Select per architecture by the thresholds, and write the zoo with its GHNs and scores to the data folder."""
        self._require_ghns()
        rows: list[dict[str, Any]] = []
        tables: list[pa.Table] = []
        for split in SPLITS:
            for architecture in architectures(split, *self._sizes):
                if not self._is_scored(architecture):
                    raise UserError(f"{architecture} is not scored yet; run the stage 'scores' first")
                table = pq.read_table(self._scores(architecture))
                tables.append(table)
                rows += select(self.task, split, str(architecture), table)
        states = [load_file(self._ghn(seed)) for seed in self.seeds]
        stacked = {name: torch.stack([state[name] for state in states]) for name in states[0]}
        sizes = {"inputs": self.task.inputs, "outputs": self.task.outputs}
        # One entry, because safetensors writes several in an order that changes from run to run.
        note = {"nnit": json.dumps({"task": self.task.name, **sizes, "ghn_seeds": list(self.seeds)})}
        write_atomically(self.data / GHNS, lambda temporary: save_file(stacked, temporary, note))
        write_atomically(
            self.data / CANDIDATE_EPISODES,
            lambda temporary: pq.write_table(pa.concat_tables(tables), temporary, compression="zstd"),
        )
        write_atomically(
            self.data / SELECTION,
            lambda temporary: pq.write_table(
                pa.Table.from_pylist(rows, SELECTION_SCHEMA), temporary, compression="zstd"
            ),
        )
        write_manifest(self.data, self.task.standardisation)
        seen = [row for row in rows if not is_yardstick(row["split"], row["ghn_seed"])]
        passed, kept = (sum(row[name] for row in seen) for name in ("passed", "kept"))
        made = {stage: json.loads(self._made(stage).read_text()) for stage in ("ghns", "scores")}
        self._record(**made)
        log(f"pack: {passed:,} of {len(seen):,} candidates of seen architectures pass, {kept:,} are kept")

    @property
    def _sizes(self) -> tuple[int, int]:
        return self.task.inputs, self.task.outputs

    def _ghn(self, seed: int) -> Path:
        return self.work / "ghns" / f"{seed:03d}.safetensors"

    def _require_ghns(self) -> None:
        for seed in self.seeds:
            if not self._ghn(seed).exists():
                raise UserError(f"GHN {seed} is not trained yet; run the stage 'ghns' first")

    @cached_property
    def _ghns_sha256(self) -> str:
        """Of all GHNs: scores are those of these GHNs and no others."""
        total = hashlib.sha256()
        for seed in self.seeds:
            for _, tensor in sorted(load_file(self._ghn(seed)).items()):
                total.update(tensor.numpy().tobytes())
        return total.hexdigest()

    def _made(self, stage: str) -> Path:
        """The record of what this stage has made in the work folder: its settings, and the commits that it ran from."""
        return self.work / stage / "made.json"

    def _sign(self, stage: str, settings: dict[str, Any], *, works: bool) -> None:
        """Keep the stage's record; raises UserError if what is there was made with other settings."""
        path, settings = self._made(stage), json.loads(json.dumps(settings))
        made = json.loads(path.read_text()) if path.exists() else {**settings, "commits": []}
        if {name: value for name, value in made.items() if name != "commits"} != settings:
            raise UserError(f"{path.parent} was made with other settings, as {path.name} there says; move it elsewhere")
        if works and (now := str(commit())) not in made["commits"]:
            made["commits"].append(now)
        write_json(path, made)

    @property
    def _units(self) -> Path:
        return self.work / "scores" / "units"

    def _scores(self, architecture: Architecture) -> Path:
        return self.work / "scores" / f"{architecture}.parquet"

    def _record(self, **entries: dict[str, Any]) -> None:
        content = json.loads((self.data / "task.json").read_text())
        content["build"] |= entries
        write_json(self.data / "task.json", content)


class RobotBuilder(Builder):
    """Trains an expert, gathers the states that its students meet, and distils it into GHNs."""

    stages = ("expert", "states", "ghns", "scores", "pack")
    analyses = ("twins",)
    yardstick_episodes = 16

    def __init__(
        self, task: RobotPolicyTask, work: Path, seeds: int, workers: int, parallel: Backend = "processes"
    ) -> None:
        super().__init__(task, work, seeds, workers, parallel)
        self.task: RobotPolicyTask = task
        self.expert_config = experts.CONFIG_BY_TASK.get(task.name, ExpertConfig())
        self.distill_config, self.twins_config = DistillConfig(), TwinsConfig()

    def expert(self) -> None:
        """Train the expert, then fix the task's standardisation from the states that it visits."""
        if (self.data / EXPERT).exists():
            log("expert: done")
            return
        record = experts.train(self.task, self.expert_config, self.work / "expert", self.workers, log)
        network = experts.load(self.work / "expert" / EXPERT)
        episodes = experts.play(self.task, network, experts.EVALUATION_SEEDS)
        states = episodes.observations.reshape(-1, self.task.inputs).astype(np.float64)
        write_json(
            self.data / "task.json",
            {
                "name": self.task.name,
                "version": self.task.version,
                "observation_mean": states.mean(0).astype(np.float32).tolist(),
                "observation_std": np.maximum(states.std(0), STD_FLOOR).astype(np.float32).tolist(),
                "build": {"expert": {**record, "config": self.expert_config.model_dump(), "commit": str(commit())}},
            },
        )
        probe = torch.from_numpy(states[np.arange(PROBE_STATES) * len(states) // PROBE_STATES]).half()
        write_atomically(self.data / PROBE, lambda temporary: save_file({"states": probe}, temporary))
        experts.save(network, self.data / EXPERT)
        log(f"expert: {json.dumps(record)}")
        if not experts.good_enough(self.expert_config, record):
            log("expert: it is below the scores to stop at; its students can only be worse")

    def states(self) -> None:
        """Gather the shared buffer of states by DAgger."""
        if (self._states).exists():
            log("states: done")
            return
        distill.gather_states(self.task, self.distill_config, self._expert(), self.work / "states", self.workers, log)

    def training(self) -> tuple[Callable[[Path, int], str], dict[str, Any]]:
        """Regression onto the expert, on the buffer and on states of the GHN's own."""
        train = partial(distill.train_ghn, self.task, self.distill_config, self._expert(), self._states)
        return train, {**self.distill_config.model_dump(), "states": self._count_states()}

    def twins(self) -> None:
        """Train and measure NNiT's twin populations; the networks, too large to ship, stay in the work folder."""
        if not self._states.exists():
            raise UserError(f"{self.task.name} has no states to learn from; run the stage 'states' first")
        config, folder = self.twins_config, self.work / "twins"
        seeds = range(config.networks)
        paths = {kind: [folder / kind / f"{seed:03d}.safetensors" for seed in seeds] for kind in twins.KINDS}
        missing = [(path, kind) for kind in twins.KINDS for path in paths[kind] if not path.exists()]
        train = partial(twins.train, self.task, config, self._expert(), self._states)
        with Display(quiet=False).stage("twins", len(missing)) as advance:
            for _, line in unordered(lambda unit: train(*unit), missing, self.workers):
                log(f"twins: {line}")
                advance(1)
        observations, populations = self.task.probe_states(), {}
        assert observations is not None
        with Display(quiet=False).stage(
            "twins: episodes", len(paths) * len(seeds) * len(self.task.scoring_seeds)
        ) as advance:
            for kind in twins.KINDS:
                networks = twins.load(self.task, paths[kind])
                scores = self._evaluate(networks, self.task.scoring_seeds, folder / "units", advance)
                populations[kind] = stats.population(networks, scores, observations)
        content = {
            "architecture": "-".join(map(str, twins.HIDDEN)),
            "populations": populations,
            "episodes": len(self.task.scoring_seeds),
            "seeds_from": self.task.scoring_seeds.start,
            "config": config.model_dump(),
            "commit": str(commit()),
        }
        write_json(self.data / stats.TWINS, content)
        shutil.rmtree(folder / "units", ignore_errors=True)
        log(f"twins: {json.dumps(populations)}")

    @property
    def _states(self) -> Path:
        return self.work / "states" / "states.safetensors"

    def _expert(self) -> experts.Network:
        path = self.data / EXPERT
        if not path.exists():
            raise UserError(f"{self.task.name} has no expert yet; run the stage 'expert' first")
        return experts.load(path)

    def _count_states(self) -> int:
        return len(load_file(self._states)["states"])


class MNISTBuilder(Builder):
    """Fits the features to the training digits, and GHNs to the features."""

    stages = ("features", "ghns", "scores", "pack")

    source: str | None = None
    """Where the digits of `features` come from."""

    def __init__(self, task: MNISTPCA32, work: Path, seeds: int, workers: int, parallel: Backend = "processes") -> None:
        super().__init__(task, work, seeds, workers, parallel)
        self.config = mnist.MNISTConfig()

    def features(self) -> None:
        """Make the features from the digits of `source`; without it, those that are there must do."""
        target = self.data / "task.json"
        if self.source is None:
            if not target.exists():
                raise UserError(f"{self.task.name} has no features yet: name with --source {mnist.SOURCES}")
            log("features: done")
            return
        earlier = json.loads(target.read_text())["build"] if target.exists() else {}
        constants, facts = mnist.build_features(self.source, self.data / FEATURES)
        content = {"name": self.task.name, "version": self.task.version, **constants}
        write_json(target, {**content, "build": {**earlier, "features": {**facts, "commit": str(commit())}}})
        log(f"features: {json.dumps(facts)}")

    def training(self) -> tuple[Callable[[Path, int], str], dict[str, Any]]:
        """Cross entropy on the training digits; there is no expert."""
        return partial(mnist.train_ghn, self.config), {**self.config.model_dump(), "digits": 60_000}
