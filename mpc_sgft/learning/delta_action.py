"""What must be added to a command so that the simulator does with it what reality did: a delta action.

Source: He et al., "ASAP: Aligning Simulation and Real-World Physics", RSS 2025, arXiv:2502.01143.
"""

import torch
from torch import Tensor, nn

from mpc_sgft.learning import losses
from mpc_sgft.learning.dynamics import Dynamics
from mpc_sgft.learning.layers import mlp
from mpc_sgft.learning.slices import Slices, check_finite


class DeltaAction(nn.Module):
    """Pretrained dynamics, frozen, under commands that are corrected first; what it leads to is called reality.

        z' = f(z, a + delta(z, a)), in which the command a is remembered as it was given

    The correction starts at zero.

    Args:
        dynamics: f, kept as it is.
        latent_dim, action_dim: Entries of a latent and of an action.
        lr: Of Adam.
        hidden: Size of the two hidden layers of delta.
    """

    def __init__(self, dynamics: Dynamics, latent_dim: int, action_dim: int, *, lr: float, hidden: int = 128) -> None:
        super().__init__()
        self.delta = mlp([latent_dim + action_dim, hidden, hidden, action_dim], zero_out=True)
        self.optimizer = torch.optim.Adam(self.delta.parameters(), lr=lr)
        self._simulated = (dynamics,)  # in a tuple: what is frozen is not this module's to save

    def forward(self, z: Tensor, action: Tensor) -> Tensor:
        """Latent after a command, [..., D], [..., A] -> [..., D]."""
        (dynamics,) = self._simulated
        following = dynamics(z, action + self.delta(torch.cat([z, action], -1)))
        if not dynamics.memory_dim:
            return following
        code, past = following[..., : dynamics.code_dim], following[..., dynamics.code_dim + action.shape[-1] :]
        return torch.cat([code, action, past], -1)

    def fit(self, data: Slices, encoded: Tensor, *, rho: float, shrink: float) -> dict[str, Tensor]:
        """One step toward what was seen.

        Args:
            data: Slices of T real steps.
            encoded: Their latents, [T + 1, B, D].
            rho: Weight of imagined step t is rho^t.
            shrink: Weight of the mean squared correction.

        Raises:
            FloatingPointError: If the loss is not finite; nothing has changed then.
        """
        zs = losses.imagine(self, encoded[0], data.action)
        size = self.delta(torch.cat([encoded[:-1], data.action], -1)).square().mean()
        error = losses.over_time(losses.consistency_loss(zs[1:], encoded[1:]), rho)
        metrics = {"consistency_loss": error, "delta_size": size}
        check_finite(metrics)
        self.optimizer.zero_grad()
        (error + shrink * size).backward(inputs=list(self.delta.parameters()))
        self.optimizer.step()
        return metrics
