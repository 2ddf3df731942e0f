"""A policy that remembers: a GRU over the latents of an episode, which tells what the world of this episode is like."""

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import GRUModule, set_recurrent_mode

from mpc_sgft.learning.layers import mlp


class RecurrentPolicy(nn.Module):
    """Mean and log-deviation of an action, before they are squashed, from a latent and from all before it.

    Args:
        latent_dim: D.
        memory_dim: Entries of the memory [R].
        mlp_dim: Hidden size of what reads both.
        action_dim: A.
    """

    def __init__(self, latent_dim: int, memory_dim: int, mlp_dim: int, action_dim: int) -> None:
        super().__init__()
        self.memory_dim = memory_dim
        keys = {"in_keys": ["z", "memory", "is_init"], "out_keys": ["remembered", ("next", "memory")]}
        self.gru = GRUModule(latent_dim, memory_dim, **keys)
        self.head = mlp([latent_dim + memory_dim, mlp_dim, mlp_dim, 2 * action_dim])

    def forward(self, z: Tensor, memory: Tensor | None, begins: Tensor) -> tuple[Tensor, Tensor]:
        """One step of B episodes.

        Args:
            z: [B, D].
            memory: After the step before, [B, R]; None: nothing has been seen.
            begins: Episodes that begin here and remember nothing, bool [B].

        Returns:
            Moments [B, 2 A] and the new memory [B, R].
        """
        memory = z.new_zeros(len(z), self.memory_dim) if memory is None else memory
        step = TensorDict({"z": z, "memory": memory.unsqueeze(1), "is_init": begins.unsqueeze(-1)}, [len(z)])
        found = self.gru(step)
        return self._moments(z, found["remembered"]), found["next", "memory"].squeeze(1)

    def along(self, z: Tensor, begins: Tensor) -> Tensor:
        """Moments [B, T, 2 A] along sequences of latents [B, T, D]; an episode may begin anywhere, `begins` [B, T]."""
        empty = z.new_zeros(*z.shape[:2], 1, self.memory_dim)
        steps = TensorDict({"z": z, "memory": empty, "is_init": begins.unsqueeze(-1)}, z.shape[:2])
        with set_recurrent_mode(True):
            return self._moments(z, self.gru(steps)["remembered"])

    def _moments(self, z: Tensor, remembered: Tensor) -> Tensor:
        return self.head(torch.cat([z, remembered], -1))
