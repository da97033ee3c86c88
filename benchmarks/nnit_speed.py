"""NNiT's training and sampling speed: only patches with parameters as tokens, beside the padded grid of the paper.

Both transformers have the same sizes; the padded one, plain, takes all 5 x 4 x 5 patches of every network, as FiT pads
images. Tokens are counted alike: patches that hold parameters. One thread, seconds of processor time.

Run: OMP_NUM_THREADS=1 python benchmarks/nnit_speed.py [--rounds 1]
"""

from __future__ import annotations

import argparse
import sys
import time

import torch

from nnit_baselines.controls.initial import Random
from nnit_baselines.generator import FitOptions, SampleRequest
from nnit_baselines.nnit.config import NNiTConfig, preset
from nnit_baselines.nnit.generator import NNiT
from nnit_baselines.nnit.mixture import Packed
from nnit_baselines.nnit.training import Trainer
from nnit_zoo.architecture import Architecture, architectures
from nnit_zoo.zoo import TrainingView

INPUTS, OUTPUTS = 42, 8
POLICIES = 10


def zoo() -> TrainingView:
    """A few random policies of every seen architecture: speed does not depend on what the weights are."""
    make = Random().sample
    seen = architectures("seen", INPUTS, OUTPUTS)
    return TrainingView("PickCube-v1", {each: make(SampleRequest(each, 4, seed=0)) for each in seen})


class Stopwatch:
    """One NNiT, and the processor time that it has taken."""

    def __init__(self, settings: NNiTConfig, view: TrainingView) -> None:
        self.generator = NNiT(settings)
        self.generator.fit(view, FitOptions(steps=1))
        self.generator.settings = settings  # the learning rate's schedule is that of the whole training
        data = [Packed.of(view.batch(each), self.generator.form, settings) for each in view.architectures]
        self.trainer = Trainer(self.generator.model, data, self.generator.mixture, seed=0)
        self.trainer.advance()  # the first step allocates
        self.training = self.sampling = 0.0

    def train(self) -> None:
        """Time a training step."""
        start = time.process_time()
        self.trainer.advance()
        self.training += time.process_time() - start

    def sample(self, wanted: Architecture) -> None:
        """Time some policies of an architecture."""
        start = time.process_time()
        self.generator.sample(SampleRequest(wanted, POLICIES, seed=0))
        self.sampling += time.process_time() - start


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=1, help="how often training takes every architecture")
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    ours, view = preset("cpu"), zoo()
    plain = ours.model_copy(update={"padded": True, "width_conditioning": False, "place_outputs": False})
    watches = {"padded grid": Stopwatch(plain, view), "nnit": Stopwatch(ours, view)}
    steps = rounds * len(view.architectures)
    for _ in range(steps):  # by turns, so that what else the machine does slows both
        for watch in watches.values():
            watch.train()
    for wanted in architectures("unseen", INPUTS, OUTPUTS):
        for watch in watches.values():
            watch.sample(wanted)
    data = watches["nnit"].trainer.data
    tokens = steps * ours.batch * sum(len(packed.where.mask) for packed in data) / len(data)
    slow = watches["padded grid"]
    sys.stdout.write(f"{'':14}{'training, tokens/s':>22}{'sampling 80 policies, s':>30}\n")
    for name, watch in watches.items():
        training = f"{tokens / watch.training:.0f} ({slow.training / watch.training:.1f} x)"
        sampling = f"{watch.sampling:.1f} ({slow.sampling / watch.sampling:.1f} x)"
        sys.stdout.write(f"{name:14}{training:>22}{sampling:>30}\n")


if __name__ == "__main__":
    main()
