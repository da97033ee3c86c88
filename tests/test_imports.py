"""The packages import each other in one direction; the commands answer without heavy imports, and compute alike."""

import ast
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ORDER = ["nnit_zoo", "nnit_baselines", "nnit_bench", "nnit_leaderboard"]
# The leaderboard reads result files only: of the benchmark it may know how a record looks, and nothing of the rest.
READS_RECORDS_ONLY = {"nnit_leaderboard": ["nnit_bench"]}
HEAVY = ["torch", "pyarrow.dataset", "mani_skill", "sapien"]


def imported_modules(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
    from_imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert not any(node.level for node in from_imports), f"{path} imports relatively"
    names = {alias.name for node in imports for alias in node.names}
    return names | {node.module for node in from_imports if node.module}


@pytest.mark.parametrize("package", ORDER)
def test_imports_point_in_one_direction(package: str) -> None:
    spec = find_spec(package)
    assert spec is not None and spec.origin is not None
    allowed = [package, *READS_RECORDS_ONLY.get(package, ORDER[: ORDER.index(package)])]
    for path in Path(spec.origin).parent.rglob("*.py"):
        ours = {name.partition(".")[0] for name in imported_modules(path)} & set(ORDER)
        assert ours <= set(allowed), f"{path} imports {ours - set(allowed)}"


@pytest.mark.parametrize("module", ["nnit_zoo", "nnit_zoo.cli", "nnit_bench.cli", "nnit_leaderboard", "nnit_zoo.tasks"])
def test_importing_is_light(module: str) -> None:
    """And so is asking for the tasks' names: a task itself needs torch."""
    ask = "nnit_zoo.tasks.names(); " if module == "nnit_zoo.tasks" else ""
    code = f"import sys, {module}; {ask}print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_imports_no_torch() -> None:
    """That of `nnit-zoo`, which imports still less, is tested with that command."""
    code = "import sys; from nnit_bench.cli import app; app(['--help'], result_action='return_value')"
    code += f"; sys.stderr.write(str([name for name in {HEAVY} if name in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage" in done.stdout and done.stderr == "[]"


def test_networks_do_not_depend_on_the_kind_of_x86_processor() -> None:
    """All have AVX2; the kernels for AVX-512, which some would choose, round otherwise."""
    code = "import sys; from nnit_bench.cli import main; sys.argv = ['nnit-bench', 'check', '--method', 'crop']"
    code += "\ntry: main()\nfinally: import torch; print(torch.backends.cpu.get_cpu_capability())"
    environment = {name: value for name, value in os.environ.items() if name != "ATEN_CPU_CAPABILITY"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split()[-1] == "AVX2"
