"""Building a robot task's zoo: an expert, the states that its students meet, and GHNs distilled from both."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save

from nnit_zoo import stats
from nnit_zoo.atomic import write_bytes, write_json
from nnit_zoo.build import distill, twins
from nnit_zoo.build import expert as experts
from nnit_zoo.build.builder import Builder, log
from nnit_zoo.build.distill import DistillConfig
from nnit_zoo.build.expert import ExpertConfig
from nnit_zoo.build.twins import TwinsConfig
from nnit_zoo.display import Display
from nnit_zoo.errors import UserError
from nnit_zoo.files import EXPERT, MANIFEST, sha256_of
from nnit_zoo.parallel import Backend, unordered
from nnit_zoo.tasks.robot import RobotPolicyTask
from nnit_zoo.tasks.task import PROBE

PROBE_STATES = 2000
STD_FLOOR = 0.05  # keeps near-constant observations from being blown up; decides the weight error policies survive


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
        self.distill_config = distill.CONFIG_BY_TASK.get(task.name, DistillConfig())
        self.twins_config = TwinsConfig()

    def expert(self) -> None:
        """Train the expert, then fix the task's standardisation from the states that it visits."""
        if (self.data / EXPERT).exists():
            log("expert: done")
            return
        if (self.data / MANIFEST).exists():
            raise self._other_zoo("by another expert")
        made = self._sign("expert", self.expert_config.model_dump(), works=True)
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
                "build": {"expert": {**record, "config": self.expert_config.model_dump(), "commits": made["commits"]}},
            },
        )
        probe = torch.from_numpy(states[np.arange(PROBE_STATES) * len(states) // PROBE_STATES]).half()
        write_bytes(self.data / PROBE, save({"states": probe}))
        experts.save(network, self.data / EXPERT)
        (self.data / stats.TWINS).unlink(missing_ok=True)  # they were another expert's students
        log(f"expert: {json.dumps(record)}")
        if not experts.good_enough(self.expert_config, record):
            log("expert: it is below the scores to stop at; its students can only be worse")

    def states(self) -> None:
        """Gather the shared buffer of states by DAgger."""
        expert, done = self._expert(), self._states.exists()
        self._sign("states", {**self.distill_config.model_dump(), **self.made_from()}, works=not done)
        if done:
            log("states: done")
        else:
            distill.gather_states(self.task, self.distill_config, expert, self._states.parent, self.workers, log)

    def training(self) -> tuple[Callable[[Path, int], str], dict[str, Any]]:
        """Regression onto the expert, on the buffer and on states of the GHN's own."""
        self._require_states()
        train = partial(distill.train_ghn, self.task, self.distill_config, self._expert(), self._states)
        buffer = {"states": self._count_states(), "states_sha256": sha256_of(self._states)}
        return train, {**self.distill_config.model_dump(), **buffer}

    def made_from(self) -> dict[str, str]:
        """The expert, and what the states that it visits standardise observations by."""
        self._expert()  # says what to do without one
        return {"expert_sha256": sha256_of(self.data / EXPERT), "standardisation": self.task.standardisation}

    def twins(self) -> None:
        """Train and measure NNiT's twin populations; the networks, too large to ship, stay in the work folder."""
        self._require_states()
        config, folder = self.twins_config, self.work / "twins"
        seeds = range(config.networks)
        paths = {kind: [folder / kind / f"{seed:03d}.safetensors" for seed in seeds] for kind in twins.KINDS}
        missing = [(path, kind) for kind in twins.KINDS for path in paths[kind] if not path.exists()]
        settings = {**config.model_dump(), **self.made_from(), "states_sha256": sha256_of(self._states)}
        made = self._sign("twins", settings, works=bool(missing))
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
            "commits": made["commits"],
        }
        write_json(self.data / stats.TWINS, content)
        shutil.rmtree(folder / "units", ignore_errors=True)
        log(f"twins: {json.dumps(populations)}")

    @property
    def _states(self) -> Path:
        return self.work / "states" / "states.safetensors"

    def _require_states(self) -> None:
        if not self._states.exists():
            raise UserError(f"{self.task.name} has no states to learn from; run the stage 'states' first")

    def _expert(self) -> experts.Network:
        path = self.data / EXPERT
        if not path.exists():
            raise UserError(f"{self.task.name} has no expert yet; run the stage 'expert' first")
        return experts.load(path)

    def _count_states(self) -> int:
        return len(load_file(self._states)["states"])
