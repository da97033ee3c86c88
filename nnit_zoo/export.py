"""Policies for other software: one as a module that takes raw observations, or an architecture's weights as stored."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import safetensors.torch
import torch
from torch import nn

from nnit_zoo.architecture import check_known
from nnit_zoo.atomic import write_bytes
from nnit_zoo.errors import UserError, unknown_name
from nnit_zoo.zoo import Zoo

OPSET, IR = 17, 8  # both of onnx 1.12: an older onnxruntime refuses a newer IR


def export(zoo: Zoo, name: str, output: Path) -> None:
    """Write the policy or the architecture called `name` to `output`, in the format that its suffix names.

    A policy, `task/architecture/seed`, becomes a module from raw observations [n, inputs] to outputs [n, outputs] in
    float32: `.safetensors` is the state of the plain nn.Sequential, `.pt2` a program of torch.export, `.onnx` a graph.
    Of an architecture, `task/architecture`, `.safetensors` holds all policies as stored: float16 `layers.L` [n, out,
    in + 1]. Raises UserError for another name or suffix.
    """
    _, *parts = name.split("/")
    if len(parts) == 1:
        check_known(parts)
        batch = zoo.batch(parts[0])
        ids = zoo.index.filter(pc.field("architecture") == parts[0])["id"].to_pylist()
        if output.suffix != ".safetensors":
            raise UserError(f"{name} is an architecture: export it as .safetensors, or one of its policies, {ids[0]}")
        tensors = {f"layers.{depth}": layer for depth, layer in enumerate(batch.layers)}
        content = safetensors.torch.save(tensors, {"nnit": json.dumps({"policies": ids})})
    else:
        policy = zoo[name]
        if output.suffix not in WRITERS:
            raise unknown_name("format", output.suffix, WRITERS)
        content = WRITERS[output.suffix](policy.to_module().eval(), policy.record)
    write_bytes(output, content)


def _state(module: nn.Sequential, record: Mapping[str, Any]) -> bytes:
    return safetensors.torch.save(module.state_dict(), {"nnit": json.dumps(record)})


def _program(module: nn.Sequential, record: Mapping[str, Any]) -> bytes:
    example = torch.zeros(2, module.state_dict()["0.weight"].shape[1])
    program = torch.export.export(module, (example,), dynamic_shapes=({0: torch.export.Dim.DYNAMIC},))
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={"nnit.json": json.dumps(record)})
    return buffer.getvalue()


def _graph(module: nn.Sequential, record: Mapping[str, Any]) -> bytes:
    """The ONNX graph, written node by node: a chain of Gemm and Tanh needs no tracing exporter."""
    try:
        from onnx import TensorProto, checker, helper, numpy_helper  # noqa: PLC0415  an extra
    except ImportError:
        raise UserError("exporting ONNX needs the package onnx; run: pip install 'nnit[onnx]'") from None
    state = module.state_dict()
    nodes, value = [], "observation"
    for number, layer in enumerate(module):
        result = "output" if number == len(module) - 1 else f"hidden{number}"
        if isinstance(layer, nn.Linear):
            nodes.append(helper.make_node("Gemm", [value, f"{number}.weight", f"{number}.bias"], [result], transB=1))
        else:
            nodes.append(helper.make_node("Tanh", [value], [result]))
        value = result
    weights = [numpy_helper.from_array(tensor.numpy(), name) for name, tensor in state.items()]
    sizes = {"observation": state["0.weight"].shape[1], "output": state[f"{len(module) - 1}.bias"].shape[0]}
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size]) for name, size in sizes.items()]
    graph = helper.make_graph(nodes, record["id"], ends[:1], ends[1:], weights)
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=IR, producer_name="nnit")
    helper.set_model_props(model, {"nnit": json.dumps(record)})
    checker.check_model(model)
    return bytes(model.SerializeToString(deterministic=True))


WRITERS: dict[str, Callable[[nn.Sequential, Mapping[str, Any]], bytes]] = {
    ".safetensors": _state,
    ".pt2": _program,
    ".onnx": _graph,
}
