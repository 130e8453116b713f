"""Counting detectors with dead time: the model, and the distribution of its counts."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.laws.textbook import PoissonDistribution, gamma_mass
from noiseflow.models.base import NoiseModelBase


class DeadTimeCounter(NoiseModelBase):
    """Counts of single events by a detector with a fixed dead time after each count (non-paralysable).

    The signal is the expected *count*; the event rate signal/(1 − signal·dead_time) is higher. The variance is about
    signal·(1 − signal·dead_time)², less than that of Poisson counts.

    Args:
        dead_time: dead time as a share of the exposure, above 0 and below 1.

    Raises:
        ValueError: `dead_time` is outside this range.

    Example:
        >>> import noiseflow, torch
        >>> counter = noiseflow.DeadTimeCounter(dead_time=0.01)
        >>> bool(counter(torch.tensor(20.0)).variance < 20)  # scatters less than Poisson counts
        True
    """

    describes_single_readings = True
    fits_directly = True

    def __init__(self, dead_time: float = 1e-3) -> None:
        super().__init__()
        check(dead_time=dead_time)
        self.raw_dead_time = nn.Parameter(torch.logit(torch.tensor(float(dead_time))))

    @property
    def dead_time(self) -> Tensor:
        """Dead time as a share of the exposure."""
        return torch.sigmoid(self.raw_dead_time)

    def forward(self, signal: Tensor) -> DeadTimeDistribution:
        return DeadTimeDistribution(signal, self.dead_time)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the dead time from the variance of (N,) signals and counts, signal·(1 − signal·dead_time)²."""
        signal, observation = signal.double(), observation.double()
        lack = signal - (observation - signal) ** 2  # its expectation is 2·signal²·dead_time, to first order
        weight = 1 / signal.clamp(min=1e-3)
        share = (weight * lack).sum() / (2 * weight * signal**2).sum()
        self.raw_dead_time.copy_(torch.logit(share.clamp(1e-5, 0.5 / max(1.0, float(signal.max())))))

    def extra_repr(self) -> str:
        return f"dead_time={self.dead_time.item():.4g}"


class DeadTimeDistribution(PoissonDistribution):
    """Counts in one exposure of a non-paralysable counter in its stationary state (a stationary renewal process).

    With event rate λ and dead time τ, the k-th count after one at time 0 occurs at kτ plus a gamma variable of shape k;
    P(counts > k) = m·(M_k − M_{k+1}) with the mean m = λ/(1 + λτ) and M_k = E max(1 − time of k counts, 0)
    (D. R. Cox, Renewal Theory, 1962, section 4.4). Above the mean M_k is used; below it E max(time − 1, 0), which differs by a
    linear function of k. This avoids cancellation in both tails.

    Args:
        signal: expected counts, any shape; less than 1/dead_time, the upper bound at any event rate.
        dead_time: dead time as a share of the exposure, from 0 to 1.
    """

    def __init__(self, signal: Tensor, dead_time: Tensor) -> None:
        super().__init__(signal, torch.ones_like(dead_time), torch.zeros_like(dead_time))
        self.dead_time = self.working(dead_time)

    @property
    def rate(self) -> Tensor:
        """Expected counts, at most 1/dead_time."""
        return torch.minimum(self.signal.clamp(min=0), (1 - 1e-6) / self.dead_time.clamp(min=1e-12))

    def _excess(self, count: Tensor, *, early: bool) -> Tensor:
        """E max(1 − t, 0), where t is the time of `count` counts, or E max(t − 1, 0) if not `early`; float64."""
        mean, dead_time = self.rate.double(), self.dead_time.double()
        events = mean / (1 - mean * dead_time)  # per exposure
        left = 1 - count * dead_time
        argument = (events * left).clamp(min=0)
        shape = count.clamp(min=1) + 0 * argument.detach()
        near, far = (gamma_mass(each, argument, upper=not early) for each in (shape, shape + 1))
        waiting = count / events.clamp(min=1e-300)
        found = left * near - waiting * far if early else waiting * far - left * near
        at_once = left if early else torch.zeros_like(left)
        found = torch.where(left > 0, found, torch.zeros_like(found) if early else waiting - left)
        return torch.where(count > 0, found, at_once + 0 * found).clamp(min=0)

    def _differences(self, count: Tensor, weights: tuple[float, ...], *, early: bool) -> Tensor:
        """Weighted sum of the excesses of count − 1, count, …, times the mean."""
        parts = [weight * self._excess(count - 1 + step, early=early) for step, weight in enumerate(weights) if weight]
        return (self.rate.double() * sum(parts, torch.zeros_like(parts[0]))).clamp(min=0)

    def log_masses(self, count: Tensor) -> Tensor:
        mean = self.rate.double()
        count = count.double() + 0 * mean.detach()
        positive = (count > 0) & (mean > 0)
        inside = torch.where(positive, count, torch.ones_like(count))
        late, early = (self._differences(inside, (1.0, -2.0, 1.0), early=each) for each in (True, False))
        mass = torch.where(inside > mean, late, early)
        # no event after the start, or after the remainder of a dead time that began before it
        alive = 1 - mean * self.dead_time.double()
        none = alive * torch.exp(-mean / alive * (1 - self.dead_time.double()))
        mass = torch.where(positive, mass, torch.where(count == 0, none, torch.zeros_like(none)))
        log_mass = torch.where(mass > 0, torch.log(torch.where(mass > 0, mass, torch.ones_like(mass))), -math.inf)
        return torch.where(torch.isnan(mean), mean, log_mass).to(self.signal.dtype)

    def _mass_up_to(self, count: Tensor, *, beyond: bool = False) -> Tensor:
        mean = self.rate.double()
        inside = (count.double() + 0 * mean.detach()).clamp(min=0)
        above = self._differences(inside + 1, (1.0, -1.0), early=True)
        below = self._differences(inside + 1, (-1.0, 1.0), early=False)
        late = inside + 1 > mean
        mass = torch.where(late, above, 1 - below) if beyond else torch.where(late, 1 - above, below)
        mass = torch.where(count >= 0, mass.clamp(0, 1), torch.full_like(mass, float(beyond)))
        return torch.where(torch.isnan(mean), mean, mass).to(self.signal.dtype)

    def _poisson(self, shape: tuple[int, ...], generator: torch.Generator | None, *, many: int = 4000) -> Tensor:
        """Simulate counts event by event in float64: a first wait from the stationary state, then dead time and wait in turn. Of
        `many` counts, quantiles are found sooner."""
        mean = self.rate.detach().double().expand(shape)
        dead_time = self.dead_time.detach().double()
        events = mean / (1 - mean * dead_time)

        def uniform() -> Tensor:
            return torch.rand(shape, generator=generator, dtype=torch.float64, device=mean.device)

        if mean.numel() and float(mean.nan_to_num().max()) > many:
            return self.expand(shape).icdf(uniform()).to(self.signal.dtype)
        dead = (uniform() < mean * dead_time) * uniform() * dead_time
        clock = dead - torch.log1p(-uniform()) / events
        counts = torch.zeros(shape, dtype=torch.float64, device=mean.device)
        while bool((clock < 1).any()):
            counts += clock < 1
            clock = clock + dead_time - torch.log1p(-uniform()) / events
        return torch.where(torch.isnan(mean), mean, counts).to(self.signal.dtype)

    @property
    def variance(self) -> Tensor:
        """m − m² + 2m·Σ_k M_k."""
        mean = self.rate.double()
        most = int(torch.nan_to_num(mean + 12 * (torch.sqrt(mean) + 1)).detach().max()) if mean.numel() else 0
        total = torch.zeros_like(mean)
        for count in range(1, most + 1):
            total = total + self._excess(torch.full_like(mean, float(count)), early=True)
        return (mean - mean**2 + 2 * mean * total).clamp(min=0).to(self.signal.dtype)
