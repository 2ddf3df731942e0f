"""The policy prior, pushed aside by a fixed sequence of offsets: how a machine is driven to learn what it is like."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from planners.base import FiniteChecks, Model, Plan, check_discount, check_finite, imagined_return


@dataclass(frozen=True, kw_only=True)
class ExploringPlanner:
    """Acts as clip(weight pi(z) + offset(t), -1, 1); the offset goes linearly from knot to knot over an episode.

    Attributes:
        action_dim: A.
        steps: Of an episode, over which the knots are spread evenly.
        weight: Of the policy prior's mean action; 0: the offsets alone.
        offsets: Knots, one or more of A numbers each.
        horizon: Control steps imagined ahead, only to value and show the plan.
        discount: gamma.

    Raises:
        ValueError: From the constructor, if a number is out of range or a knot has not A numbers.
    """

    action_dim: int
    steps: int
    weight: float
    offsets: Sequence[Sequence[float]]
    horizon: int = 4
    discount: float = 0.99

    def __post_init__(self) -> None:
        check_discount(self.discount)
        for name in ("action_dim", "steps", "horizon"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: a planner needs at least 1.")
        if not self.offsets or any(len(knot) != self.action_dim for knot in self.offsets):
            raise ValueError(f"offsets={self.offsets}: one or more knots, {self.action_dim} numbers each.")

    @torch.inference_mode()
    def plan(
        self,
        model: Model,
        z: Tensor,
        previous: Plan | None,
        fresh: Tensor | None,
        generator: torch.Generator,
        keep_candidates: bool = False,
        explore: bool = False,
    ) -> Plan:
        """Arguments and errors as `SamplingPlanner.plan`; `Plan.memory` counts the steps, and nothing is random."""
        done = z.new_zeros(len(z), 1) if previous is None or previous.memory is None else previous.memory
        done = done if fresh is None else torch.where(fresh[:, None], 0.0, done)
        knots = torch.tensor(self.offsets, dtype=z.dtype, device=z.device)  # [K, A]
        latents, actions = [z], []
        for t in range(self.horizon):
            prior = model.policy_prior(latents[-1], None)
            actions.append(pushed(prior, self.weight, offset_at(knots, (done[:, 0] + t) / max(self.steps - 1, 1))))
            latents.append(model.next(latents[-1], actions[-1]))
        path, mean = torch.stack(latents, -2), torch.stack(actions, -2)
        value = imagined_return(model, path, mean, self.discount)
        checks = FiniteChecks()
        checks.note("latents", z)
        checks.note_followed(path, mean)
        checks.note("values of the plan", value)
        check_finite("ExploringPlanner", checks.names, checks.stacked())
        kept = (mean.unsqueeze(1), value.unsqueeze(1)) if keep_candidates else (None, None)
        return Plan(mean[:, 0], mean, torch.zeros_like(mean), value, *kept, memory=done + 1)


def pushed(prior: Tensor, weight: Tensor | float, offset: Tensor) -> Tensor:
    """clip(weight prior + offset, -1, 1), any shape."""
    return (weight * prior + offset).clamp(-1, 1)


def offset_at(knots: Tensor, share: Tensor) -> Tensor:
    """What is between knots [..., K, A] at shares [B] of the way from the first to the last: [..., B, A]."""
    place = share.clamp(0, 1) * (knots.shape[-2] - 1)
    low = place.floor().long().clamp_max(max(knots.shape[-2] - 2, 0))
    high = (low + 1).clamp_max(knots.shape[-2] - 1)
    return torch.lerp(knots[..., low, :], knots[..., high, :], (place - low)[:, None])
