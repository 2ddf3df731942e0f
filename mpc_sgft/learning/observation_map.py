"""What the sensors should have said: a turn and a shift of what is observed."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

SUFFIXES = "_x", "_y"


class Sensed(NamedTuple):
    """What a task observes [R] entries of, and where its simulated episodes start."""

    names: tuple[str, ...]  # of the entries, [R]
    starts: Tensor  # observed at the start of simulated episodes, [N, R]

    def points(self) -> list[list[int]]:
        """The pairs of entries that are the x and y of a point."""
        stems = [name.removesuffix(SUFFIXES[0]) for name in self.names if name.endswith(SUFFIXES[0])]
        pairs = ([stem + suffix for suffix in SUFFIXES] for stem in stems)
        return [[self.names.index(name) for name in pair] for pair in pairs if set(pair) <= set(self.names)]


class ObservationMap(nn.Module):
    """Corrects observations before the encoder sees them. Starts as the identity.

        p' = c + R(turn) (p - c) + shift   for each point;   x' = x + shift   for all other entries

    One camera sees all points, so the turn is theirs together; each entry has a shift of its own. There is no scale: it
    could make everything look alike, and what looks alike is easily predicted.

    Args:
        points: Pairs of entries that are the x and y of a point, [P, 2].
        centre: Where the entries lie on average, raw units [R]; points turn about their own.
        unit: How far they spread, raw units [R]: shifts are learned in these.
        blocks: Times that the entries stand at the head of an observation, the newest first.
    """

    centre: Tensor
    unit: Tensor

    def __init__(self, points: list[list[int]], centre: Tensor, unit: Tensor, blocks: int) -> None:
        super().__init__()
        self.points, self.blocks = points, blocks
        self.turn = nn.Parameter(torch.zeros(1))  # [rad]
        self.shift = nn.Parameter(torch.zeros_like(unit))  # [R], in units
        self.register_buffer("centre", centre.clone())
        self.register_buffer("unit", unit.clone())

    def forward(self, observation: Tensor) -> Tensor:
        """Corrected observations, [..., O] -> [..., O]; past actions stay as they are."""
        size = len(self.unit)
        seen = observation[..., : self.blocks * size].unflatten(-1, (self.blocks, size))
        right = seen + self.shift * self.unit
        if self.points:
            i, j = torch.tensor(self.points, device=seen.device).T
            x, y = (seen - self.centre)[..., i], (seen - self.centre)[..., j]
            cos, sin = torch.cos(self.turn), torch.sin(self.turn)
            turned = torch.zeros_like(seen)
            turned[..., i], turned[..., j] = (cos - 1) * x - sin * y, sin * x + (cos - 1) * y
            right = right + turned
        return torch.cat([right.flatten(-2), observation[..., self.blocks * size :]], -1)

    def size(self) -> Tensor:
        """Squared distance from the identity, scalar."""
        return self.turn.square().sum() + self.shift.square().sum()

    def outside(self, starts: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Mean squared distance of corrected starts [N, O] from a box of R entries, in units, scalar."""
        seen = self(starts)[..., : len(self.unit)]
        return (((seen - high).clamp_min(0) + (low - seen).clamp_min(0)) / self.unit).square().sum(-1).mean()
