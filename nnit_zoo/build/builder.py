"""The stages that every task's build has, each resumable: GHNs, one per seed, every candidate's scores, and packing."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from safetensors.torch import load_file

from nnit_zoo import ghn_file
from nnit_zoo.architecture import SPLITS, Architecture, architectures
from nnit_zoo.atomic import write_atomically, write_json
from nnit_zoo.build.selection import POLICIES_PER_ARCHITECTURE, SELECTION_SCHEMA, is_yardstick, select
from nnit_zoo.display import Display
from nnit_zoo.errors import UserError
from nnit_zoo.files import CANDIDATE_EPISODES, GHNS, INDEX, MANIFEST, SELECTION
from nnit_zoo.ghn import GHN
from nnit_zoo.materialise import stored, write_manifest
from nnit_zoo.parallel import Backend, unordered
from nnit_zoo.places import data_folder
from nnit_zoo.policy import PolicyBatch, concatenate
from nnit_zoo.provenance import commit
from nnit_zoo.tasks.task import Task

ZOO = (GHNS, CANDIDATE_EPISODES, SELECTION, INDEX, MANIFEST)
"""The files of a zoo that `pack` puts in place, in this order: with the last one there is a zoo."""


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

    @abstractmethod
    def made_from(self) -> dict[str, str]:
        """Hashes of what the GHNs and their scores come from; a stage does not go on with others."""

    def ghns(self) -> None:
        """Train one GHN per seed."""
        train, settings = self.training()
        missing = [seed for seed in self.seeds if not self._ghn(seed).exists()]
        self._sign("ghns", {**settings, **self.made_from()}, works=bool(missing))
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
        settings = {**counts, "seeds_from": episodes.start, **self.made_from()}
        self._sign("scores", settings, works=bool(missing))
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
        """Select per architecture by the thresholds, and put the zoo, once whole, with its GHNs and scores in place."""
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
        states = {seed: load_file(self._ghn(seed)) for seed in self.seeds}
        whole = self.work / "pack"
        whole.mkdir(exist_ok=True)
        ghn_file.write(whole / GHNS, ghn_file.GHNs(self.task.name, *self._sizes, states))
        pq.write_table(pa.concat_tables(tables), whole / CANDIDATE_EPISODES, compression="zstd")
        pq.write_table(pa.Table.from_pylist(rows, SELECTION_SCHEMA), whole / SELECTION, compression="zstd")
        write_manifest(whole, self.task.standardisation)
        record = json.loads((self.data / "task.json").read_text())
        made = {stage: self._made(stage) for stage in ("states", "ghns", "scores")}
        record["build"] |= {stage: json.loads(path.read_text()) for stage, path in made.items() if path.exists()}
        (self.data / MANIFEST).unlink(missing_ok=True)  # without it there is no zoo: never a mixture of two
        write_json(self.data / "task.json", record)
        for name in ZOO:
            write_atomically(self.data / name, partial(shutil.copyfile, whole / name))
        shutil.rmtree(whole)
        seen = [row for row in rows if not is_yardstick(row["split"], row["ghn_seed"])]
        passed = sum(row["passed"] for row in seen)
        kept = Counter(row["architecture"] for row in seen if row["kept"])
        few = sum(kept[name] < POLICIES_PER_ARCHITECTURE for name in {row["architecture"] for row in seen})
        log(
            f"pack: {passed:,} of {len(seen):,} candidates of seen architectures pass, {kept.total():,} are kept; "
            f"{few} architectures have fewer than {POLICIES_PER_ARCHITECTURE}"
        )

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

    def _sign(self, stage: str, settings: dict[str, Any], *, works: bool) -> dict[str, Any]:
        """Keep and give the stage's record; raises UserError if what is there was made otherwise, or without one."""
        path, settings = self._made(stage), json.loads(json.dumps(settings))
        if not path.exists() and any(path.parent.glob("[!.]*")):  # a dot begins what a kill left half-written
            raise UserError(f"{path.parent} has no {path.name} that says how its files were made; move it elsewhere")
        made: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {**settings, "commits": []}
        if {name: value for name, value in made.items() if name != "commits"} != settings:
            raise UserError(f"{path.parent} was made with other settings, as {path.name} there says; move it elsewhere")
        if works and (now := str(commit())) not in made["commits"]:
            made["commits"].append(now)
        write_json(path, made)
        return made

    def _other_zoo(self, how: str) -> UserError:
        """What to raise if the zoo that is there was made otherwise, `how`, and would be left without its origin."""
        first = f"first move elsewhere, from there, {', '.join(ZOO)}"
        return UserError(f"the zoo in {self.data} was made {how}; if that is meant, {first}")

    @property
    def _units(self) -> Path:
        return self.work / "scores" / "units"

    def _scores(self, architecture: Architecture) -> Path:
        return self.work / "scores" / f"{architecture}.parquet"
