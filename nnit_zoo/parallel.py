"""Units of work in several processes or on a Ray cluster; a process that dies costs what was in work, nothing else."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from importlib.util import find_spec
from itertools import islice
from typing import Literal, TypeVar

from nnit_zoo.errors import UserError

Backend = Literal["processes", "ray"]
Unit = TypeVar("Unit")
Result = TypeVar("Result")

_log = logging.getLogger(__name__)
_TRIES = 3
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def unordered(
    work: Callable[[Unit], Result], units: Iterable[Unit], workers: int, backend: Backend = "processes"
) -> Iterator[tuple[Unit, Result]]:
    """Each unit with `work(unit)`, in the order they finish, at most `workers` at a time.

    `processes` are of this machine, and one worker is this process itself; `ray` is the cluster that RAY_ADDRESS names,
    or a new one on this machine. A unit whose process dies is repeated. Raises UserError, with the unit as text, if
    that goes on; for less than one worker; and if Ray is not installed.
    """
    if workers < 1:
        raise UserError(f"there must be 1 worker or more, not {workers}")
    if backend == "ray":
        return _on_ray(work, units, workers)
    if workers == 1:
        return ((unit, work(unit)) for unit in units)
    return _in_processes(work, units, workers)


def in_chunks(work: Callable[[range], Result], numbers: range, size: int, workers: int) -> list[Result]:
    """The results of `work` for each `size` numbers in turn, in their order, from processes as in `unordered`."""
    chunks = [numbers[start : start + size] for start in range(0, len(numbers), size)]
    results = dict(unordered(work, chunks, workers))
    return [results[chunk] for chunk in chunks]


def _in_processes(work: Callable[[Unit], Result], units: Iterable[Unit], workers: int) -> Iterator[tuple[Unit, Result]]:
    # Not joblib.Parallel: when its pool breaks, it does not say what was in work.
    from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415  only parallel work needs it
    from joblib.externals.loky.process_executor import TerminatedWorkerError  # noqa: PLC0415

    # One death takes the whole pool down. Half as many units then go at a time, one more again with each that finishes:
    # that needs less memory, and soon has the unit that kills alone.
    queue = deque(units)
    workers = min(workers, len(queue))
    at_once, deaths = workers, 0
    while queue:
        pool = get_reusable_executor(workers, timeout=60, env=_ONE_THREAD)  # a new one if the last is broken
        started: dict[Future[Result], Unit] = {}
        try:
            while queue or started:
                while queue and len(started) < at_once:
                    started[pool.submit(work, queue[0])] = queue[0]
                    queue.popleft()
                for future in wait(started, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    at_once, deaths = min(workers, at_once + 1), 0
                    yield started.pop(future), result
        except TerminatedWorkerError:
            lost = list(started.values())
            deaths += len(lost) == 1
            if deaths == _TRIES:
                raise _deadly(lost[0]) from None
            _log.warning("a worker process died, perhaps for lack of memory; its work is repeated")
            queue.extendleft(reversed(lost))
            at_once = max(1, at_once // 2)
        except BaseException:  # an error in the work, Ctrl-C, or nobody asks for the rest
            pool.shutdown(kill_workers=True)
            raise


def _on_ray(work: Callable[[Unit], Result], units: Iterable[Unit], workers: int) -> Iterator[tuple[Unit, Result]]:
    # Not joblib's Ray backend: it gives nothing back before everything is done, and does not repeat lost work.
    if find_spec("ray") is None:
        raise UserError("this needs Ray, which is not installed; run: pip install 'nnit[ray]'")
    import ray  # noqa: PLC0415  an optional extra

    if not ray.is_initialized():
        ray.init(logging_level=logging.WARNING)

    @ray.remote(max_retries=_TRIES - 1)
    def remote(unit: Unit) -> Result:
        return work(unit)

    waiting = iter(units)
    started = {remote.remote(unit): unit for unit in islice(waiting, workers)}
    while started:
        [done], _ = ray.wait(list(started))
        unit = started.pop(done)
        try:
            result = ray.get(done)
        except (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError, ray.exceptions.OutOfMemoryError):
            raise _deadly(unit) from None
        started |= {remote.remote(unit): unit for unit in islice(waiting, 1)}
        yield unit, result


def _deadly(unit: object) -> UserError:
    return UserError(f"a worker process died {_TRIES} times in work on {unit}; is there enough memory?")
