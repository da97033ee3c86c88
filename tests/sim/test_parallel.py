"""Work in several processes or on Ray: what a dead worker costs, what an interruption keeps, what bad input says."""

from __future__ import annotations

import os
import signal
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from nnit_zoo import parallel, tasks
from nnit_zoo.architecture import architectures
from nnit_zoo.errors import UserError
from nnit_zoo.parallel import in_chunks, unordered
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.tasks import robot

TASK = tasks.get("PickCube-v1")
RAY = pytest.param("ray", marks=[pytest.mark.slow, pytest.mark.skipif(not find_spec("ray"), reason="needs Ray")])


@pytest.fixture(scope="module")
def local_ray():
    """A Ray cluster of this machine with two CPUs."""
    ray = pytest.importorskip("ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(num_cpus=2, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture(params=["processes", RAY])
def backend(request):
    if request.param == "ray":
        request.getfixturevalue("local_ray")
    return request.param


def square_or_die(folder, deadly, lives):
    """Work that squares a number; the deadly one kills its process the first `lives` times."""

    def work(number):  # not at module level: a worker process cannot import this file
        with (folder / str(number)).open("a") as tries:
            tries.write("x")
        if number == deadly and len((folder / str(number)).read_text()) <= lives:
            os.kill(os.getpid(), signal.SIGKILL)
        return number**2

    return work


def test_a_dead_worker_costs_only_what_was_in_work(backend, tmp_path, caplog):
    work = square_or_die(tmp_path, deadly=5, lives=1)
    assert sorted(unordered(work, range(12), 2, backend)) == [(number, number**2) for number in range(12)]
    tries = {number: len((tmp_path / str(number)).read_text()) for number in range(12)}
    assert tries[5] == 2
    assert sum(tries.values()) <= 12 + 2  # the deadly one and its neighbour
    assert backend == "ray" or caplog.messages == [
        "a worker process died, perhaps for lack of memory; its work is repeated"
    ]


def test_a_unit_that_kills_every_time_is_named(backend, tmp_path):
    work = square_or_die(tmp_path, deadly=5, lives=9)
    finished = []
    with pytest.raises(UserError, match="died 3 times in work on 5"):
        for number, _ in unordered(work, range(12), 2, backend):
            finished.append(number)
    assert set(range(4)) <= set(finished)


def test_chunks_keep_their_order_whoever_dies(tmp_path):
    work = square_or_die(tmp_path, deadly=0, lives=1)
    results = in_chunks(lambda chunk: (work(chunk.start), len(chunk)), range(8), 3, 2)
    assert results == [(0, 3), (9, 3), (36, 2)]


def test_an_error_in_the_work_is_the_callers(backend):
    def work(number):
        return 1 / number

    with pytest.raises(ZeroDivisionError):
        list(unordered(work, [1, 0, 2], 2, backend))


def test_workers_and_a_missing_ray_are_answered(monkeypatch):
    with pytest.raises(UserError, match="1 worker or more, not 0"):
        unordered(abs, [1], 0)
    monkeypatch.setattr(parallel, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'nnit\[ray\]'"):
        list(unordered(abs, [1], 2, "ray"))


def policies(count=3, scale=1.0, seed=0):
    """Random policies of a seen architecture."""
    architecture = architectures("seen", TASK.inputs, TASK.outputs)[0]
    draws = torch.Generator().manual_seed(seed)
    shapes = [(count, *shape) for shape in architecture.block_shapes]
    return PolicyBatch(architecture, tuple(scale * torch.randn(shape, generator=draws) for shape in shapes))


@pytest.mark.slow
def test_ray_gives_the_same_bits(local_ray):
    table = TASK.evaluate([policies()], [1, 2], workers=1)
    assert TASK.evaluate([policies()], [1, 2], workers=2, parallel="ray").equals(table)


@pytest.fixture
def played(monkeypatch):
    """The number of episodes in each unit that is really played, with two episodes to a unit."""
    units, score = [], robot._score
    monkeypatch.setitem(robot.SCENES, "fast", 2)
    monkeypatch.setattr(robot, "_score", lambda task, unit: units.append(len(unit)) or score(task, unit))
    return units


class Stop:
    """Interrupts when so many episodes are done."""

    def __init__(self, after):
        self.left = after

    def __call__(self, done):
        self.left -= done
        if self.left <= 0:
            raise KeyboardInterrupt


def test_an_interrupted_call_goes_on_where_it_stopped(tmp_path, played):
    with pytest.raises(KeyboardInterrupt):
        TASK.evaluate([policies()], [1, 2, 3, 4], workers=1, store=tmp_path, progress=Stop(6))
    assert played == [2, 2, 2]
    next(tmp_path.iterdir()).write_bytes(b"")  # as a power cut may leave it
    progress = []
    table = TASK.evaluate([policies()], [1, 2, 3, 4], workers=1, store=tmp_path, progress=progress.append)
    assert played == [2] * 7 and sum(progress) == 12
    assert table.equals(TASK.evaluate([policies()], [1, 2, 3, 4], workers=1))


def test_finished_units_serve_nothing_but_the_same_episodes(tmp_path, played):
    TASK.evaluate([policies(1)], [1, 2], workers=1, store=tmp_path)
    TASK.evaluate([policies(1)], [1, 2], workers=1, store=tmp_path)
    assert len(played) == 1
    TASK.evaluate([policies(1, seed=1)], [1, 2], workers=1, store=tmp_path)
    TASK.evaluate([policies(1)], [1, 3], workers=1, store=tmp_path)
    TASK.evaluate([policies(1)], [2, 1], workers=1, store=tmp_path)
    newer = TASK.simulated_by("fast")
    newer.record = {**TASK.record, "observation_std": [1.0] * TASK.inputs}
    newer.evaluate([policies(1)], [1, 2], workers=1, store=tmp_path)
    assert len(played) == 5


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scale", [6e4, 3e38])
def test_huge_weights_play_on_and_leave_their_neighbours_alone(scale):
    tame, huge = policies(1), policies(1, scale)
    huge = PolicyBatch(huge.architecture, tuple(layer.clamp(-scale, scale) for layer in huge.layers))
    rows = TASK.evaluate([huge, tame], [1], workers=1).to_pylist()
    assert np.isfinite(rows[0]["return"]) and rows[0]["reason"] is None
    assert {**rows[1], "policy": 0} == TASK.evaluate([tame], [1], workers=1).to_pylist()[0]


@pytest.mark.parametrize(
    ("batch", "seed", "workers", "message"),
    [
        (policies(0), 1, 1, "at least one policy"),
        (policies(1), 2**32, 1, "up to 4294967295"),
        (policies(1), 1, 0, "1 worker or more"),
    ],
)
def test_bad_input_is_answered_in_words(batch, seed, workers, message):
    with pytest.raises(UserError, match=message):
        TASK.evaluate([batch], [seed], workers=workers)


def test_the_largest_seed_plays():
    assert len(TASK.evaluate([policies(1)], [2**32 - 1], workers=1)) == 1
