"""How generators are found, and how their checkpoints are stored."""

import sys
from types import SimpleNamespace

import pytest
import torch

from nnit_baselines import Capabilities, Generator, registry
from nnit_baselines.controls.resized import Crop
from nnit_baselines.generator import WEIGHTS
from nnit_zoo.errors import UserError

PLUGIN = """
import torch
from nnit_baselines import Capabilities, Generator
from nnit_zoo import PolicyBatch

class Constant(Generator):
    capabilities = Capabilities()
    value = 1.0

    def fit(self, view, options=None):
        self.task = view.task

    def sample(self, request):
        shapes = request.architecture.block_shapes
        return PolicyBatch(request.architecture, tuple(torch.full((request.policies, *s), self.value) for s in shapes))

    def config(self):
        return {"value": self.value}

    def tensors(self):
        return {"unused": torch.zeros(1)}

    @classmethod
    def from_state(cls, config, tensors):
        made = cls()
        made.value = config["value"]
        return made

class Stranger:
    pass

class Undeclared(Constant):
    capabilities = None

class Half(Generator):
    capabilities = Capabilities()

    def fit(self, view, options=None):
        pass
"""


@pytest.fixture
def plugin(tmp_path):
    path = tmp_path / "plugin.py"
    path.write_text(PLUGIN)
    return path


def test_built_in_names_lead_to_classes():
    assert {"nnit", "crop", "ghn-oracle"} <= set(registry.names())
    assert all(issubclass(registry.get(name), Generator) for name in registry.BUILT_IN)


def test_listing_names_imports_no_method():
    sys.modules.pop("nnit_baselines.controls.stored", None)
    registry.names()
    assert "nnit_baselines.controls.stored" not in sys.modules


def test_a_class_in_a_file_or_a_module_is_a_method(plugin, monkeypatch):
    assert registry.get(f"{plugin}:Constant").__name__ == "Constant"
    monkeypatch.syspath_prepend(plugin.parent)
    assert registry.get("plugin:Constant").__name__ == "Constant"


@pytest.mark.parametrize("method", ["sub/one.py:Method", "beside:Method"])
def test_a_method_finds_the_modules_beside_it(method, tmp_path, monkeypatch):
    """As for `python file.py` and `python -m module`; nothing needs to be on the path."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for folder in (tmp_path, tmp_path / "sub"):
        folder.mkdir(exist_ok=True)
        (folder / "beside.py").write_text(PLUGIN.replace("Constant", "Method"))
        monkeypatch.delitem(sys.modules, "beside", raising=False)
    (tmp_path / "sub" / "one.py").write_text("from beside import Method\n")
    assert registry.get(method).__name__ == "Method"
    monkeypatch.delitem(sys.modules, "beside")


def test_a_method_may_be_a_torch_module_too(plugin, view, tmp_path):
    kind = registry.get(f"{plugin}:Constant")

    class Both(kind, torch.nn.Module):
        pass

    made = Both()
    made.fit(view)
    made.train().save_pretrained(tmp_path)
    assert Both.from_pretrained(tmp_path, view.task).training


def test_a_setting_cannot_take_the_place_of_ours(plugin, tmp_path, monkeypatch):
    kind = registry.get(f"{plugin}:Constant")
    monkeypatch.setattr(kind, "config", lambda self: {"value": 1.0, "training": {"lr": 0.1}})
    with pytest.raises(UserError, match="reserved key training"):
        kind().save_pretrained(tmp_path / "saved")
    assert not (tmp_path / "saved").exists()


def test_a_method_without_a_checkpoint_is_fitted_with_the_runs_seed(plugin, view, monkeypatch):
    kind, runs = registry.get(f"{plugin}:Constant"), []
    monkeypatch.setattr(kind, "capabilities", Capabilities(checkpoint=False))
    monkeypatch.setattr(kind, "fit", lambda self, view, options=None: runs.append(options))
    monkeypatch.setattr(registry, "get", lambda name: kind)
    registry.prepare("constant", SimpleNamespace(task="Push", training_view=lambda: view), "unseen", seed=3)
    assert [run.seed for run in runs] == [3]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nnitt", "did you mean nnit"),
        ("no_such_module:Thing", "cannot load"),
        ("no_such_file.py:Thing", "no such file"),
        ("{plugin}:Constan", "did you mean Constant"),
        ("{plugin}:Stranger", "not a subclass"),
        ("{plugin}:Half", "does not define sample"),
        ("{plugin}:Undeclared", r"set capabilities = Capabilities\(\) in the class"),
        ("{plugin}", "names no class; write .*plugin.py:ClassName"),
    ],
)
def test_a_wrong_method_gets_an_answer(name, message, plugin):
    with pytest.raises(UserError, match=message):
        registry.get(name.format(plugin=plugin))


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one(plugin, tmp_path, monkeypatch):
    kind = registry.get(f"{plugin}:Constant")
    made = kind()
    made.task, made.value = "Push", 1.0
    made.save_pretrained(tmp_path)
    made.value, made.training_facts = 2.0, {"loss": torch.ones(())}
    with pytest.raises(TypeError, match="not JSON serializable"):
        made.save_pretrained(tmp_path)
    assert kind.from_pretrained(tmp_path, "Push").value == 1.0


def test_a_checkpoint_comes_back_for_its_own_task_only(plugin, tmp_path):
    kind = registry.get(f"{plugin}:Constant")
    made = kind()
    made.task, made.value, made.training_facts = "Push", 2.5, {"steps": 3}
    made.save_pretrained(tmp_path / "saved")
    back = kind.from_pretrained(tmp_path / "saved", "Push")
    assert (back.task, back.value, back.training_facts) == ("Push", 2.5, {"steps": 3})
    card = (tmp_path / "saved" / "README.md").read_text()
    assert "# Constant for Push" in card and "| steps | 3 |" in card
    assert "--method plugin.py:Constant" in card and "license" not in card
    with pytest.raises(UserError, match="is for Push, not for Pick"):
        kind.from_pretrained(tmp_path / "saved", "Pick")
    with pytest.raises(UserError, match="is of Constant, not of NNiT"):
        registry.get("nnit").from_pretrained(tmp_path / "saved")


def test_a_missing_or_damaged_checkpoint_gets_an_answer(plugin, tmp_path):
    kind = registry.get(f"{plugin}:Constant")
    with pytest.raises(UserError, match="no checkpoint folder"):
        kind.from_pretrained(tmp_path / "nowhere")
    kind().save_pretrained(tmp_path / "saved")
    with pytest.raises(UserError, match="name is empty; give a folder"):
        kind.from_pretrained("")
    (tmp_path / "saved" / WEIGHTS).write_bytes(b"half a fi")
    with pytest.raises(UserError, match="cannot be read"):
        kind.from_pretrained(tmp_path / "saved")


def test_a_method_without_a_shipped_checkpoint_says_how_to_train_it(plugin):
    zoo = SimpleNamespace(task="Push")
    with pytest.raises(UserError, match=r"nnit-bench train --method .*Constant --task Push"):
        registry.prepare(f"{plugin}:Constant", zoo, "unseen")


def test_a_named_checkpoint_goes_before_the_shipped_one(plugin, tmp_path, monkeypatch):
    kind = registry.get(f"{plugin}:Constant")
    for value, folder in enumerate((tmp_path / "shipped" / "constant" / "Push", tmp_path / "mine")):
        made = kind()
        made.task, made.value = "Push", value
        made.save_pretrained(folder)
    monkeypatch.setattr(registry, "get", lambda name: kind)
    monkeypatch.setattr(registry, "CHECKPOINTS", tmp_path / "shipped")
    zoo = SimpleNamespace(task="Push")
    assert registry.prepare("constant", zoo, "unseen").value == 0
    assert registry.prepare("constant", zoo, "unseen", tmp_path / "mine").value == 1


def test_a_control_is_fitted_on_the_training_view_and_an_oracle_on_the_reference(view):
    zoo = SimpleNamespace(task="Push", training_view=lambda: view, reference_view=lambda split: (split, view)[1])
    assert registry.prepare("crop", zoo, "unseen").view is view
    assert registry.prepare("ghn-oracle", zoo, "unseen").view is view
    with pytest.raises(UserError, match="keeps no checkpoint"):
        Crop().save_pretrained("anywhere")
