"""Both objectives against closed forms."""

import math

import pytest
import torch
from scipy.stats import norm

from nnit_baselines.diffusion import (
    CleanPrediction,
    NoisePrediction,
    discretised_log_likelihood,
    gaussian_kl,
    gaussian_log_likelihood,
    linear_schedule,
)
from nnit_zoo.errors import UserError

FLOW = CleanPrediction(mean=0.5, std=1.2, floor=0.1)
CHAIN = linear_schedule(1000)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


# Clean prediction


def test_the_path_runs_from_weights_to_noise():
    clean, noise = torch.full((3, 2), 4.0), torch.full((3, 2), -2.0)
    assert FLOW.noisy(clean, noise, torch.tensor([0.0, 0.5, 1.0])).tolist() == [[4, 4], [1, 1], [-2, -2]]


def test_noise_levels_follow_the_logit_normal():
    logits = torch.logit(FLOW.levels(20_000, seeded()).double())
    assert logits.mean().item() == pytest.approx(0.5, abs=0.01)
    assert logits.std().item() == pytest.approx(1.2, abs=0.01)


def test_noise_levels_of_a_small_batch_cover_the_range():
    levels = CleanPrediction(0.0, 1.0, 0.1).levels(8, seeded())
    below = torch.special.ndtr(torch.logit(levels.sort().values))
    assert (below * 8).floor().tolist() == list(range(8))


def test_the_flow_s_loss_counts_only_parameters_and_weights_by_the_level():
    clean, output = torch.zeros(3, 3), torch.tensor([[1.0, 1, 9], [1, 1, 9], [5, 5, 5]])[:, None]
    mask, level = torch.tensor([True, True, False]), torch.tensor([0.5, 0.01, 0.0])  # the third is given, not learned
    loss = FLOW.loss(output, clean, torch.randn(3, 3), level, mask)
    assert loss.item() == pytest.approx((1 / 0.5 + 1 / 0.1) / 3)


def test_one_step_finds_the_only_network_there_is():
    weights = torch.arange(5.0).expand(4, 5)
    torch.testing.assert_close(FLOW.sample(lambda *_: weights[:, None], torch.randn(4, 5), 1, seeded()), weights)


def test_euler_converges_with_first_order_on_gaussian_weights():
    """For weights N(0, s^2) the best estimate is linear and the flow multiplies the noise by exactly s."""
    spread, noise = 0.3, torch.ones(1, 1, dtype=torch.float64)

    def best(noisy, level):
        keep = (1 - level) * spread**2 / ((1 - level) ** 2 * spread**2 + level**2)
        return (keep[:, None] * noisy)[:, None]

    errors = [abs(FLOW.sample(best, noise, steps, seeded()).item() - spread) for steps in (200, 400, 800)]
    assert errors[2] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.1)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.1)


# The chain


def test_the_linear_schedule_is_ddpm_s():
    assert CHAIN.beta[1].item() == pytest.approx(1e-4)
    assert CHAIN.beta[-1].item() == pytest.approx(0.02)
    torch.testing.assert_close(CHAIN.beta[1:].diff(), torch.full((999,), 0.0199 / 999).double())
    torch.testing.assert_close(CHAIN.alpha_bar[1:], (1 - CHAIN.beta[1:]).cumprod(0))
    torch.testing.assert_close(CHAIN.signal**2 + CHAIN.noise**2, torch.ones(1001).double())
    assert CHAIN.alpha_bar[0] == 1 and CHAIN.alpha_bar[-1] == pytest.approx(4.04e-5, rel=0.01)


@pytest.mark.parametrize("step", [2, 50, 1000])
@pytest.mark.parametrize("chain", [CHAIN, CHAIN.respaced(1000), linear_schedule(2000).respaced(1000)])
def test_the_posterior_is_bayes_rule(step, chain):
    """The product of q(x_(t-1) | x_0) and q(x_t | x_(t-1)) over x_(t-1) is the normal density that the tables give."""
    clean, noisy = 0.7, -1.3
    before, beta = chain.alpha_bar[step - 1].item(), chain.beta[step].item()
    precision = 1 / (1 - before) + (1 - beta) / beta
    mean = (before**0.5 * clean / (1 - before) + (1 - beta) ** 0.5 * noisy / beta) / precision
    number, at = torch.tensor([step]), (torch.tensor([[clean]]).double(), torch.tensor([[noisy]]).double())
    assert chain.posterior_mean(*at, number).item() == pytest.approx(mean)
    assert chain.log_lower[step].exp().item() == pytest.approx(1 / precision)


def test_the_last_step_s_posterior_is_the_clean_weights():
    clean = torch.randn(4, 3).double()
    torch.testing.assert_close(CHAIN.posterior_mean(clean, torch.randn(4, 3).double(), torch.ones(4).long()), clean)


def test_a_chain_too_short_for_its_noise_gets_an_answer():
    with pytest.raises(UserError, match="more than 20 steps"):
        linear_schedule(20)


def test_noise_and_clean_weights_give_each_other():
    clean, noise, level = torch.randn(5, 3).double(), torch.randn(5, 3).double(), torch.tensor([1, 2, 50, 500, 1000])
    noisy = NoisePrediction().noisy(clean, noise, level / 1000)
    torch.testing.assert_close(CHAIN.clean(noise, noisy, level), clean)


def test_a_respaced_chain_keeps_the_levels_and_signals_of_the_steps_it_visits():
    short = CHAIN.respaced(250)
    assert short.steps == 250 and short.level[1] == 0.004 and short.level[-1] == 1
    torch.testing.assert_close(short.alpha_bar[1:], CHAIN.alpha_bar[4::4])
    torch.testing.assert_close((1 - short.beta).cumprod(0), short.alpha_bar)
    with pytest.raises(UserError, match="1000 steps"):
        CHAIN.respaced(1001)


def test_steps_are_uniform_from_one_to_the_last():
    steps = (NoisePrediction(25).levels(25_000, seeded()) * 25).round()
    assert steps.unique().tolist() == list(range(1, 26))
    assert steps.unique(return_counts=True)[1].float().std() < 2 * 1000**0.5


# Divergence and likelihoods


def test_kl_is_the_published_formula():
    ours, other = torch.distributions.Normal(0.3, 0.5), torch.distributions.Normal(-1.0, 2.0)
    numbers = [torch.tensor(x) for x in (0.3, 2 * math.log(0.5), -1.0, 2 * math.log(2.0))]
    torch.testing.assert_close(gaussian_kl(*numbers), torch.distributions.kl_divergence(ours, other))


def test_the_continuous_likelihood_is_the_normal_s():
    expected = norm.logpdf(1.1, loc=0.3, scale=0.5)
    numbers = [torch.tensor(x) for x in (1.1, 0.3, 2 * math.log(0.5))]
    assert gaussian_log_likelihood(*numbers).item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("mean", [-5.0, 0.1, 1.0, 40.0])
@pytest.mark.parametrize("std", [0.05, 1.0, 30.0])
def test_the_discretised_likelihood_sums_to_one(mean, std):
    values = torch.tensor([-1.0, 0.0, 0.5, 2.0])
    logs = discretised_log_likelihood(values, torch.tensor(mean), torch.tensor(2 * math.log(std)), values)
    assert logs.exp().sum().item() == pytest.approx(1)


def test_the_discretised_likelihood_is_the_mass_nearest_to_a_value_and_has_gradients():
    values = torch.tensor([0.0, 2.0])
    mean, log_variance = torch.zeros(2, requires_grad=True), torch.zeros(2, requires_grad=True)
    likelihood = discretised_log_likelihood(values, mean, log_variance, values)
    torch.testing.assert_close(likelihood.exp(), torch.tensor([norm.cdf(1.0), norm.sf(1.0)]).float())
    likelihood.sum().backward()
    assert mean.grad.isfinite().all() and log_variance.grad.isfinite().all()


# Noise prediction with learned variance


def test_the_bound_s_first_term_is_the_likelihood_and_the_others_a_divergence():
    objective, clean, noise = NoisePrediction(), torch.randn(3, 1).double(), torch.randn(3, 1).double()
    step = torch.tensor([1, 2, 700])
    noisy = objective.noisy(clean, noise, step / 1000)
    perfect = objective.bound(noise, torch.full((3, 1), -1.0).double(), clean, noisy, step)
    log_variance = CHAIN.log_lower[2].item()  # at step 1 the mean is exact, and the variance that of step 2
    assert perfect[0].item() == pytest.approx(0.5 * (math.log(2 * math.pi) + log_variance) / math.log(2))
    torch.testing.assert_close(perfect[1:], torch.zeros(2, 1).double(), atol=1e-12, rtol=0)
    worse = objective.bound(noise + 0.1, torch.ones(3, 1).double(), clean, noisy, step)
    assert (worse > perfect).all()


def test_the_bound_trains_the_variance_and_not_the_mean():
    objective, output = NoisePrediction(), torch.randn(8, 2, 3, requires_grad=True)
    clean, noise, level = torch.randn(8, 3), torch.randn(8, 3), torch.full((8,), 0.4)
    (of_loss,) = torch.autograd.grad(objective.loss(output, clean, noise, level), output)
    torch.testing.assert_close(of_loss[:, 0], 2 * (output[:, 0] - noise) / 24)
    assert (of_loss[:, 1] != 0).all()


def test_what_is_clean_has_no_noise_to_find_and_no_bound():
    objective, output = NoisePrediction(), torch.randn(8, 2, 3, requires_grad=True)
    loss = objective.loss(output, torch.randn(8, 3), torch.randn(8, 3), torch.zeros(8))
    torch.testing.assert_close(loss, output[:, 0].square().mean())
    assert torch.autograd.grad(loss, output)[0][:, 1].abs().max() == 0


@pytest.mark.parametrize("step", [2, 5, 30])
def test_the_best_variance_is_the_one_that_gaussian_weights_have(step):
    """For weights N(0, s^2) and the best mean, the bound is least where sigma^2 = Var(x_(t-1) | x_t)."""
    objective, spread = NoisePrediction(), 0.5
    before, now, beta = (float(each) for each in (CHAIN.alpha_bar[step - 1], CHAIN.alpha_bar[step], CHAIN.beta[step]))
    variance, earlier = now * spread**2 + 1 - now, before * spread**2 + 1 - before
    expected = earlier - (1 - beta) * earlier**2 / variance
    clean, noise = spread * torch.randn(100_000, 1, generator=seeded()), torch.randn(100_000, 1, generator=seeded(1))
    noisy = objective.noisy(clean, noise, torch.full((100_000,), step / 1000))
    best = noisy * (1 - now) ** 0.5 / variance
    steps, shares = torch.full((100_000,), step), torch.linspace(-1, 1, 41)
    bounds = [objective.bound(best, torch.full_like(clean, share), clean, noisy, steps).mean() for share in shares]
    found = CHAIN.log_variance(shares[int(torch.stack(bounds).argmin())].view(1, 1), torch.tensor([step])).item()
    width = (CHAIN.log_upper[step] - CHAIN.log_lower[step]).item() / 40
    assert abs(found - math.log(expected)) < 2 * width


@pytest.mark.parametrize("steps", [1000, 100])
def test_ancestral_sampling_gives_gaussian_weights_their_spread(steps):
    """With the exact noise estimate for weights N(1, s^2), samples have that mean and spread."""
    spread, objective = 0.5, NoisePrediction()

    def exact(noisy, level):
        kept = CHAIN.alpha_bar[(level * 1000).round().long()].float()[:, None]
        noise = (1 - kept).sqrt() * (noisy - kept.sqrt()) / (kept * spread**2 + 1 - kept)
        return torch.stack([noise, torch.zeros_like(noise)], dim=1)

    made = objective.sample(exact, torch.randn(4000, 1, generator=seeded()), steps, seeded(1))
    assert made.mean().item() == pytest.approx(1, abs=0.03)
    assert made.std().item() == pytest.approx(spread, rel=0.05)


@pytest.mark.parametrize("objective", [NoisePrediction(200), CleanPrediction(0.0, 1.2, 0.1)])
def test_a_small_network_learns_a_known_distribution(objective):
    """Weights +2 with probability 3/4 and -1 with 1/4; a network of a few thousand numbers learns to sample them."""
    torch.manual_seed(0)
    layers = [torch.nn.Linear(8, 64), torch.nn.SiLU(), torch.nn.Linear(64, 64), torch.nn.SiLU()]
    network = torch.nn.Sequential(*layers, torch.nn.Linear(64, objective.channels))
    generator = seeded()

    def ask(noisy, level):
        waves = [f(k * level[:, None]) for k in (1, 3, 9) for f in (torch.sin, torch.cos)]
        scaled = noisy * objective.input_scale(level)[:, None]
        return network(torch.cat([scaled, *waves, level[:, None]], dim=1))[:, :, None]

    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(800):
        clean = torch.where(torch.rand(256, 1, generator=generator) < 0.75, 2.0, -1.0)
        noise, level = torch.randn(256, 1, generator=generator), objective.levels(256, generator)
        loss = objective.loss(ask(objective.noisy(clean, noise, level), level), clean, noise, level)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        made = objective.sample(ask, torch.randn(2000, 1, generator=generator), 50, generator)
    high = made > 0.5
    assert high.float().mean().item() == pytest.approx(0.75, abs=0.06)
    assert made[high].mean().item() == pytest.approx(2, abs=0.15)
    assert made[~high].mean().item() == pytest.approx(-1, abs=0.15)
    assert torch.where(high, made - 2, made + 1).std() < 0.35
