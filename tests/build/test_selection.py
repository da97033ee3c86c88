"""Which candidates a zoo keeps."""

from __future__ import annotations

import pyarrow as pa

from nnit_zoo import tasks
from nnit_zoo.build.selection import select


def scores_of(means):
    rows = [
        {"architecture": "x", "ghn_seed": seed, "seed": episode, "return": returns, "success_once": True}
        | {"success_at_end": episode < round(success * 10)}
        for seed, (success, returns) in enumerate(means)
        for episode in range(10)
    ]
    return pa.Table.from_pylist(rows)


def test_selection_keeps_the_best_that_reach_both_thresholds():
    task = tasks.get("PickCube-v1")
    scores = scores_of([(0.9, 36.0), (1.0, 34.0), (0.8, 40.0), (1.0, 35.0)])
    rows = list(select(task, "seen", "x", scores))
    assert [row["kept"] for row in rows] == [row["passed"] for row in rows] == [True, False, False, True]
    assert [row["success_at_end"] for row in rows] == [0.9, 1.0, 0.8, 1.0]
    assert all(row["kept"] for row in select(task, "unseen", "x", scores))

    many = scores_of([(0.9 + 0.1 * (seed % 2), 36.0) for seed in range(120)])
    kept = [row["ghn_seed"] for row in select(task, "seen", "x", many) if row["kept"]]
    assert all(row["passed"] for row in select(task, "seen", "x", many))
    assert len(kept) == 100 and set(range(1, 120, 2)) <= set(kept)
