"""What runs leave behind keeps loading, and is what the committed schema says."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import nnit_bench
from nnit_bench import novelty, records, scores
from nnit_bench.records import RunRecord
from nnit_zoo.errors import UserError

GOLDEN = sorted(path.parent for path in (Path(__file__).parents[1] / "golden").glob("*/run.json"))
SCHEMA = Path(nnit_bench.__file__).parent / "schema" / "run.schema.json"
UPDATE = 'python -c "from nnit_bench.records import json_schema; print(json_schema(), end=str())"'


def test_the_committed_schema_is_that_of_the_records() -> None:
    assert SCHEMA.read_text() == records.json_schema(), f"write it again with: {UPDATE} > {SCHEMA}"


@pytest.mark.parametrize("folder", GOLDEN, ids=lambda folder: folder.name)
def test_a_run_of_an_earlier_version_loads(folder: Path) -> None:
    """Fields may be added, with a default; none may be renamed, removed or given another meaning."""
    record = RunRecord.read(folder)
    content = json.loads((folder / "run.json").read_text())
    assert holds(json.loads(record.model_dump_json()), content)
    if record.status != "success":
        assert record.error and record.results is None
        return
    episodes = records.read_episodes(folder)
    assert episodes.schema.equals(records.STORED_EPISODE_SCHEMA)
    assert pq.ParquetFile(folder / records.POLICIES).schema_arrow.equals(novelty.SCHEMA)
    again = scores.summarise(episodes, record.protocol)
    assert record.results is not None and again.joint == record.results.joint
    for column, statistics in record.results.estimates.items():
        for name, stored in statistics.items():
            assert again.estimates[column][name].value == pytest.approx(stored.value)


def holds(now: Any, then: Any) -> bool:
    """Whether all that was there is there, with the same values."""
    if isinstance(then, dict):
        return all(name in now and holds(now[name], value) for name, value in then.items())
    return bool(now == then)


def test_there_is_a_golden_run_of_every_kind() -> None:
    found = {(record.status, record.protocol.split) for record in map(RunRecord.read, GOLDEN)}
    assert found >= {("success", "unseen"), ("success", "joint"), ("unsupported", "deep")}


@pytest.mark.parametrize("change", [{"schema_version": 2}, {"status": "done"}, {"novel": 1}])
def test_a_record_of_another_kind_is_refused(change: dict[str, Any], tmp_path: Path) -> None:
    content = json.loads((GOLDEN[0] / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps(content | change))
    with pytest.raises(UserError, match="damaged, or from another version of nnit"):
        RunRecord.read(tmp_path)


def test_the_number_of_workers_is_no_part_of_a_run() -> None:
    """Nor is anything of how a method came to be what it is: its checkpoint's hash says what it is."""
    record = RunRecord.read(GOLDEN[0])
    settings = {"protocol": record.protocol, "zoo_sha256": "z", "code_sha256": "c", "packages": {}}
    first = records.Identity(method=record.method, **settings)
    elsewhere = record.method.model_copy(
        update={"given": record.method.given | {"checkpoint": "x"}, "training": {"seconds": 1}}
    )
    assert records.Identity(method=elsewhere, **settings).run_id == first.run_id
    for change in ({"checkpoint_sha256": "x"}, {"given": {"sampling_steps": 9}}):
        other = record.method.model_copy(update=change)
        assert records.Identity(method=other, **settings).run_id != first.run_id
    assert "workers" not in first.model_dump_json()


def test_stored_results_are_read_without_torch() -> None:
    code = (
        "import sys; from nnit_bench import compare, paper, records, report, results; sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
