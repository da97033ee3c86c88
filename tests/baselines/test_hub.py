"""Checkpoints on the Hub, against the local stand-in that the zoo's tests use."""

import re

import pytest
import torch

import stand_in_hub
from nnit_baselines.generator import SampleRequest
from nnit_baselines.nnit.config import NNiTConfig
from nnit_baselines.nnit.generator import NNiT
from nnit_zoo.errors import UserError


class ModelHandler(stand_in_hub.Handler):
    """The stand-in's data sets, at the addresses that models have."""

    def do_GET(self):
        self.path = self.as_data_set()
        if match := re.match("/api/datasets/(.+)/tree/", self.path):
            files = self.server.files[match[1]].items()
            self.answer(200, [{"type": "file", "path": name, "size": len(file), "oid": "0"} for name, file in files])
        else:
            super().do_GET()

    do_HEAD = do_GET

    def do_POST(self):
        self.path = self.as_data_set()
        super().do_POST()

    def as_data_set(self):
        path = re.sub("^/api/models/", "/api/datasets/", self.path)
        return re.sub("^/([^/]+/[^/]+)/resolve/", r"/datasets/\1/resolve/", path)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    server = stand_in_hub.Hub()
    server.RequestHandlerClass = ModelHandler
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
    with stand_in_hub.serving(server, monkeypatch):
        yield server


def test_what_is_pushed_comes_back_the_same(hub, view):
    generator = NNiT(NNiTConfig(width=16, depth=1, heads=1, batch=2, steps=1, sampling_steps=2))
    generator.fit(view)
    assert hub.address in generator.push_to_hub("someone/nnit")
    assert set(hub.files["someone/nnit"]) == {"README.md", "config.json", "model.safetensors"}
    assert 'get("nnit").from_pretrained' in hub.files["someone/nnit"]["README.md"].decode()
    back, request = NNiT.from_pretrained("someone/nnit", view.task), SampleRequest(view.architectures[0], 2, 0)
    assert torch.equal(back.sample(request).flat(), generator.sample(request).flat())


def test_a_repository_that_is_not_there_gets_an_answer(hub):
    with pytest.raises(UserError, match="'someone/else' is neither a folder nor a repository of the Hub"):
        NNiT.from_pretrained("someone/else")
