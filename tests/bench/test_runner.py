"""A run with a task and a generator that need no simulator: what it scores, what it leaves behind, what it reuses."""

import errno
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from nnit_baselines.controls.resized import Crop
from nnit_bench import records, runner, scores
from nnit_bench.execution import Execution
from nnit_bench.protocol import Protocol
from nnit_bench.provenance import this_code
from nnit_bench.records import RunRecord
from nnit_zoo.architecture import Architecture
from nnit_zoo.errors import UserError

Run = Callable[..., runner.Outcome]


def silent(label: str, total: int) -> Any:
    return nullcontext(lambda done: None)


def entry_of(generator: Any, **given: Any) -> runner.Entry:
    code = this_code(type(generator).__module__)
    return runner.Entry(runner.describe("seeded", generator, given), code, generator, None, 0.0)


@pytest.fixture
def execution(tmp_path: Path) -> Execution:
    return Execution(output=tmp_path, workers=1)


@pytest.fixture
def run(task: Any, generator: Any, protocol: Protocol, zoo: Any, execution: Execution) -> Run:
    def run_it(**changes: Any) -> runner.Outcome:
        given = {"task": task, "zoo": zoo, "entry": entry_of(generator), "protocol": protocol} | changes
        how = replace(execution, **{"overwrite": given.pop("overwrite", "missing")})
        return runner.run(**given, execution=how, stage=silent)

    return run_it


def test_every_episode_is_on_record_and_gives_back_the_results(run: Run, task: Any, protocol: Protocol) -> None:
    outcome = run()
    episodes = records.read_episodes(outcome.folder)
    assert episodes.schema.equals(records.STORED_EPISODE_SCHEMA)
    assert episodes.num_rows == 8 * 3 * 6 + 4 * 6
    assert protocol.report is not None
    assert task.calls == [(24, list(protocol.select.seeds)), (4, list(protocol.report.seeds))]
    record = RunRecord.read(outcome.folder)
    assert record == outcome.record and record.status == "success" and record.protocol == protocol
    assert scores.summarise(episodes, protocol) == record.results
    first = episodes.to_pylist()[0]
    assert (first["method"], first["training_seed"], first["task_version"]) == ("seeded", 7, 1)
    policies = pq.ParquetFile(outcome.folder / records.POLICIES).read()
    assert policies["policy"].to_pylist() == list(range(24))


def test_identical_inputs_give_identical_files(run: Run) -> None:
    def content(outcome: runner.Outcome) -> tuple[bytes, bytes, RunRecord]:
        changing = {"started", "finished", "timings"}
        record = outcome.record.model_copy(update=dict.fromkeys(changing))
        tables = ((outcome.folder / name).read_bytes() for name in (records.EPISODES, records.POLICIES))
        return *tables, record

    assert content(run()) == content(run(overwrite="always"))


def test_the_best_are_scored_again_under_their_own_numbers(run: Run) -> None:
    outcome = run()
    rows = records.read_episodes(outcome.folder).to_pylist()
    skill = {row["policy"]: row["return"] for row in rows if row["phase"] == "select"}
    names = {row["policy"]: row["architecture"] for row in rows if row["phase"] == "select"}
    again = {row["policy"] for row in rows if row["phase"] == "report"}
    assert again == set(sorted(skill, key=skill.__getitem__)[-4:])
    for row in rows:
        assert row["return"] == skill[row["policy"]] and row["architecture"] == names[row["policy"]]


def test_an_architectures_policies_do_not_depend_on_the_others(task: Any, generator: Any, protocol: Protocol) -> None:
    entry = entry_of(generator)
    alone = protocol.model_copy(update={"policies": {"64-64-64-16": 3}})
    everything = {str(batch.architecture): batch for batch in runner.sample(task, entry, protocol, silent)}
    (one,) = runner.sample(task, entry, alone, silent)
    assert one.flat().equal(everything["64-64-64-16"].flat())
    reseeded = runner.sample(task, entry, alone.model_copy(update={"seed": 1}), silent)
    assert not one.flat().equal(reseeded[0].flat())


def test_networks_do_not_depend_on_the_number_of_threads(task: Any, generator: Any, protocol: Protocol) -> None:
    """Whatever a generator computes, sums are then in one order."""
    seen: list[int] = []

    class Watched(type(generator)):  # type: ignore[misc]
        def sample(self, request: Any) -> Any:
            seen.append(torch.get_num_threads())
            return super().sample(request)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        runner.sample(task, entry_of(Watched()), protocol, silent)
        after = torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
    assert set(seen) == {1} and after == 2


def test_the_generator_chooses_on_joint(run: Run, task: Any) -> None:
    outcome = run(protocol=Protocol.of(task, "joint", policies=10, episodes=4))
    found = outcome.record.results
    assert found is not None and found.joint is not None
    assert (found.joint.distinct, found.joint.unseen, found.joint.outside) == (3, 1, 1)
    assert records.read_episodes(outcome.folder).filter(pa.compute.field("phase") == "select").num_rows == 40


def test_a_test_set_is_scored_once(run: Run, digits: Any) -> None:
    outcome = run(task=digits, protocol=Protocol.of(digits, "unseen", policies=1))
    episodes = records.read_episodes(outcome.folder)
    assert set(episodes["phase"].to_pylist()) == {"select"} and episodes["success_once"].null_count == 64
    found = outcome.record.results
    assert found is not None and list(found.estimates) == ["return"]
    assert "top_heldout" in found.estimates["return"]


def test_what_a_method_cannot_is_unsupported_and_not_zero(run: Run, task: Any, zoo: Any, generator: Any) -> None:
    deep = Protocol.of(task, "deep", policies=1, episodes=2)
    lacking = runner._lacks(generator, zoo, deep)
    assert lacking == "supports no architecture of the split deep"
    mixed = deep.model_copy(update={"policies": {"32-32-32-32": 1, "32-32": 1}})
    assert runner._lacks(generator, zoo, mixed) == "does not support 32-32"
    outcome = run(protocol=deep, entry=replace(entry_of(generator), unsupported=lacking))
    assert outcome.record.status == "unsupported" and outcome.record.results is None
    assert run(protocol=deep, entry=replace(entry_of(generator), unsupported=lacking)).reused
    joint = runner.enter("crop", zoo, Protocol.of(task, "joint"))
    assert joint.unsupported == "does not choose architectures"
    oracle = runner.enter("ghn-oracle", zoo, Protocol.of(task, "wide"))
    assert oracle.unsupported == "the zoo has no policies of the split wide"


def test_an_identical_run_is_found_again_and_no_other(run: Run, protocol: Protocol, generator: Any) -> None:
    first = run()
    found = run()
    assert found.reused and found.record == first.record
    assert not run(protocol=protocol.model_copy(update={"seed": 1})).reused
    assert not run(overwrite="always").reused
    runner.set_sampling_steps("seeded", generator, 9)
    nine = entry_of(generator, sampling_steps=9)
    assert not run(entry=nine).reused and run(entry=nine).reused


def test_an_interrupted_run_keeps_its_work_and_is_finished(
    run: Run, task: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    stores = []

    def interrupt(*arguments: Any, store: Path, **options: Any) -> pa.Table:
        stores.append(store)
        store.mkdir(parents=True, exist_ok=True)
        (store / "unit").write_text("")
        raise KeyboardInterrupt

    for _ in range(2):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(task, "evaluate", interrupt)
            run()
    assert stores[0] == stores[1] and (stores[0] / "unit").exists()
    folder = stores[0].parent
    begun = RunRecord.read(folder)
    assert begun.status == "started"
    with pytest.raises(UserError, match="has not finished; --overwrite missing"):
        run(overwrite="never")
    record = run().record
    assert (record.status, record.resumed, record.started) == ("success", True, begun.started)
    assert sorted(path.name for path in folder.iterdir()) == ["episodes.parquet", "policies.parquet", "run.json"]


def test_a_finished_run_stays_until_its_repetition_is_finished(
    run: Run, task: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = run()
    for what, error in ((KeyboardInterrupt, KeyboardInterrupt), (OSError, OSError)):
        with monkeypatch.context() as patch, pytest.raises(error):
            patch.setattr(task, "evaluate", Mock(side_effect=what))
            run(overwrite="always")
        assert run().reused and run().record == first.record
    again = run(overwrite="always")
    assert again.folder == first.folder and not again.reused and again.record.started > first.record.started
    assert RunRecord.read(first.folder) == again.record
    assert [path.name for path in first.folder.parent.iterdir()] == [first.folder.name]


def test_an_unfinished_run_is_begun_anew_if_all_is_to_be_repeated(
    run: Run, task: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*arguments: Any, store: Path, **options: Any) -> pa.Table:
        store.mkdir(parents=True)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(task, "evaluate", interrupt)
        run(overwrite="always")
    with pytest.raises(UserError, match="has not finished"):
        run(overwrite="never")
    record = run().record  # which goes on
    assert record.resumed and record.status == "success"


def test_a_failed_run_says_why(run: Run, generator: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wrong = generator.sample(runner.SampleRequest(Architecture(3, (16, 16), 2), 3, 0))
    monkeypatch.setattr(generator, "sample", lambda request: wrong)
    with pytest.raises(UserError, match=r"asked for 3 policies of .* but gave 3 of 16-16"):
        run()
    (path,) = tmp_path.rglob("run.json")
    record = RunRecord.read(path.parent)
    assert record.status == "failed"
    assert record.error is not None and "gave 3 of 16-16" in record.error


def test_policies_that_are_not_finite_are_counted(run: Run, generator: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = generator.sample

    def broken(request: runner.SampleRequest) -> Any:
        batch = sample(request)
        batch.layers[1][0] = float("nan")
        return batch

    monkeypatch.setattr(generator, "sample", broken)
    outcome = run()
    assert outcome.zeroed == {"not finite": 8}
    assert outcome.record.results is not None
    assert outcome.record.results.estimates["success_at_end"]["mean"].value < 0.67
    policies = pq.ParquetFile(outcome.folder / records.POLICIES).read()
    assert policies["any_architecture"].null_count == policies["actions"].null_count == 8


def test_a_full_disk_is_told(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(records, "write_atomically", full)
    with pytest.raises(UserError, match=r"no space left in .*--output"):
        run()


def test_what_a_kill_at_the_very_end_leaves_is_cleared(run: Run) -> None:
    left = run().folder / runner.UNITS / "unit"
    left.parent.mkdir()
    left.touch()
    assert run().reused and not left.parent.exists()


def test_a_damaged_record_is_told(run: Run) -> None:
    (run().folder / "run.json").write_text('{"schema_version": 1, "run_id"')
    with pytest.raises(UserError, match=r"run\.json is damaged"):
        run()
    assert not run(overwrite="always").reused


def test_steps_of_a_method_without_steps(generator: Any) -> None:
    with pytest.raises(UserError, match="does not sample in steps"):
        runner.set_sampling_steps("crop", Crop(), 5)
    with pytest.raises(UserError, match="1 or more"):
        runner.set_sampling_steps("seeded", generator, 0)


def test_the_zoos_row_holds_the_same_architectures_only(zoo_index: pa.Table, protocol: Protocol) -> None:
    row = runner.zoo_row(zoo_index, protocol)
    assert row is not None
    assert (row.policies, row.episodes, row.worst) == (4, 64, "16-16-16-32")
    assert row.estimates["success_at_end"]["mean"].value == 0.75
    top = row.estimates["success_at_end"]["top"]
    assert top.low == top.value == top.high  # of given policies, on episodes that are not known: no interval
    only = protocol.model_copy(update={"policies": {"32-32-16-64": 3}})
    narrow = runner.zoo_row(zoo_index, only)
    assert narrow is not None and narrow.estimates["return"]["mean"].value == 35
    assert narrow.estimates["return"]["mean"] == narrow.estimates["return"]["worst"]
    assert narrow.estimates["return"]["mean"].low == 35  # two policies say little of others: no interval
    many = pa.concat_tables([zoo_index] * 3)
    wide = runner.zoo_row(many, only)
    assert wide is not None and wide.estimates["return"]["mean"].low < 35
    assert runner.zoo_row(zoo_index, protocol.model_copy(update={"policies": {"64-64-64-16": 3}})) is None
    chosen = runner.zoo_row(zoo_index, protocol.model_copy(update={"split": "joint", "policies": {"any": 3}}))
    assert chosen is not None and chosen.policies == 1
