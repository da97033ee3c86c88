import pytest
import torch

from nnit_zoo.architecture import Architecture
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView

ARCHITECTURES = [Architecture(5, hidden, 3) for hidden in ((16, 16), (16, 32), (32, 32))]


def random_batch(architecture, policies, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = architecture.block_shapes
    return PolicyBatch(architecture, tuple(torch.randn(policies, *shape, generator=generator) for shape in shapes))


@pytest.fixture
def view():
    """Three architectures with four policies each."""
    return TrainingView("Push", {each: random_batch(each, 4, seed) for seed, each in enumerate(ARCHITECTURES)})
