"""Dyna-SGFT: soft actor-critic on shaped rewards that end after H steps, seen and imagined."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.actor_critic import branches, fit_soft, forget_critics, guided, joined, of_slices
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.fit import fit_dynamics
from mpc_sgft.learning.method import AbstractMethod, check_objective
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import floats, to_slices


class SGFTSAC(AbstractMethod):
    """Algorithm 2 of the paper. Encoder, reward and V are frozen; the dynamics, new critics and the policy train.

    From each real state of a batch a few short branches of the policy are imagined. On these and on the real steps
    alike the reward is

        rbar = r + gamma (1 - terminated) V_sim(z') - V_sim(z)

    and every `slice_len` = H steps are an episode of their own.

    What differs from the publication: the policy acts from latents of the pretrained world model; the model of the
    branches is the pretrained dynamics, trained on, not one anew; rollouts count from the first (there, twenty of the
    simulation's policy come before); real rollouts follow the mean action with noise.

    Args:
        slice_len: H, steps of a branch and of what is cut out of a rollout.
        branches: Imagined for each real state; 0 leaves Algorithm 1 on SAC.
        lr, policy_lr: Of Adam for dynamics and critics, and for the policy.
        entropy_coef: alpha, fixed.
        rho: Weight of step t of the dynamics loss is rho^t.
        updates, action_noise: As in `AbstractMethod`.

    Raises:
        ValueError: If slice_len is not positive, branches is negative, or rho lies outside (0, 1].

    Source: Yin, Westenbroek et al., ICLR 2025, Algorithms 1 and 2.
    """

    def __init__(
        self,
        *,
        slice_len: int,
        branches: int,
        lr: float,
        policy_lr: float,
        entropy_coef: float,
        rho: float,
        updates: int,
        action_noise: float,
    ):
        if slice_len < 1 or branches < 0:
            raise ValueError(f"slice_len={slice_len} must be 1 or more, and branches={branches} 0 or more.")
        check_objective(slice_len, rho)
        self.slice_len, self.branches, self.rho = slice_len, branches, rho
        self.lr, self.policy_lr, self.entropy_coef = lr, policy_lr, entropy_coef
        self.updates, self.action_noise = updates, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        parts = ("dynamics", "q_ensemble", "policy_head")
        agent.train_only(parts, lr=self.lr, policy_lr=self.policy_lr, following=("target_q",))
        forget_critics(agent.model)

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        data, steps = to_slices(batch, agent.device), self.slice_len
        metrics, _ = fit_dynamics(agent, data, rho=self.rho)
        parts = [of_slices(agent.model, data)]
        if self.branches:
            z = parts[0].z.repeat(self.branches, 1)
            parts.append(branches(agent.model, z, agent.noise(steps, len(z))))
        every = joined(*(guided(agent.model, part, agent.discount, steps) for part in parts))
        return floats(metrics | fit_soft(agent, every, entropy_coef=self.entropy_coef))
