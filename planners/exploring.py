"""The policy prior, pushed aside by a fixed sequence of offsets: how a machine is driven to learn what it is like."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from planners.base import Model, Plan
from planners.policy import PolicyPlanner


@dataclass(frozen=True, kw_only=True)
class ExploringPlanner(PolicyPlanner):
    """Acts as clip(weight pi(z) + offset(t), -1, 1); the offset goes linearly from knot to knot over an episode.

    `Plan.memory` counts the steps of the episode, so a policy that remembers cannot be followed.

    Attributes:
        steps: Of an episode, over which the knots are spread evenly.
        weight: Of the policy prior; 0: the offsets alone.
        offsets: Knots, one or more of A numbers each.

    Raises:
        ValueError: From the constructor, if a number is out of range or a knot has not A numbers.
    """

    steps: int
    weight: float
    offsets: Sequence[Sequence[float]]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps < 1:
            raise ValueError(f"steps={self.steps}: an episode has at least 1.")
        if not self.offsets or any(len(knot) != self.action_dim for knot in self.offsets):
            raise ValueError(f"offsets={self.offsets}: one or more knots, {self.action_dim} numbers each.")

    def _followed(
        self, model: Model, z: Tensor, previous: Plan | None, fresh: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        done = z.new_zeros(len(z), 1) if previous is None or previous.memory is None else previous.memory
        done = done if fresh is None else torch.where(fresh[:, None], 0.0, done)
        knots = torch.tensor(self.offsets, dtype=z.dtype, device=z.device)  # [K, A]
        latents, actions = [z], []
        for t in range(self.horizon):
            prior = model.policy_prior(latents[-1], None if noise is None else noise[:, t])
            actions.append(pushed(prior, self.weight, offset_at(knots, (done[:, 0] + t) / max(self.steps - 1, 1))))
            latents.append(model.next(latents[-1], actions[-1]))
        return torch.stack(latents, -2), torch.stack(actions, -2), done + 1


def pushed(prior: Tensor, weight: Tensor | float, offset: Tensor) -> Tensor:
    """clip(weight prior + offset, -1, 1), any shape."""
    return (weight * prior + offset).clamp(-1, 1)


def offset_at(knots: Tensor, share: Tensor) -> Tensor:
    """What is between knots [..., K, A] at shares [B] of the way from the first to the last: [..., B, A]."""
    place = share.clamp(0, 1) * (knots.shape[-2] - 1)
    low = place.floor().long().clamp_max(max(knots.shape[-2] - 2, 0))
    high = (low + 1).clamp_max(knots.shape[-2] - 1)
    return torch.lerp(knots[..., low, :], knots[..., high, :], (place - low)[:, None])
