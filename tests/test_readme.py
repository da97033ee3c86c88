"""What README and docs tell a newcomer to type: every shell command parses, and the README's example works."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import torch

import nnit_bench.cli
import nnit_zoo.cli
from nnit_baselines import generator
from nnit_baselines.generator import SampleRequest
from nnit_zoo.architecture import Architecture

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [README, *(path.read_text() for path in sorted((ROOT / "docs").glob("*.md")))]
APPS = {"nnit-zoo": nnit_zoo.cli.app, "nnit-bench": nnit_bench.cli.app}


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


COMMANDS = [line for page in PAGES for block in blocks("sh", page) for line in block.splitlines() if line]


@pytest.mark.parametrize("command", COMMANDS)
def test_shell_command_parses(command: str) -> None:
    program, *arguments = shlex.split(command, comments=True)
    if program == "make":
        subprocess.run(["make", "--dry-run", *arguments], cwd=ROOT, capture_output=True, check=True)
    else:
        APPS[program].parse_args(arguments, exit_on_error=False, print_error=False)


def test_plug_in_example_generates_networks(tmp_path: Path) -> None:
    (example,) = (block for block in blocks("python") if "Generator" in block)
    path = tmp_path / "my_method.py"
    path.write_text(example)
    method = generator.get(f"{path}:Fresh")()
    request = SampleRequest(Architecture(42, (32, 32, 16, 64), 8), policies=3, seed=0)
    batch = method.sample(request)
    assert len(batch) == 3 and batch.architecture == request.architecture
    assert torch.equal(batch.flat(), method.sample(request).flat())


@pytest.mark.parametrize("path", re.findall(r"\]\((?!http)([^)]+)\)", README))
def test_linked_file_exists(path: str) -> None:
    assert (ROOT / path).is_file()
