"""Plug-ins: the worked example in the docs, and a package installed from `tests/plugin_package`."""

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from nnit_baselines import registry
from nnit_bench.check import examine, synthetic_view
from nnit_zoo.errors import UserError

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "tests" / "plugin_package"
TEXT = (ROOT / "docs" / "plug-in.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The package, installed by pip into a folder of its own, and beside it one that fails to load."""
    folder = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", folder, PACKAGE], check=True, capture_output=True)
    broken = folder / "broken-1.0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text(
        "[nnit.generators]\nbroken = broken_plugin:Method\ncrop = elsewhere:Crop\n"
    )
    (folder / "broken_plugin.py").write_text("raise ValueError('half-written')\n")
    return folder


@pytest.fixture
def installed(folder, monkeypatch):
    """The folder, on the path."""
    monkeypatch.syspath_prepend(folder)
    yield folder
    for name in ("nnit_gaussian", "broken_plugin"):
        sys.modules.pop(name, None)


def test_the_example_in_the_docs_is_short_and_keeps_the_contract(tmp_path):
    (example,) = blocks("python")
    assert len(example.splitlines()) < 60
    path = tmp_path / "my_method.py"
    path.write_text(example)
    assert [verdict.problem for verdict in examine(registry.get(f"{path}:Gaussian")) if verdict.problem] == []


def test_the_example_is_the_package_that_is_installed_here():
    assert blocks("python") == [(PACKAGE / "nnit_gaussian" / "__init__.py").read_text()]
    assert blocks("toml")[0] in (PACKAGE / "pyproject.toml").read_text()


def test_an_installed_package_offers_its_method_by_name(installed, tmp_path):
    assert "gaussian" in registry.names()
    kind = registry.get("gaussian")
    assert Path(sys.modules[kind.__module__].__file__).is_relative_to(installed)
    made = kind()
    made.fit(synthetic_view())
    made.save_pretrained(tmp_path)
    assert kind.from_pretrained(tmp_path).task == made.task
    with pytest.raises(UserError, match="did you mean gaussian"):
        registry.get("gausian")


def test_a_broken_package_warns_and_stops_no_other(installed):
    with pytest.warns(UserWarning, match="method broken is left out: .*ValueError: half-written") as caught:
        available = registry.available()
    assert len(caught) == 1 and {"gaussian", "nnit", *registry.BUILT_IN} <= set(available) and "broken" not in available
    assert available["crop"].__module__ == "nnit_baselines.controls.resized"  # the built-in one keeps its name
    with pytest.raises(UserError, match="cannot load method"):
        registry.get("broken")


def test_without_the_package_there_is_no_such_method():
    assert "nnit-gaussian" not in {each.metadata["Name"] for each in metadata.distributions()}
    with pytest.raises(UserError, match="no method named 'gaussian'"):
        registry.get("gaussian")
