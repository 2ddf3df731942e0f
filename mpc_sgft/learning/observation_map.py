"""What the sensors should have said: a turn and a shift of what is observed."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SUFFIXES = "_x", "_y"
SMALL = 0.1  # shift of an entry, in its spreads, up to which a suspicion corrects nothing


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

    Only doubted entries are corrected, and points are turned only if an entry of one is. Doubt comes from where
    episodes start: nothing has moved yet, so if it looks odd there, no dynamics can be to blame. Without that a map
    explains whatever the dynamics do otherwise than in simulation, and moves a nail that only sits harder. A thing that
    is seen beside its place may still start where others do; what moves it tells then. So the other entries have shifts
    too, which correct nothing until `suspects` says that they do: only those that are not small.

    Args:
        points: Pairs of entries that are the x and y of a point, [P, 2].
        centre: Where the entries lie on average, raw units [R]; points turn about their own.
        unit: How far they spread, raw units [R]: shifts are learned in these.
        blocks: Times that the entries stand at the head of an observation, the newest first.
    """

    centre: Tensor
    unit: Tensor
    doubted: Tensor
    suspects: Tensor

    def __init__(self, points: list[list[int]], centre: Tensor, unit: Tensor, blocks: int) -> None:
        super().__init__()
        self.points, self.blocks = points, blocks
        self.turn = nn.Parameter(torch.zeros(1))  # [rad]
        self.shift = nn.Parameter(torch.zeros_like(unit))  # [R], in units
        self.register_buffer("centre", centre.clone())
        self.register_buffer("unit", unit.clone())
        self.register_buffer("doubted", torch.zeros_like(unit))  # 0 or 1, [R]
        self.register_buffer("suspects", torch.tensor(False, device=unit.device))  # bool scalar

    @property
    def turned(self) -> Tensor:
        """By how much points are turned [rad], [1]."""
        return self.turn * self.doubted[sum(self.points, [])].amax() if self.points else torch.zeros_like(self.turn)

    @property
    def shifted(self) -> Tensor:
        """By how much entries are shifted, raw units [R]."""
        corrected = self.doubted.bool() | (self.suspects & (self.shift.abs() > SMALL))
        return torch.where(corrected, self.shift, 0.0) * self.unit

    def forward(self, observation: Tensor, *, suspected: bool | None = None) -> Tensor:
        """Corrected observations, [..., O] -> [..., O]; past actions stay as they are.

        Args:
            observation: As seen.
            suspected: False: as if nothing were suspected. True: in all entries; only the shifts of those that are not
                doubted learn by it. None: in those that are corrected now.
        """
        size, doubted = len(self.unit), self.doubted.bool()
        shifted, turned = self.shifted, self.turned
        if suspected is not None:
            shift = torch.where(doubted, self.shift.detach(), self.shift) if suspected else self.doubted * self.shift
            shifted = shift * self.unit
            turned = turned.detach() if suspected else turned
        seen = observation[..., : self.blocks * size].unflatten(-1, (self.blocks, size))
        right = seen + shifted
        if self.points:
            i, j = torch.tensor(self.points, device=seen.device).T
            x, y = (seen - self.centre)[..., i], (seen - self.centre)[..., j]
            cos, sin = torch.cos(turned), torch.sin(turned)
            moved = torch.zeros_like(seen)
            moved[..., i], moved[..., j] = (cos - 1) * x - sin * y, sin * x + (cos - 1) * y
            right = right + moved
        return torch.cat([right.flatten(-2), observation[..., self.blocks * size :]], -1)

    def size(self) -> Tensor:
        """Squared distance from the identity, of the turn and of doubted entries, scalar."""
        return self.turn.square().sum() + (self.doubted * self.shift).square().sum()

    def suspicion(self) -> Tensor:
        """Sum of the absolute shifts of entries that are not doubted, in units, scalar."""
        return ((1 - self.doubted) * self.shift).abs().sum()

    @torch.no_grad()
    def doubt(self, starts: Tensor, low: Tensor, high: Tensor, enough: float) -> None:
        """Doubt the entries whose starts [N, O], as they were seen, lie outside a box by more than `enough` in sum.

        A sum: one start that is clearly outside stays so, however many lie within.
        """
        self.doubted.copy_(self._outside(starts[..., : len(self.unit)], low, high).sum(0) > enough)

    def outside(self, starts: Tensor, low: Tensor, high: Tensor, *, suspected: bool | None = None) -> Tensor:
        """How far corrected starts [N, O] lie outside a box of R entries, in units, mean over starts, scalar.

        Distances are squared up to one unit and linear beyond (Huber, 1964): an entry that hardly moved in simulation,
        and so has a tiny unit, must not drown the others.
        """
        return self._outside(self(starts, suspected=suspected)[..., : len(self.unit)], low, high).mean(0).sum()

    def _outside(self, seen: Tensor, low: Tensor, high: Tensor) -> Tensor:
        far = ((seen - high).clamp_min(0) + (low - seen).clamp_min(0)) / self.unit
        return 2 * F.huber_loss(far, torch.zeros_like(far), reduction="none")
