"""Stored runs become tables, figures and rows beside the paper's."""

import csv
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from nnit_baselines import registry
from nnit_bench import paper, results, tables
from nnit_bench.protocol import Protocol, SeedRange
from nnit_bench.records import Distance, Novelty
from nnit_bench.report import _by_architecture, report
from nnit_bench.results import StoredRun
from nnit_bench.runner import Outcome
from nnit_bench.statistics import Estimate
from nnit_zoo.errors import UserError
from nnit_zoo.tasks.metric import Metric

from .conftest import store_run

Store = Callable[..., StoredRun]


def outcomes(level: float, policies: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((policies, 10)) < level


@pytest.fixture
def pick(task: Any) -> Protocol:
    """A protocol like PickCube's, without its second phase."""
    return Protocol.of(task, "unseen", episodes=10).model_copy(update={"task": "PickCube-v1", "report": None})


def joint_of(protocol: Protocol) -> Protocol:
    return protocol.model_copy(update={"split": "joint", "policies": {"any": 100}})


def test_every_number_stands_in_its_column(
    store: Store, pick: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = store("nnit", pick, outcomes(0.9, 80))
    assert run.record.results is not None
    values = {"mean": 0.1, "top": 0.2, "top_heldout": 0.3, "worst": 0.4}
    exact = {name: Estimate(value, value, value) for name, value in values.items()}
    novelty = Novelty(
        same_architecture=Distance(median=0.5, heldout=None, ratio=1.5),
        any_architecture=Distance(median=0.6, heldout=None, ratio=1.6),
        actions=Distance(median=0.7, heldout=None, ratio=1.7),
        copies=8,
        pairwise_l2=0.9,
        pairwise_cosine=0.95,
    )
    found = replace(
        run.record.results, estimates={metric.column: exact for metric in pick.metrics}, worst="16-16-16-32"
    )
    record = run.record.model_copy(update={"results": found, "novelty": novelty})
    tables.show(tables.Results(pick, [Outcome(record, run.folder, reused=False, zeroed={})], None))
    scores, new = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("nnit "))
    assert scores[-4:] == ["10.0", "20.0", "30.0", "40.0"]
    assert new == ["nnit", "50.0%", "(1.50)", "60.0%", "(1.60)", "0.700", "(1.70)", "8", "0.95"]

    record.write(run.folder)
    monkeypatch.setattr(StoredRun, "summary", found)
    report(folders=(tmp_path,), output=tmp_path / "report")
    row = "| nnit | 10.0 | 20.0 | 30.0 | 40.0 16-16-16-32 |  | 50.0% (1.50) | 8 of 80 |"
    assert row in (tmp_path / "report" / "report.md").read_text().splitlines()


def test_a_damaged_record_stops_nothing(store: Store, pick: Protocol, capsys: pytest.CaptureFixture[str]) -> None:
    good = store("nnit", pick, outcomes(0.9, 80))
    bad = store("crop", pick, outcomes(0.9, 80))
    (bad.folder / "run.json").write_text("{")
    root = good.folder.parents[3]
    assert [run.record.method.name for run in results.find([root, root / "nowhere"])] == ["nnit"]
    assert "warning: left out: " in capsys.readouterr().err


def test_the_newest_whole_run_is_taken(store: Store, pick: Protocol) -> None:
    old, new = (store("nnit", pick, outcomes(0.9, 80), zoo=zoo) for zoo in ("old", "new"))
    other = store("nnit", pick.model_copy(update={"seed": 1}), outcomes(0.9, 80))
    assert other.departures == ("seed 1",) and new.departures == ()
    part = pick.model_copy(update={"policies": {"16-16-16-32": 10}})
    part_of_it = store("nnit", part, outcomes(0.9, 10))
    found = results.find([old.folder.parents[3]])
    assert len(found) == 4 and not part_of_it.is_whole
    assert results.resolve("nnit", found, "PickCube-v1", "unseen").record.run_id == new.record.run_id
    by_folder = results.resolve(str(part_of_it.folder), found, "", "")
    assert by_folder.record.run_id == part_of_it.record.run_id


def test_a_run_with_settings_of_its_own_does_not_stand_for_the_method_and_is_marked(
    store: Store, pick: Protocol, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = store("nnit", pick, outcomes(0.9, 80), given={"sampling_steps": 2})
    report(folders=(tmp_path,), output=tmp_path / "report")
    assert "\n| nnit, 2 sampling steps |" in (tmp_path / "report" / "report.md").read_text()
    paper.reproduce(table="full-distribution", folders=(tmp_path,))
    assert "with 2 sampling steps: NNiT on PickCube-v1, unseen" in capsys.readouterr().out
    usual = store("nnit", pick, outcomes(0.9, 80))
    newer = few.record.model_copy(update={"started": datetime.now(UTC)})
    newer.write(few.folder)
    chosen = results.latest(results.find([tmp_path]))["PickCube-v1", "unseen", "nnit"]
    assert chosen.folder.resolve() == usual.folder.resolve()

    store("nnit", pick.model_copy(update={"selection": "paper"}), outcomes(0.9, 80))
    refused = store("nnit", pick, outcomes(0.9, 80), zoo="another")
    refused.record.model_copy(update={"results": None}).stop(refused.folder, "unsupported", "it cannot")
    chosen = results.latest(results.find([tmp_path]))["PickCube-v1", "unseen", "nnit"]
    assert chosen.folder.resolve() == usual.folder.resolve()

    own = store("nnit", pick, outcomes(0.9, 80), given={"checkpoint": "runs/mine"}, zoo="newer")
    chosen = results.latest(results.find([tmp_path]))["PickCube-v1", "unseen", "nnit"]
    assert chosen.folder.resolve() == own.folder.resolve()
    paper.reproduce(table="full-distribution", folders=(tmp_path,))
    assert "with checkpoint runs/mine: NNiT on PickCube-v1, unseen" in capsys.readouterr().out


def test_without_matplotlib_there_are_tables(
    store: Store, pick: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    store("nnit", pick, outcomes(0.9, 80))
    report(folders=(tmp_path,), output=tmp_path / "with")
    assert "matplotlib" not in capsys.readouterr().err
    monkeypatch.setattr(sys.modules[report.__module__], "find_spec", lambda name: None)
    report(folders=(tmp_path,), output=tmp_path / "without")
    assert "pip install 'nnit[figures]'" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "without").iterdir()) == ["report.csv", "report.json", "report.md"]


def test_the_figure_has_the_architectures_of_all_runs(store: Store, pick: Protocol) -> None:
    """The best run may be one of a single architecture."""
    one = store("crop", pick.model_copy(update={"policies": {"16-64-64-32": 10}}), outcomes(1.0, 10))
    axes = _by_architecture([one, store("nnit", pick, outcomes(0.5, 80))]).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == list(pick.policies)


def test_ties_are_told_for_every_pair_that_can_be_compared(store: Store, pick: Protocol, tmp_path: Path) -> None:
    store("ghn-oracle", pick, outcomes(1.0, 80))
    store("nnit", pick, outcomes(0.8, 80))
    store("crop", pick, outcomes(0.8, 80))
    elsewhere = pick.model_copy(update={"policies": {"16-16-16-32": 10}})
    store("nearest", elsewhere, outcomes(0.8, 10))
    another = pick.model_copy(update={"policies": {"16-64-64-32": 10}})
    store("random", another, outcomes(0.0, 10))
    report(folders=(tmp_path,), output=tmp_path / "report")
    rows = [line.split(" | ") for line in (tmp_path / "report" / "report.md").read_text().splitlines()]
    ties = {row[0].removeprefix("| ").split(" (")[0]: row[5] for row in rows if len(row) == 8}
    assert "crop" in ties["nnit"] and "nnit" in ties["crop"] and ties["ghn-oracle"] == ""
    assert ties["random"] == ""


def test_shipped_runs_are_marked_and_give_way_to_newer_ones(
    pick: Protocol, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped, mine = tmp_path / "shipped", tmp_path / "mine"
    monkeypatch.setattr(results, "SHIPPED", shipped)
    place = store_run(shipped, "nnit", pick, outcomes(0.9, 80)).folder.relative_to(shipped)
    store_run(mine, "crop", pick, outcomes(0.5, 80))
    folders = (mine, shipped)
    report(folders=folders, output=tmp_path / "report", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert {run["method"]["name"]: run["shipped"] for run in printed} == {"nnit": True, "crop": False}
    text = (tmp_path / "report" / "report.md").read_text()
    assert "\n| nnit, shipped |" in text and "\n| crop |" in text
    rows = csv.DictReader((tmp_path / "report" / "report.csv").open())
    assert {(row["method"], row["shipped"]) for row in rows} == {("nnit", "True"), ("crop", "False")}
    paper.reproduce(table="full-distribution", folders=folders)
    assert "shipped, not run here: NNiT on PickCube-v1, unseen" in capsys.readouterr().out

    def chosen() -> Path:
        return results.latest(results.find(folders))["PickCube-v1", "unseen", "nnit"].folder

    shutil.copytree(shipped / place, mine / place)  # the very same run
    assert chosen() == mine / place
    shutil.rmtree(mine / place)
    quick = pick.model_copy(update={"select": SeedRange(first=pick.select.first, count=5)})
    store_run(mine, "nnit", quick, outcomes(0.9, 80)[:, :5])
    assert chosen() == shipped / place
    again = store_run(mine, "nnit", pick, outcomes(0.8, 80), zoo="newer")
    assert chosen() == again.folder


def test_a_missing_run_is_answered_with_its_command(
    store: Store, pick: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [store("nnit", pick, outcomes(0.9, 80)), store("crop", pick, outcomes(0.9, 80))]
    command = "nnit-bench run --method crop --task PushCube-v1 --split seen$"
    with pytest.raises(UserError, match=f"no stored run of crop on PushCube-v1, seen; make one with: {command}"):
        results.resolve("crop", found, "PushCube-v1", "seen")
    monkeypatch.setattr(registry, "CHECKPOINTS", Path("none"))
    command = "nnit-bench train --method nnit --task PushCube-v1, then nnit-bench run --method nnit --task PushCube-v1"
    with pytest.raises(UserError, match=f"{command} --split seen --checkpoint runs/nnit/PushCube-v1$"):
        results.resolve("nnit", found, "PushCube-v1", "seen")
    with pytest.raises(UserError, match=r"no task named 'PushCub-v1': did you mean PushCube-v1"):
        results.resolve("crop", found, "PushCub-v1", "seen")
    with pytest.raises(UserError, match=r"no split named 'unsen': did you mean unseen"):
        results.resolve("crop", found, "PickCube-v1", "unsen")
    with pytest.raises(UserError, match=r"no run in results/typo: there is no run\.json"):
        results.resolve("results/typo", found, "PickCube-v1", "unseen")
    with pytest.raises(UserError, match=r"no stored method named 'nit': did you mean nnit\?; make it with: nnit-bench"):
        results.resolve("nit", found, "PickCube-v1", "unseen")


def test_report_has_every_method_and_its_figures(
    store: Store, pick: Protocol, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store("nnit", pick, outcomes(0.9, 80))
    store("crop", pick, outcomes(0.9, 80, seed=1))
    store("random", pick, outcomes(0.1, 80))
    store("nnit", joint_of(pick), outcomes(0.9, 100))
    output = tmp_path / "report"
    report(folders=(tmp_path,), output=output, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert json.loads((output / "report.json").read_text()) == printed and len(printed) == 4

    lines = (output / "report.md").read_text().splitlines()
    of_unseen = lines[: lines.index("## PickCube-v1, joint")]
    rows = [line for line in of_unseen if line.startswith(("| nnit", "| crop", "| random"))]
    assert [row.split(" | ")[5] for row in rows] == ["nnit", "crop", ""]
    assert rows[2].startswith("| random") and rows[2].endswith("| 2.0% (0.02) | 0 of 80 |")
    assert "- NNiT, here: settings of its own, not the paper's (docs/nnit.md)" in lines
    assert any(line.startswith("| NNiT, unseen | paper | 38.70 ±0.36 | 99") for line in lines)

    values = list(csv.DictReader((output / "report.csv").open()))
    means = [row for row in values if row["statistic"] == "mean" and not row["architecture"]]
    assert len(means) == 4 * 3
    found = results.latest(results.find([tmp_path]))["PickCube-v1", "unseen", "random"].record.results
    assert found is not None
    (mine,) = (row for row in means if row["method"] == "random" and row["metric"] == "success_at_end")
    assert float(mine["low"]) == found.estimates["success_at_end"]["mean"].low

    for name in ("architectures-PickCube-v1-unseen", "top-PickCube-v1-unseen", "top-PickCube-v1-joint"):
        assert (output / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert not (output / "architectures-PickCube-v1-joint.png").exists()
    before = {path.name: path.read_bytes() for path in output.iterdir()}
    report(folders=(tmp_path,), output=output)
    assert {path.name: path.read_bytes() for path in output.iterdir()} == before


def test_nothing_to_report_is_answered(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="make one with: nnit-bench run"):
        report(folders=(tmp_path,), output=tmp_path / "report")


def test_our_row_stands_under_the_papers(
    store: Store, pick: Protocol, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper.places, "tasks_with_zoo", lambda: ("PickCube-v1",))
    run = store("nnit", pick, outcomes(0.9, 80))
    folders = (run.folder.parents[3],)
    (table,) = paper.main_table(results.latest(results.find(folders)))
    rows = {row.label: row.cells for row in table.rows if row.source == "here"}
    assert run.record.results is not None
    top = run.record.results.estimates["success_at_end"]["top"]
    assert rows["NNiT, unseen"][1] == paper.Number.of(top, 100)
    assert rows["NNiT, seen"] == (None,) * 6
    assert "missing: nnit-bench run --method nnit --task PickCube-v1 --split seen" in table.notes
    assert "missing: SANE is not in this version of nnit" in table.notes
    assert paper.PUSH_SCALE not in table.notes  # nothing is shown of that task

    (full,) = paper.full_distribution(results.latest(results.find(folders)))
    worst = run.record.results.estimates["success_at_end"]["worst"]
    cells = {row.label: row.cells for row in full.rows if row.source == "here"}
    assert cells["worst arch., NNiT"][0] == paper.Number.of(worst, 100)
    assert cells["mean of 80, nearest"] == (None, None, None)
    assert any(note.startswith("nearest, crop: not in the paper") for note in full.notes)

    paper.reproduce(table="main", folders=folders)
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines() if not line.startswith("missing")) <= 80
    paper.reproduce(table="full-distribution", folders=folders, as_json=True)
    assert json.loads(capsys.readouterr().out)[0]["rows"][0]["cells"][0]["value"] == 78.8


def test_the_papers_data_set_stands_over_the_mean_of_our_seen_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = {"split": ["seen", "seen", "unseen"], "return": [40.0, 38.5, 0.0], "success_at_end": [1.0, 0.9, 0.0]}
    monkeypatch.setattr(paper.places, "tasks_with_zoo", lambda: ("PushCube-v1", "MNIST-PCA32"))
    monkeypatch.setattr(paper.places, "index", lambda task: pa.table(columns))
    (table,) = paper.main_table({})
    theirs, ours = table.rows[:2]
    assert (theirs.label, ours.label, ours.source) == ("Dataset, seen", "Dataset, seen", "here")
    assert [cell and cell.value for cell in theirs.cells[2:4]] == [42.02, 100]
    assert [cell and cell.value for cell in ours.cells] == [None, None, 39.2, 95, None, None]
    assert paper.PUSH_SCALE in table.notes


def test_runs_of_other_versions_are_summarised_alike(
    store: Store, pick: Protocol, capsys: pytest.CaptureFixture[str]
) -> None:
    """What an earlier version wrote into run.json does not count: the episodes do."""
    run = store("nnit", pick, outcomes(0.9, 80))
    assert run.record.results is not None
    estimates = {metric: {"mean": Estimate(0.5, 0.1, 2.0)} for metric in run.record.results.estimates}
    old = run.record.model_copy(update={"results": replace(run.record.results, estimates=estimates)})
    old.write(run.folder)
    folders = (run.folder.parents[3],)
    report(folders=folders, output=run.folder.parents[3] / "report", as_json=True)
    (shown,) = json.loads(capsys.readouterr().out)
    expected = run.record.results.estimates["success_at_end"]
    assert shown["results"]["estimates"]["success_at_end"]["mean"]["high"] == expected["mean"].high
    (table,) = paper.main_table(results.latest(results.find(folders)))
    assert paper.Number.of(expected["top"], 100) in {cell for row in table.rows for cell in row.cells}


def test_what_the_generator_chose_stands_beside_the_papers(store: Store, pick: Protocol) -> None:
    run = store("nnit", joint_of(pick), outcomes(0.9, 100))
    scores, chosen = paper.joint(results.latest([run]))
    assert scores.rows[1].cells[0] is not None
    assert [cell and cell.value for cell in chosen.rows[1].cells] == [1, 1, 100, 1]


def test_networks_above_80_percent_are_counted(store: Store, digits: Any) -> None:
    accuracy = (Metric(column="return", label="accuracy", unit="%"),)
    protocol = Protocol.of(digits, "unseen").model_copy(update={"task": "MNIST-PCA32", "metrics": accuracy})
    values = np.full((80, 8), 0.95)
    values[:3] = 0.7
    (table,) = paper.mnist(results.latest([store("nnit", protocol, values)]))
    mean, above = table.rows[1].cells
    assert mean is not None and mean.value == pytest.approx(100 * values.mean(), rel=1e-6)
    assert above is not None and above.value == 77
