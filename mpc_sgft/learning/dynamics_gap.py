"""Which simulated transitions could have happened in reality: a density ratio from two classifiers.

    log P_real(z'|z, a) / P_sim(z'|z, a) = D(z, a, z') - D(z, a)

with D the log-odds that a transition is real: what the second knows of where the data lie is taken off the first.

Source: Eysenbach et al., "Off-Dynamics Reinforcement Learning" (DARC), ICLR 2021, arXiv:2006.13916.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mpc_sgft.learning.actor_critic import Transitions
from mpc_sgft.learning.layers import mlp
from mpc_sgft.learning.slices import check_finite


class DynamicsGap(nn.Module):
    """Learns the ratio from real and simulated transitions.

    Args:
        latent_dim, action_dim: Entries of a latent and of an action.
        lr: Of Adam.
        hidden: Size of the two hidden layers of each classifier.
        blur: Noise on what they learn from, in spreads of each entry: few real transitions are not learned by heart.
    """

    def __init__(self, latent_dim: int, action_dim: int, *, lr: float, hidden: int = 128, blur: float = 0.3) -> None:
        super().__init__()
        self.blur = blur
        pair = latent_dim + action_dim
        self.of_pair = mlp([pair, hidden, hidden, 1], zero_out=True)
        self.of_triple = mlp([pair + latent_dim, hidden, hidden, 1], zero_out=True)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr)

    def _odds(self, found: Transitions, blur: float = 0.0) -> tuple[Tensor, Tensor]:
        """Log-odds that a transition is real, without and with what followed, each [N]."""
        pair = torch.cat([found.z, found.action], -1)
        triple = torch.cat([pair, found.next_z - found.z], -1)  # a small step stands out less in z'
        if blur:
            triple = triple + blur * triple.std(0) * torch.randn_like(triple)
        return self.of_pair(triple[:, : pair.shape[1]]).squeeze(-1), self.of_triple(triple).squeeze(-1)

    def fit(self, found: Transitions, real: Tensor) -> dict[str, Tensor]:
        """One step of both classifiers.

        Args:
            found: Transitions, as many real ones as simulated.
            real: Which are, bool [N].

        Raises:
            FloatingPointError: If the loss is not finite; nothing has changed then.
        """
        losses = [F.binary_cross_entropy_with_logits(odds, real.float()) for odds in self._odds(found, self.blur)]
        metrics = {"gap_loss": torch.stack(losses).sum()}
        check_finite(metrics)
        self.optimizer.zero_grad()
        metrics["gap_loss"].backward()
        self.optimizer.step()
        return metrics

    @torch.no_grad()
    def log_ratio(self, found: Transitions) -> Tensor:
        """log P_real(z'|z, a) / P_sim(z'|z, a), [N]."""
        without, given = self._odds(found)
        return given - without
