"""A run with a task and a generator that need no simulator: what it scores, what it leaves behind, what it reuses."""

import errno
import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from nnit_bench import records, runner
from nnit_bench.protocol import Protocol
from nnit_bench.records import Identity, RunRecord
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError


def silent(label: str, total: int) -> Any:
    return nullcontext(lambda done: None)


def identify(protocol: Protocol, generator: Any) -> Identity:
    method = runner.contestant("seeded", generator, 0.0).method
    return Identity(protocol=protocol, method=method, zoo_sha256="z", code_sha256="c", packages={"torch": "2"})


@pytest.fixture
def run(task: Any, generator: Any, protocol: Protocol, tmp_path: Path) -> Callable[..., runner.Outcome]:
    def run_it(generator: Any = generator, protocol: Protocol = protocol) -> runner.Outcome:
        entrant = runner.contestant("seeded", generator, 0.0)
        code = records.Code(sha256="c", commit=None, dirty=None)
        identity = identify(protocol, generator)
        return runner.run(task, entrant, identity, code, tmp_path, workers=1, stage=silent)

    return run_it


def test_every_episode_is_on_record_and_gives_back_the_results(run: Any, task: Any, protocol: Protocol) -> None:
    outcome = run()
    episodes = records.read_episodes(outcome.folder)
    assert episodes.schema.equals(records.EPISODE_SCHEMA)
    assert episodes.num_rows == 8 * 3 * 6 + 4 * 6
    assert task.calls == [(24, list(protocol.seeds("select"))), (4, list(protocol.seeds("report")))]
    record = RunRecord.read(outcome.folder)
    assert record.status == "success" and record.protocol == protocol
    again = records.plain(runner.summarise(episodes, protocol.top))
    assert json.loads(json.dumps(again)) == record.results


def test_the_best_are_scored_again_under_their_own_numbers(run: Any) -> None:
    rows = records.read_episodes(run().folder).to_pylist()
    skill = {row["policy"]: row["return"] for row in rows if row["phase"] == "select"}
    names = {row["policy"]: row["architecture"] for row in rows if row["phase"] == "select"}
    again = {row["policy"] for row in rows if row["phase"] == "report"}
    assert again == set(sorted(skill, key=skill.__getitem__)[-4:])
    for row in rows:
        assert row["return"] == skill[row["policy"]] and row["architecture"] == names[row["policy"]]


def test_an_architectures_policies_do_not_depend_on_the_others(task: Any, generator: Any, protocol: Protocol) -> None:
    entrant = runner.contestant("seeded", generator, 0.0)
    alone = protocol.model_copy(update={"policies": {"64-64-64-16": 3}})
    everything = {str(batch.architecture): batch for batch in runner.sample(task, entrant, protocol, silent)}
    (one,) = runner.sample(task, entrant, alone, silent)
    assert one.flat().equal(everything["64-64-64-16"].flat())
    reseeded = runner.sample(task, entrant, alone.model_copy(update={"seed": 1}), silent)
    assert not one.flat().equal(reseeded[0].flat())


def test_an_identical_run_is_found_again_and_no_other(
    run: Any, generator: Any, protocol: Protocol, tmp_path: Path
) -> None:
    outcome = run()
    found = runner.finished(identify(protocol, generator), tmp_path)
    assert found is not None and found.reused
    assert found.summary == outcome.summary
    assert runner.finished(identify(protocol.model_copy(update={"seed": 1}), generator), tmp_path) is None
    runner.set_steps("seeded", generator, 9)
    assert runner.finished(identify(protocol, generator), tmp_path) is None


def test_an_interrupted_run_is_repeated(
    run: Any, task: Any, generator: Any, protocol: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*arguments: Any, **options: Any) -> pa.Table:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(task, "evaluate", interrupt)
        run()
    identity = identify(protocol, generator)
    assert RunRecord.read(identity.folder(tmp_path)).status == "started"
    assert runner.finished(identity, tmp_path) is None
    assert run().record.status == "success"


def test_a_failed_run_says_why(
    run: Any, generator: Any, protocol: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = generator.sample(runner.SampleRequest(Architecture(3, (16, 16), 2), 3, 0))
    monkeypatch.setattr(generator, "sample", lambda request: wrong)
    with pytest.raises(UserError, match=r"asked for 3 policies of .* but gave 3 of 16-16"):
        run()
    record = RunRecord.read(identify(protocol, generator).folder(tmp_path))
    assert record.status == "failed"
    assert record.error is not None and "gave 3 of 16-16" in record.error


def test_policies_that_are_not_finite_are_counted(run: Any, generator: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = generator.sample

    def broken(request: runner.SampleRequest) -> Any:
        batch = sample(request)
        batch.layers[1][0] = float("nan")
        return batch

    monkeypatch.setattr(generator, "sample", broken)
    outcome = run()
    assert outcome.zeroed == {"not finite": 8}
    assert outcome.summary.estimates["success_at_end"]["mean"].value < 0.67


def test_a_full_disk_is_told(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(records, "write_atomically", full)
    with pytest.raises(UserError, match=r"no space left in .*--output"):
        run()


def test_a_damaged_record_is_told(run: Any, generator: Any, protocol: Protocol, tmp_path: Path) -> None:
    outcome = run()
    (outcome.folder / "run.json").write_text('{"schema_version": 1, "run_id"')
    with pytest.raises(UserError, match=r"run\.json is damaged"):
        runner.finished(identify(protocol, generator), tmp_path)


def test_steps_of_a_method_without_steps(generator: Any) -> None:
    with pytest.raises(UserError, match="does not sample in steps"):
        runner.set_steps("thing", object(), 5)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="1 or more"):
        runner.set_steps("seeded", generator, 0)


def test_the_zoos_row_holds_the_same_architectures_only(zoo_index: pa.Table, protocol: Protocol) -> None:
    row = runner.zoo_row(zoo_index, protocol)
    assert row is not None
    assert (row.policies, row.episodes, row.summary.worst) == (4, 64, "16-16-16-32")
    assert row.summary.estimates["success_at_end"]["mean"].value == 0.75
    only = protocol.model_copy(update={"policies": {"32-32-16-64": 3}})
    narrow = runner.zoo_row(zoo_index, only)
    assert narrow is not None and narrow.summary.estimates["return"]["mean"].value == 35
    assert runner.zoo_row(zoo_index, protocol.model_copy(update={"policies": {"64-64-64-16": 3}})) is None
