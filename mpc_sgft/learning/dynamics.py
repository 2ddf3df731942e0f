"""Latent dynamics, and what the machine makes of its commands."""

import torch
from torch import Tensor, nn

from mpc_sgft.learning.layers import mlp, simnorm


class Dynamics(nn.Module):
    """Latent dynamics. A latent z = [s, m] is a code s [D] and the last commands m, newest first [M].

        c_i = sum_j W_j u_{i+j} + b for each command u_i of u = [a, m]   what the machine makes of its commands
        s'  = SimNorm(f(s, c) [+ residual(s, c)])
        m'  = [a, m without its last command]                            exact, so only s' is learned

    Until `add_command_map` c is u. From then on W and b are learned, from the identity on: a gain, a rotation, a drift,
    a delay, a lag, a few numbers that hold wherever the robot is. Commands older than the memory count as its oldest.
    `add_residual` adds a correction that starts at zero.
    """

    def __init__(self, code_dim: int, memory_dim: int, action_dim: int, mlp_dim: int, simnorm_dim: int) -> None:
        super().__init__()
        inputs = code_dim + memory_dim + action_dim
        self.base = mlp([inputs, mlp_dim, mlp_dim, code_dim], out=nn.Identity())  # ends in LayerNorm
        self.residual: nn.Module | None = None
        self.command: nn.Linear | None = None
        self.code_dim, self.memory_dim, self.simnorm_dim = code_dim, memory_dim, simnorm_dim

    def forward(self, z: Tensor, action: Tensor) -> Tensor:
        commands = torch.cat([action, z[..., self.code_dim :]], -1)  # newest first [..., A + M]
        x = torch.cat([z[..., : self.code_dim], self.realised(commands)], -1)  # [..., D + A + M]
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
        return self.command(each[..., window, :].flatten(-2)).flatten(-2)

    def command_change(self) -> Tensor:
        """Sum of the absolute differences of the command map from the identity, scalar."""
        assert self.command is not None, "there is no command map"
        weight, bias = self.command.weight, self.command.bias
        return (weight - torch.eye(*weight.shape, device=weight.device)).abs().sum() + bias.abs().sum()

    def as_simulated(self, z: Tensor) -> Tensor:
        """The latent with its commands as the machine realised them: what the simulator would have called them."""
        if self.command is None or not self.memory_dim:
            return z
        return torch.cat([z[..., : self.code_dim], self.realised(z[..., self.code_dim :])], -1)
