"""Flow matching against closed forms."""

import pytest
import torch

from nnit_baselines import diffusion


def test_the_path_runs_from_weights_to_noise():
    clean, noise = torch.full((3, 2), 4.0), torch.full((3, 2), -2.0)
    mixed = diffusion.interpolate(clean, noise, torch.tensor([0.0, 0.5, 1.0]))
    assert mixed.tolist() == [[4, 4], [1, 1], [-2, -2]]


def test_noise_levels_follow_the_logit_normal():
    levels = diffusion.noise_levels(20_000, 0.5, 1.2, torch.Generator().manual_seed(0))
    logits = torch.logit(levels.double())
    assert logits.mean().item() == pytest.approx(0.5, abs=0.01)
    assert logits.std().item() == pytest.approx(1.2, abs=0.01)


def test_noise_levels_of_a_small_batch_cover_the_range():
    levels = diffusion.noise_levels(8, 0.0, 1.0, torch.Generator().manual_seed(0))
    below = torch.special.ndtr(torch.logit(levels.sort().values))
    assert (below * 8).floor().tolist() == list(range(8))


def test_loss_counts_only_parameters_and_weights_by_the_level():
    clean, estimate = torch.zeros(2, 3), torch.tensor([[1.0, 1, 9], [1, 1, 9]])
    mask = torch.tensor([True, True, False])
    loss = diffusion.loss(estimate, clean, torch.tensor([0.5, 0.01]), mask, floor=0.1)
    assert loss.item() == pytest.approx((1 / 0.5 + 1 / 0.1) / 2)


def test_one_step_finds_the_only_network_there_is():
    noise = torch.randn(4, 5)
    weights = torch.arange(5.0)
    torch.testing.assert_close(diffusion.euler(lambda *_: weights.expand(4, 5), noise, 1), weights.expand(4, 5))


def test_euler_converges_with_first_order_on_gaussian_weights():
    """For weights N(0, s^2) the best estimate is linear and the flow multiplies the noise by exactly s."""
    spread, noise = 0.3, torch.ones(1, 1, dtype=torch.float64)

    def best(noisy, level):
        keep = (1 - level) * spread**2 / ((1 - level) ** 2 * spread**2 + level**2)
        return keep[:, None] * noisy

    errors = [abs(diffusion.euler(best, noise, steps).item() - spread) for steps in (200, 400, 800)]
    assert errors[2] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.1)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.1)
