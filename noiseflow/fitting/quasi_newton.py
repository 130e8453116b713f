"""L-BFGS in place, one gradient per step, with a line search that needs no values of the objective."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

# Slope along the line, relative to the one at its start: a step that ends uphill by more has gone too far, one that still
# descends by more not far enough. Only then does a line need another gradient; the second also keeps the curvature positive.
_UPHILL, _STILL_DOWNHILL = 0.5, 0.9
# Gradients along one line, after which its last point is taken and the pairs are dropped.
_MOST_ON_A_LINE = 6
# Limits of the next point, as shares of the bracket, and as multiples of a step that was too short.
_BRACKET, _STRETCH = (0.1, 0.9), (1.5, 4.0)


class QuasiNewton(torch.optim.Optimizer):
    """L-BFGS (Nocedal 1980, doi:10.2307/2006193) for smooth objectives without sampling noise.

    Each step uses the gradient at the current parameters and moves them to the next point: along a new line, or to a better point
    of the same line. Points are judged by the slope along the line, so that objectives known only by their gradient (tabulated
    likelihoods) can be minimised. Pairs of steps and gradient changes are stored as one long vector each.

    Args:
        groups: parameter groups with ``lr``, here the scale of their values: curvatures with respect to value / ``lr`` should be
            alike. The first step changes no value by more than its ``lr``. Rates that decrease later have no effect.
        pairs: number of stored pairs; each needs twice the memory of the parameters.

    Example:
        >>> import torch
        >>> from noiseflow.fitting.quasi_newton import QuasiNewton
        >>> place = torch.nn.Parameter(torch.tensor([3.0, 4.0]))
        >>> optimiser = QuasiNewton([{"params": [place], "lr": 0.5}])
        >>> for _ in range(20):
        ...     place.grad = 2 * place.detach() * torch.tensor([1.0, 30.0])
        ...     optimiser.step()
        >>> bool(place.abs().max() < 1e-3)
        True
    """

    def __init__(self, groups: Iterable[dict[str, Any]], *, pairs: int = 5) -> None:
        super().__init__(list(groups), {"lr": 1.0})
        self.pairs = pairs

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Use the gradients of the parameters, and move to the next point."""
        del closure
        search, gradient = self.state[self._parameters()[0][0]], self._gradient()
        if search:
            length = _adjusted(search, float(torch.dot(search["direction"], gradient)))
            if length is not None:
                self._move(search, length)
                return
            self._remember(search, gradient)
        else:
            first = 1 / max(float(gradient.abs().max()), torch.finfo(gradient.dtype).tiny)
            search |= {
                "steps": [],
                "changes": [],
                "scales": [scale for _, scale in self._parameters()],
                "per_gradient": first,
            }
        self._set_off(search, gradient)

    def _parameters(self) -> list[tuple[Tensor, float]]:
        return [(parameter, group["lr"]) for group in self.param_groups for parameter in group["params"]]

    def _gradient(self) -> Tensor:
        """The gradient with respect to the scaled parameters, one vector."""
        search, parameters = self.state[self._parameters()[0][0]], self._parameters()
        scales = search["scales"] if search else [scale for _, scale in parameters]
        gradient = torch.zeros(sum(each.numel() for each, _ in parameters)).to(parameters[0][0])
        parts = torch.split(gradient, [each.numel() for each, _ in parameters])
        for (parameter, _), part, scale in zip(parameters, parts, scales, strict=True):
            if parameter.grad is not None:
                torch.mul(parameter.grad.reshape(-1), scale, out=part)
        return gradient

    def _move(self, search: dict[str, Any], length: float) -> None:
        """Move to a point of the line, a multiple of its direction away from its start."""
        change, search["length"] = length - search["length"], length
        parameters = [parameter for parameter, _ in self._parameters()]
        parts = torch.split(search["direction"], [each.numel() for each in parameters])
        for parameter, part, scale in zip(parameters, parts, search["scales"], strict=True):
            parameter.add_(part.view_as(parameter), alpha=change * scale)

    def _remember(self, search: dict[str, Any], gradient: Tensor) -> None:
        """Store the step to the current point and the change of the gradient, in the memory of the oldest pair."""
        steps, changes = search["steps"], search["changes"]
        if search["tries"] >= _MOST_ON_A_LINE:
            steps.clear()
            changes.clear()
            return
        change = torch.sub(gradient, search["gradient"], out=search["gradient"])
        curvature = search["length"] * float(torch.dot(change, search["direction"]))
        if curvature > 0:
            steps.append(search["direction"].mul_(search["length"]))
            changes.append(change)
            del steps[: -self.pairs], changes[: -self.pairs]
            search["per_gradient"] = curvature / float(torch.dot(change, change))

    def _set_off(self, search: dict[str, Any], gradient: Tensor) -> None:
        """Start along a new line."""
        direction = _newton(gradient, search["steps"], search["changes"], search["per_gradient"])
        slope = float(torch.dot(direction, gradient))
        if not slope < 0:
            search["steps"].clear()
            search["changes"].clear()
            direction = gradient.mul(-search["per_gradient"])
            slope = float(torch.dot(direction, gradient))
        search |= {"gradient": gradient, "direction": direction, "slope": slope, "length": 0.0, "tries": 1}
        search |= {"near": [0.0, slope], "far": None}
        self._move(search, 1.0)


def _newton(gradient: Tensor, steps: list[Tensor], changes: list[Tensor], per_gradient: float) -> Tensor:
    """The two-loop recursion: minus the inverse Hessian of the pairs, and of one curvature besides, times the gradient."""
    direction, shares, curvatures = (
        gradient.neg(),
        [],
        [float(torch.dot(s, y)) for s, y in zip(steps, changes, strict=True)],
    )
    for step, change, curvature in zip(steps[::-1], changes[::-1], curvatures[::-1], strict=True):
        shares.append(float(torch.dot(step, direction)) / curvature)
        direction.add_(change, alpha=-shares[-1])
    direction.mul_(per_gradient)
    for step, change, curvature, share in zip(steps, changes, curvatures, shares[::-1], strict=True):
        direction.add_(step, alpha=share - float(torch.dot(change, direction)) / curvature)
    return direction


def _adjusted(search: dict[str, Any], slope: float) -> float | None:
    """A better point on the line than the current one with this slope; None if it is good enough."""
    length: float = search["length"]
    first: float = search["slope"]
    too_far, too_near = slope > -_UPHILL * first, slope < _STILL_DOWNHILL * first
    if search["tries"] >= _MOST_ON_A_LINE or not (too_far or (too_near and search["far"] is None)):
        return None
    search["tries"] += 1
    near: float
    slope_near: float
    near, slope_near = search["near"]
    # where the slope would be zero if it changed linearly
    zero = near + (length - near) * slope_near / (slope_near - slope) if slope > slope_near else float("inf")
    if too_far:
        search["far"] = length
        low, high = (near + share * (length - near) for share in _BRACKET)
        return min(max(zero, low), high)
    search["near"] = [length, slope]
    low, high = (length * factor for factor in _STRETCH)
    return min(max(zero, low), high)
