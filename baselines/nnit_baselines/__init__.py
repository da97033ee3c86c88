"""Generators of network weights, learned and control, behind one interface: what a method of one's own needs."""

from nnit_baselines.draws import draw, shuffled, step_generator
from nnit_baselines.generator import Capabilities, FitOptions, Generator, SampleRequest, refuse_reference
from nnit_baselines.registry import get

__all__ = [
    "Capabilities",
    "FitOptions",
    "Generator",
    "SampleRequest",
    "draw",
    "get",
    "refuse_reference",
    "shuffled",
    "step_generator",
]
