"""Latent dynamics, and what the machine makes of its commands."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from mpc_sgft.learning.layers import mlp, simnorm


class CommandMap(nn.Linear):
    """What a machine makes of its commands u [..., K]: each c_i of W u + b, brought nearer to zero by a dead band d_i.

        c' = c - d sign(c) where |c| > d, else 0

    Starts as the identity. Where d is learned and falls below zero, c' is larger than c.

    Args:
        inputs: K, the entries of this command and those before it, newest first.
        outputs: Entries of a command [A].
        band: Whether there is a dead band; without one c' is c.
    """

    def __init__(self, inputs: int, outputs: int, *, band: bool = False) -> None:
        super().__init__(inputs, outputs)
        nn.init.eye_(self.weight)
        nn.init.zeros_(self.bias)
        self.band = nn.Parameter(torch.zeros(outputs)) if band else None

    def forward(self, input: Tensor) -> Tensor:
        c = super().forward(input)
        return c if self.band is None else torch.where(c.abs() > self.band, c - self.band * c.sign(), 0.0)

    def neutral(self) -> Tensor:
        """The command [A] in [-1, 1] of which, before and now, W u + b is zero, as `Dynamics.neutral_action` has it."""
        held = self.weight.unflatten(-1, (-1, self.out_features)).sum(-2)  # of the same command at all times [A, A]
        found, failed = torch.linalg.solve_ex(held, -self.bias)
        return torch.where(failed == 0, found, 0.0).clamp(-1, 1)

    def change(self) -> Tensor:
        """Sum of the absolute differences of all numbers from those it started with, scalar."""
        numbers = [self.weight - torch.eye(*self.weight.shape, device=self.weight.device), self.bias]
        numbers += [] if self.band is None else [self.band]
        return torch.stack([x.abs().sum() for x in numbers]).sum()


class Dynamics(nn.Module):
    """Latent dynamics. A latent z = [s, m] is a code s [D] and the last commands m, newest first [M].

        c_i = map(u_i, u_{i+1}, ...) for each command u_i of u = [a, m]   what the machine makes of its commands
        s'  = SimNorm(f(s, c) [+ residual(s, c)])
        m'  = [a, m without its last command]                            exact, so only s' is learned

    Until `add_command_map` c is u. From then on a `CommandMap` is learned, from the identity on: a gain, a rotation, a
    drift, a delay, a lag, a few numbers that hold wherever the robot is. Commands older than the memory count as its
    oldest. `add_command_band` adds a second map, with a dead band, which learns beside it and acts in its place while
    `band_acts`: where all commands are large, a dead band and a weak arm look alike. A third, `joint`, learns together
    with what sensors are suspected of, and acts with it: a sensor that lies may look like a weak arm too.
    `add_residual` adds a correction that starts at zero.
    """

    band_acts: Tensor  # bool scalars
    joint_acts: Tensor

    def __init__(self, code_dim: int, memory_dim: int, action_dim: int, mlp_dim: int, simnorm_dim: int) -> None:
        super().__init__()
        inputs = code_dim + memory_dim + action_dim
        self.base = mlp([inputs, mlp_dim, mlp_dim, code_dim], out=nn.Identity())  # ends in LayerNorm
        self.residual: nn.Module | None = None
        self.command: CommandMap | None = None
        self.banded: CommandMap | None = None
        self.joint: CommandMap | None = None
        self.code_dim, self.memory_dim, self.simnorm_dim = code_dim, memory_dim, simnorm_dim

    def forward(self, z: Tensor, action: Tensor) -> Tensor:
        commands = self.commands(z, action)
        return self.next(z, commands, self.realised(commands))

    def commands(self, z: Tensor, action: Tensor) -> Tensor:
        """This command and those that the latent remembers, newest first [..., A + M]."""
        return torch.cat([action, z[..., self.code_dim :]], -1)

    def next(self, z: Tensor, commands: Tensor, realised: Tensor) -> Tensor:
        """The next latent, given what the machine makes of its commands, both newest first [..., A + M]."""
        x = torch.cat([z[..., : self.code_dim], realised], -1)  # [..., D + A + M]
        logits = self.base(x)
        code = simnorm(logits if self.residual is None else logits + self.residual(x), self.simnorm_dim)
        return torch.cat([code, commands[..., : self.memory_dim]], -1) if self.memory_dim else code

    def realised(self, commands: Tensor) -> Tensor:
        """What the machine makes of commands, newest first, [..., K A] -> [..., K A]."""
        if self.command is None:
            return commands
        each = commands.unflatten(-1, (-1, self.command.out_features))  # [..., K, A]
        lag = torch.arange(each.shape[-2], device=commands.device)
        longest = self.command.in_features // self.command.out_features
        window = (lag[:, None] + torch.arange(longest, device=commands.device)).clamp(max=len(lag) - 1)
        told = each[..., window, :].flatten(-2)
        return self._by_the_map_that_acts(lambda command: command(told)).flatten(-2)

    def neutral_action(self) -> Tensor | None:
        """The command [A] that the machine makes nothing of if it is given again and again; None: no command map.

        Nearest to it within [-1, 1], entry by entry; zero where the map that acts has no inverse.
        """
        return None if self.command is None else self._by_the_map_that_acts(CommandMap.neutral)

    def _by_the_map_that_acts(self, of: Callable[[CommandMap], Tensor]) -> Tensor:
        """What the map that acts gives; on a GPU all are asked, so that recorded graphs follow the choice."""
        assert self.command is not None
        rivals = [(x, self.band_acts) for x in (self.banded,) if x is not None]  # the later ones come first
        rivals += [(x, self.joint_acts) for x in (self.joint,) if x is not None]
        if not self.command.bias.is_cuda:
            return of(next((rival for rival, acts in reversed(rivals) if acts), self.command))
        found = of(self.command)
        for rival, acts in rivals:
            found = torch.where(acts, of(rival), found)
        return found

    def command_maps(self) -> list[CommandMap]:
        """All there are."""
        return [x for x in (self.command, self.banded, self.joint) if x is not None]

    def as_simulated(self, z: Tensor) -> Tensor:
        """The latent with its commands as the machine realised them: what the simulator would have called them."""
        if self.command is None or not self.memory_dim:
            return z
        return torch.cat([z[..., : self.code_dim], self.realised(z[..., self.code_dim :])], -1)


def side_by_side(parts: Sequence[Dynamics]) -> Callable[[Tensor, Tensor], Tensor]:
    """Dynamics that differ in their command map alone, each on its share of a batch [K B, ...]: one pass for all."""
    first = parts[0]

    def forward(z: Tensor, action: Tensor) -> Tensor:
        commands = first.commands(z, action)
        shares = zip(parts, commands.chunk(len(parts)), strict=True)
        return first.next(z, commands, torch.cat([dynamics.realised(share) for dynamics, share in shares]))

    return forward
