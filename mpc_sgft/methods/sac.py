"""Soft actor-critic on real data, from the pretrained policy and critics: no planner, no model, no guidance."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.actor_critic import Transitions, fit_soft, of_slices
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.method import AbstractMethod
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import floats, to_slices


class SAC(AbstractMethod):
    """Critics and policy train on latents of the frozen encoder; everything else stays.

        y = r + gamma (1 - terminated) (min_e Qbar_e(z', a') - alpha log pi(a'|z'))

    and the policy climbs min_e Q_e(z, a) - alpha log pi(a|z).

    What differs from the publication: the latents are those of the pretrained world model, alpha is fixed, the critics
    are two-hot, and real rollouts follow the mean action with noise, as those of all methods here.

    Args:
        lr, policy_lr: Of Adam for the critics and the policy.
        entropy_coef: alpha.
        updates, slice_len, action_noise: As in `AbstractMethod`.

    Source: Haarnoja et al., arXiv:1812.05905.
    """

    def __init__(
        self, *, lr: float, policy_lr: float, entropy_coef: float, updates: int, slice_len: int, action_noise: float
    ):
        self.lr, self.policy_lr, self.entropy_coef = lr, policy_lr, entropy_coef
        self.updates, self.slice_len, self.action_noise = updates, slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        agent.train_only(("q_ensemble", "policy_head"), lr=self.lr, policy_lr=self.policy_lr, following=("target_q",))

    def transitions(self, agent: Agent, found: Transitions) -> Transitions:
        """What is learned from, made of what was seen; `slice_len` consecutive steps, time first."""
        return found

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        found = self.transitions(agent, of_slices(agent.model, to_slices(batch, agent.device)))
        return floats(fit_soft(agent, found, entropy_coef=self.entropy_coef))
