"""The commit of the code that runs is told, and only of its own checkout."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from nnit_zoo import provenance


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository with one commit, and our module lying in it."""

    def git(*arguments: str) -> None:
        subprocess.run(["git", "-C", tmp_path, *arguments], check=True, capture_output=True)

    git("init")
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("-c", "user.name=n", "-c", "user.email=e", "commit", "-m", "first")
    shutil.copy(provenance.__file__, tmp_path / "provenance.py")
    return tmp_path


def load(folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("copied_provenance", folder / "provenance.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_a_package_in_somebody_elses_checkout_has_no_commit(checkout: Path) -> None:
    found = load(checkout).commit()
    assert (found.sha, found.dirty, str(found)) == (None, None, "unknown")


def test_the_commit_and_whether_it_was_changed(checkout: Path) -> None:
    subprocess.run(["git", "-C", checkout, "add", "provenance.py"], check=True)
    command = ["git", "-C", checkout, "-c", "user.name=n", "-c", "user.email=e", "commit", "-m", "second"]
    subprocess.run(command, check=True, capture_output=True)
    head = subprocess.run(["git", "-C", checkout, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    sha = head.stdout.strip()
    module = load(checkout)
    assert (module.commit().sha, module.commit().dirty, str(module.commit())) == (sha, False, sha)
    zoo = checkout / "nnit_zoo" / "data" / "Task-v1" / "ghns.safetensors"
    zoo.parent.mkdir(parents=True)
    zoo.write_text("a zoo")
    assert module.commit().dirty is False
    splits = zoo.parents[1] / "architectures.json"
    splits.write_text("other splits")
    assert module.commit().dirty is True
    splits.unlink()
    (checkout / "file").write_text("two")
    assert str(module.commit()) == f"{sha}-dirty"
