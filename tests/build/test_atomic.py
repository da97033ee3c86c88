"""Files that a build writes: whole or not at all, and readable by whom the umask says."""

from __future__ import annotations

import os

import pytest
import torch
from safetensors.torch import save_file

from nnit_zoo.atomic import write_atomically


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_others_may_read_what_the_umask_lets_them(umask, mode, tmp_path):
    before = os.umask(umask)
    try:
        write_atomically(tmp_path / "x", lambda path: save_file({"x": torch.zeros(1)}, path))
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
