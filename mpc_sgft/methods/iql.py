"""Implicit Q-learning: critics that are only ever asked about actions that were taken, real and simulated."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.actor_critic import of_slices
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.implicit_q import check_implicit, fit_implicit
from mpc_sgft.learning.method import AbstractMethod, check_simulated
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import floats, to_slices


class IQL(AbstractMethod):
    """Critics, V and policy train on latents of the frozen encoder; everything else stays.

        V(z) is the tau-expectile of min_e Qbar_e(z, a)
        y = r + gamma (1 - terminated) V(z')
        the policy climbs exp((min_e Qbar_e(z, a) - V(z)) / lambda) log pi(a|z)

    over the actions that were taken.

    What differs from the publication: all parts begin as they were pretrained in simulation, and half of each batch is
    simulated, where the publication goes on from offline data; the latents are those of the pretrained world model, the
    critics and V are two-hot, the spread of the policy depends on the state.

    Args:
        lr, policy_lr: Of Adam for critics and V, and for the policy.
        expectile: tau in (0.5, 1): how close V comes to the best of the actions taken.
        temperature: lambda, reward units: how much better an action must be to weigh e times as much.
        simulated_episodes, updates, slice_len, action_noise: As in `AbstractMethod`.

    Raises:
        ValueError: If expectile or temperature is out of range, or simulated_episodes negative.

    Source: Kostrikov, Nair, Levine, ICLR 2022, arXiv:2110.06169 (its beta is 1 / lambda).
    """

    def __init__(
        self,
        *,
        lr: float,
        policy_lr: float,
        expectile: float,
        temperature: float,
        simulated_episodes: int,
        updates: int,
        slice_len: int,
        action_noise: float,
    ):
        check_implicit(expectile, temperature)
        check_simulated(simulated_episodes, 0)
        self.lr, self.policy_lr, self.expectile, self.temperature = lr, policy_lr, expectile, temperature
        self.simulated_episodes, self.updates = simulated_episodes, updates
        self.slice_len, self.action_noise = slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        parts = ("q_ensemble", "value_head", "policy_head")
        agent.train_only(parts, lr=self.lr, policy_lr=self.policy_lr, following=("target_q",))

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        found = of_slices(agent.model, to_slices(batch, agent.device))
        return floats(fit_implicit(agent, found, expectile=self.expectile, temperature=self.temperature))
