"""GHN oracle: the policies that the zoo's own GHNs give for exactly the wanted architecture."""

from __future__ import annotations

from nnit_baselines.controls.crop import draw
from nnit_baselines.generator import Capabilities, Generator, Run, SampleRequest
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView


class GHNOracle(Generator):
    """The zoo's reference policies of the wanted architecture: an upper bound, since it has the zoo's generator.

    Not in the paper (docs/deviations.md).
    """

    capabilities = Capabilities(checkpoint=False, oracle=True)

    def fit(self, view: TrainingView, run: Run | None = None) -> None:
        """Keep the view, which should be the reference view of the evaluated split."""
        self.task = view.task
        self.view = view

    def sample(self, request: SampleRequest) -> PolicyBatch:
        """As many different reference policies as there are, then the same again.

        Raises UserError if the view has none of that architecture.
        """
        if request.architecture is None:
            raise UserError("ghn-oracle needs an architecture")
        stored = self.view.batch(request.architecture)
        return stored[draw(len(stored), request.policies, request.seed)]
