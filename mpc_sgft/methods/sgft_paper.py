"""SGFT as it was published: TD-MPC2 goes on training, but for its critic, which is frozen and shapes the objective."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.fit import fit_model
from mpc_sgft.learning.method import AbstractMethod, check_objective
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import floats, to_slices


class SGFTPaper(AbstractMethod):
    """Algorithm 3 of the paper, with nothing of ours: encoder, dynamics, reward and policy prior train, V is frozen.

    V is frozen as a function of the latent. Where the encoder trains, V of an observation moves all the same.

    The model trains on TD-MPC2's consistency and reward losses. The planner and the policy prior maximise

        J = sum_{t<H} gamma^t r_t + gamma^H V(z_H) - V(z_0)

    What differs from the publication: there the prior is trained as in TD-MPC2, by a Q that does not train either;
    here it climbs J through the learned dynamics, as in `sgft`. The latent carries past commands as they are.

    Args:
        horizon: Imagined steps of the policy's objective [H].
        lr, policy_lr: Of Adam for the model (the encoder takes its share of it) and the policy prior.
        encoder, reward: Whether these train; V is a fixed function of the observation only if the encoder does not.
        entropy_coef: Weight of the policy's entropy in its objective, fixed.
        rho: Weight of step t of the model's losses is rho^t.
        updates, slice_len, action_noise: As in `AbstractMethod`.

    Raises:
        ValueError: If the horizon is not positive or rho lies outside (0, 1].

    Source: Yin, Westenbroek et al., ICLR 2025, Algorithm 3; losses: Hansen, Su, Wang, arXiv:2310.16828.
    """

    def __init__(
        self,
        *,
        horizon: int,
        lr: float,
        policy_lr: float,
        encoder: bool,
        reward: bool,
        entropy_coef: float,
        rho: float,
        updates: int,
        slice_len: int,
        action_noise: float,
    ):
        check_objective(horizon, rho)
        self.horizon, self.lr, self.policy_lr = horizon, lr, policy_lr
        self.entropy_coef, self.rho = entropy_coef, rho
        self.encoder, self.reward = encoder, reward
        self.updates, self.slice_len, self.action_noise = updates, slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        parts: tuple[str, ...] = ("dynamics", "policy_head")
        parts += ("encoder",) * self.encoder + ("reward_head",) * self.reward
        agent.train_only(parts, lr=self.lr, policy_lr=self.policy_lr)

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        metrics, encoded = fit_model(agent, to_slices(batch, agent.device), rho=self.rho)
        return floats(metrics | agent.climb(encoded[0], horizon=self.horizon, entropy_coef=self.entropy_coef))
