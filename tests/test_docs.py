"""The documentation builds without a warning, the API reference from the docstrings included."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_documentation_builds_without_warnings(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", str(tmp_path)]
    run = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "TrainingView" in (tmp_path / "api.html").read_text()
