"""Diffusion over weights: what a network is trained to predict, at which noise levels, and how samples are drawn.

`NoisePrediction` is the paper's DDPM (NNiT 5.3, appendix A), `CleanPrediction` a flow that learns on two CPU cores
(docs/deviations.md). Both tell the network a noise level from 0 (clean) to 1 (noise), one for each sample; samples at
level 0 are given, not to be learned.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from nnit_zoo.errors import UserError

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy [n, ...], noise level [n]) -> what the network says of it, [n, channels, ...]."""


class Objective(ABC):
    """What the network predicts of noisy weights, and how that gives samples."""

    channels: ClassVar[int]
    """Numbers that the network gives for each entry."""

    @abstractmethod
    def levels(self, count: int, generator: torch.Generator) -> Tensor:
        """Noise levels to train at, [count]."""

    @abstractmethod
    def noisy(self, clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
        """Clean weights [n, ...] with as much standard normal noise [n, ...] as `level` [n] says."""

    @abstractmethod
    def input_scale(self, level: Tensor) -> Tensor:
        """What multiplies noisy weights of unit variance so that their variance is one again, [n]."""

    @abstractmethod
    def loss(
        self,
        output: Tensor,
        clean: Tensor,
        noise: Tensor,
        level: Tensor,
        mask: Tensor | None = None,
        values: Tensor | None = None,
    ) -> Tensor:
        """The mean over n and the entries in `mask` (all if None) of what is wrong with `output` [n, channels, ...].

        `values` are the sorted numbers that clean entries can be; None for any number.
        """

    @abstractmethod
    def sample(self, denoise: Denoiser, noise: Tensor, steps: int, generator: torch.Generator) -> Tensor:
        """Clean weights from standard normal noise [n, ...] in `steps` steps."""


@dataclass(frozen=True)
class CleanPrediction(Objective):
    """Flow matching along x_t = (1 - t) x_0 + t e, with prediction of the clean x_0.

    Not in the paper: on two CPU cores it is the one that learned (docs/deviations.md). Levels are logit-normal,
    sigmoid(mean + std n); the squared error has weight 1 / max(t, floor).
    """

    channels = 1
    mean: float
    std: float
    floor: float

    def levels(self, count: int, generator: torch.Generator) -> Tensor:
        """Levels t in (0, 1) whose n are the normal's quantiles at stratified points, one in each of `count` parts.

        That makes the loss of small batches less noisy than independent draws.
        """
        points = (torch.arange(count) + torch.rand(count, generator=generator)) / count
        order = torch.randperm(count, generator=generator)
        return torch.sigmoid(self.mean + self.std * torch.special.ndtri(points.clamp(1e-5, 1 - 1e-5)))[order]

    def noisy(self, clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
        """The point at `level` on the straight path from clean weights to noise."""
        level = _spread(level, clean)
        return (1 - level) * clean + level * noise

    def input_scale(self, level: Tensor) -> Tensor:
        """The root of 1 / ((1 - t)^2 + t^2)."""
        return ((1 - level) ** 2 + level**2).rsqrt()

    def loss(
        self,
        output: Tensor,
        clean: Tensor,
        noise: Tensor,
        level: Tensor,
        mask: Tensor | None = None,
        values: Tensor | None = None,
    ) -> Tensor:
        """Squared error of the clean weights, weighted by 1 / max(t, floor); `noise` and `values` play no part.

        Halfway between the plain error and that of the velocity e - x_0, whose weight 1 / t^2 would spend the training
        on nearly clean weights, where copying the input is enough; the floor does the same for the very last steps.
        """
        weight = (level > 0) / level.clamp(min=self.floor)
        return _mean(_spread(weight, clean) * (output[:, 0] - clean).square(), mask)

    def sample(self, denoise: Denoiser, noise: Tensor, steps: int, generator: torch.Generator) -> Tensor:
        """Follow the flow in equal Euler steps; it needs no more randomness."""
        current = noise
        for now, after in pairwise(torch.linspace(1, 0, steps + 1, device=noise.device)):
            estimate = denoise(current, now.expand(len(noise)))[:, 0]
            # The velocity is (x_t - x_0) / t; going from t to s along it keeps the share s / t of the way left to x_0.
            current = estimate + (current - estimate) * (after / now)
        return current


class NoisePrediction(Objective):
    """DDPM with noise prediction and learned variance: squared error plus the variational bound (NNiT, appendix A).

    The network gives the noise e and a number v that places log sigma^2 between its lower bound, at v = -1, and its
    upper bound, at 1 (Improved DDPM 3.1). The bound sees a detached mean: it trains the variance alone.
    """

    channels = 2

    def __init__(self, steps: int = 1000) -> None:
        self.schedule = linear_schedule(steps)

    def levels(self, count: int, generator: torch.Generator) -> Tensor:
        """Steps uniform in 1 ... T, as levels t / T."""
        return torch.randint(1, self.schedule.steps + 1, (count,), generator=generator) / self.schedule.steps

    def noisy(self, clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
        """The root of alpha-bar times the clean weights plus the root of 1 - alpha-bar times the noise."""
        step, chain = self._step(level), self.schedule
        return _at(chain.signal, step, clean) * clean + _at(chain.noise, step, clean) * noise

    def input_scale(self, level: Tensor) -> Tensor:
        """One: the chain keeps unit variance."""
        return torch.ones_like(level)

    def loss(
        self,
        output: Tensor,
        clean: Tensor,
        noise: Tensor,
        level: Tensor,
        mask: Tensor | None = None,
        values: Tensor | None = None,
    ) -> Tensor:
        """Squared error of the noise, plus the bound in bits; at level 0 the noise to predict is zero, without bound.

        The last step's likelihood is the continuous Gaussian's, or the discretised one's if there are `values`.
        """
        step = self._step(level)
        moving = _spread(step > 0, clean)
        predicted, share = output.unbind(1)
        bound = self.bound(predicted.detach(), share, clean, self.noisy(clean, noise, level), step.clamp(min=1), values)
        return _mean((predicted - noise * moving).square() + bound * moving, mask)

    def bound(
        self, predicted: Tensor, share: Tensor, clean: Tensor, noisy: Tensor, step: Tensor, values: Tensor | None = None
    ) -> Tensor:
        """Each entry's term of the variational bound at `step` [n], in bits.

        The divergence of the model's step from the posterior's; at step 1 the negative log-likelihood of `clean`.
        """
        chain = self.schedule
        mean = chain.posterior_mean(chain.clean(predicted, noisy, step), noisy, step)
        log_variance = chain.log_variance(share, step)
        posterior = chain.posterior_mean(clean, noisy, step)
        divergence = gaussian_kl(posterior, _at(chain.log_lower, step, clean), mean, log_variance)
        if values is None:
            likelihood = gaussian_log_likelihood(clean, mean, log_variance)
        else:
            likelihood = discretised_log_likelihood(clean, mean, log_variance, values)
        return torch.where(_spread(step == 1, clean), -likelihood, divergence) / math.log(2)

    def sample(self, denoise: Denoiser, noise: Tensor, steps: int, generator: torch.Generator) -> Tensor:
        """Ancestral sampling along `steps` of the chain's steps, evenly spaced; raises UserError if it has fewer."""
        chain = self.schedule.respaced(steps)
        current = noise
        for number in range(steps, 0, -1):
            step = torch.full((len(noise),), number, device=noise.device)
            predicted, share = denoise(current, chain.level.to(noise)[step]).unbind(1)
            mean = chain.posterior_mean(chain.clean(predicted, current, step), current, step)
            fresh = torch.randn(noise.shape, generator=generator).to(noise)
            current = mean + (number > 1) * (0.5 * chain.log_variance(share, step)).exp() * fresh
        return current

    def _step(self, level: Tensor) -> Tensor:
        return (level * self.schedule.steps).round().long()


@dataclass(frozen=True)
class Schedule:
    """A Markov chain from clean weights, step 0, to noise, step T; all tables are float64 [T + 1]."""

    level: Tensor
    """What the network is told at each step."""
    alpha_bar: Tensor
    """The share of the clean weights' variance that is left; 1 at step 0."""

    @property
    def steps(self) -> int:
        """T."""
        return len(self.level) - 1

    @cached_property
    def signal(self) -> Tensor:
        """What multiplies the clean weights at each step."""
        return self.alpha_bar.sqrt()

    @cached_property
    def noise(self) -> Tensor:
        """What multiplies the noise at each step."""
        return (1 - self.alpha_bar).sqrt()

    @cached_property
    def beta(self) -> Tensor:
        """The variance of the noise that each step adds; 0 at step 0."""
        return torch.cat([torch.zeros(1), 1 - self.alpha_bar[1:] / self.alpha_bar[:-1]])

    @cached_property
    def posterior(self) -> tuple[Tensor, Tensor, Tensor]:
        """Given x_t and x_0, x_(t-1) has mean a x_0 + b x_t and variance c: a, b, c (DDPM 2); 0 at step 0."""
        before, now, beta = self.alpha_bar[:-1], self.alpha_bar[1:], self.beta[1:]
        of_clean = before.sqrt() * beta / (1 - now)
        of_noisy = (1 - beta).sqrt() * (1 - before) / (1 - now)
        variance = beta * (1 - before) / (1 - now)
        a, b, c = (torch.cat([torch.zeros(1), part]) for part in (of_clean, of_noisy, variance))
        return a, b, c

    @cached_property
    def log_lower(self) -> Tensor:
        """The smallest log-variance of the model's steps: the posterior's; at step 1, where that is 0, step 2's."""
        variance = self.posterior[2].clone()
        variance[:2] = variance[min(2, self.steps)]
        return variance.clamp(min=1e-20).log()

    @cached_property
    def log_upper(self) -> Tensor:
        """The largest log-variance of the model's steps: that of the noise which the step adds."""
        return self.beta.clamp(min=1e-20).log()

    def respaced(self, steps: int) -> Schedule:
        """The chain that visits only `steps` of the steps, evenly spaced; raises UserError if there are fewer."""
        if steps > self.steps:
            raise UserError(f"the chain has {self.steps} steps: it cannot be sampled in {steps}")
        visited = torch.linspace(0, self.steps, steps + 1).round().long()
        return Schedule(self.level[visited], self.alpha_bar[visited])

    def clean(self, noise: Tensor, noisy: Tensor, step: Tensor) -> Tensor:
        """The clean weights that `noise` would have made `noisy` at `step` [n]."""
        return (noisy - _at(self.noise, step, noisy) * noise) / _at(self.signal, step, noisy)

    def posterior_mean(self, clean: Tensor, noisy: Tensor, step: Tensor) -> Tensor:
        """The mean of x_(t-1) given x_t = `noisy` and x_0 = `clean` at `step` [n], from 1 on."""
        of_clean, of_noisy, _ = self.posterior
        return _at(of_clean, step, clean) * clean + _at(of_noisy, step, clean) * noisy

    def log_variance(self, share: Tensor, step: Tensor) -> Tensor:
        """The model's log-variance at `step` [n]: `share` [n, ...] = -1 is the lower bound, 1 the upper one."""
        lower, upper = _at(self.log_lower, step, share), _at(self.log_upper, step, share)
        return lower + (share + 1) / 2 * (upper - lower)


def linear_schedule(steps: int) -> Schedule:
    """The chain whose beta rises linearly from 0.0001 to 0.02 over 1000 steps (DDPM 4).

    A chain of another length adds as much noise in all; raises UserError if its steps would each add too much.
    """
    if steps <= 20:
        raise UserError(f"the linear schedule needs more than 20 steps, not {steps}")
    beta = torch.linspace(1e-4, 0.02, steps, dtype=torch.float64) * 1000 / steps
    alpha_bar = torch.cat([torch.ones(1), (1 - beta).cumprod(0)])
    return Schedule(torch.arange(steps + 1, dtype=torch.float64) / steps, alpha_bar)


def gaussian_kl(mean: Tensor, log_variance: Tensor, other_mean: Tensor, other_log_variance: Tensor) -> Tensor:
    """KL divergence, in nats and for each entry, of the normal distribution `mean` from the other one."""
    ratio = log_variance - other_log_variance
    return 0.5 * (ratio.exp() - 1 - ratio + (mean - other_mean).square() * (-other_log_variance).exp())


def gaussian_log_likelihood(x: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """The log-density of each entry of `x`, in nats."""
    return -0.5 * (math.log(2 * math.pi) + log_variance + (x - mean).square() * (-log_variance).exp())


def discretised_log_likelihood(x: Tensor, mean: Tensor, log_variance: Tensor, values: Tensor) -> Tensor:
    """The log-probability, in nats, that a normal variable is nearest to `x` among the sorted `values` (DDPM 3.3)."""
    edges = (values[1:] + values[:-1]) / 2
    number, last = torch.bucketize(x, edges), len(edges) - 1
    std = (0.5 * log_variance).exp()
    upper = torch.special.ndtr((edges[number.clamp(max=last)] - mean) / std)
    lower = torch.special.ndtr((edges[(number - 1).clamp(min=0)] - mean) / std)
    mass = torch.where(number > last, 1.0, upper) - torch.where(number == 0, 0.0, lower)
    return mass.clamp(min=1e-12).log()


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """The mean of [n, ...] over n and the entries of `mask` [...]."""
    return values.mean() if mask is None else (values * mask).sum() / (mask.sum() * len(values))


def _at(table: Tensor, step: Tensor, like: Tensor) -> Tensor:
    """The table's entries at `step` [n], as [n, 1, ...] to multiply `like` [n, ...]."""
    return _spread(table.to(like)[step], like)


def _spread(numbers: Tensor, like: Tensor) -> Tensor:
    """[n] as [n, 1, ...], to multiply `like` [n, ...]."""
    return numbers.view(-1, *[1] * (like.ndim - 1))
