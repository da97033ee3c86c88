"""Files that a build writes: whole or not at all, and readable by whom the umask says."""

from __future__ import annotations

import errno
import os
import resource
from pathlib import Path

import numpy as np
import pytest
import torch

from nnit_zoo import ghn_file
from nnit_zoo.atomic import write_atomically, write_bytes
from nnit_zoo.build import distill, expert
from nnit_zoo.build.fit import save_ghn
from nnit_zoo.ghn import GHN
from nnit_zoo.tasks.pick_cube import PickCube


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_others_may_read_what_the_umask_lets_them(umask, mode, tmp_path):
    before = os.umask(umask)
    try:
        write_bytes(tmp_path / "x", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "x").stat().st_mode & 0o777 == mode


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path):
    def fail(path):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    (tmp_path / "x").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "x", fail)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_what_went_wrong_is_told_even_if_nothing_can_be_cleared_up(tmp_path, monkeypatch):
    def fail(path, **_):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "unlink", fail)
    with pytest.raises(OSError, match=f"Read-only.*{tmp_path / 'x'}"):
        write_atomically(tmp_path / "x", fail)


@pytest.fixture
def no_space():
    """No file of this process may become longer than 8 bytes, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


WRITERS = {
    "an expert's training": lambda path: expert.Training(PickCube(), expert.ExpertConfig(hidden=8)).save(path),
    "an expert": lambda path: expert.save([(np.zeros((2, 2), np.float32), np.zeros(2, np.float32))], path),
    "states": lambda path: distill._save_states(path, np.zeros((2, 42), np.float32)),
    "a GHN": lambda path: save_ghn(GHN(42, 8, 0), path, seed=0, loss=0.0),
    "GHNs": lambda path: ghn_file.write(path, ghn_file.GHNs("PickCube-v1", 42, 8, {0: {"w": torch.zeros(9)}})),
}


@pytest.mark.parametrize("what", WRITERS)
def test_a_full_disk_names_the_file_and_leaves_the_old_one(what, tmp_path, no_space):
    path = tmp_path / "x"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match=str(path)):
        WRITERS[what](path)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]
