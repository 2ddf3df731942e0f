"""Delta actions: real data correct the simulator's dynamics, and the policy goes on training in the corrected ones."""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.actor_critic import branches, fit_soft
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.delta_action import DeltaAction
from mpc_sgft.learning.method import AbstractMethod, check_objective, check_simulated
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import Slices, floats, to_slices


class ASAP(AbstractMethod):
    """The pretrained dynamics are the simulator, and stay. A correction of commands learns to make them do what
    reality did; critics and policy train, as in `SAC`, on short branches of the corrected dynamics alone:

        delta minimises |f(z, a + delta(z, a)) - z'|^2 over real slices
        y = r + gamma (min_e Qbar_e(z', a') - alpha log pi(a'|z')),   z' = f(z, a + delta(z, a)),  a = pi(z)

    from real and simulated states, and the policy acts without the correction.

    What differs from the publication: the simulator is the pretrained latent dynamics, through which the correction
    learns by gradient, where there it is trained by reinforcement to track whole motions; the policy is the same SAC as
    that of the other methods here, where there it is PPO.

    Args:
        lr, policy_lr: Of Adam for correction and critics, and for the policy.
        entropy_coef: alpha, fixed.
        rho: Weight of imagined step t of the correction's loss is rho^t.
        shrink: Weight of the mean squared correction.
        steps: Of a branch.
        simulated_episodes, updates, slice_len, action_noise: As in `AbstractMethod`.

    Raises:
        ValueError: If there are no simulated episodes, steps is not positive, shrink is negative, or rho lies outside
            (0, 1].

    Source: He et al., "ASAP", RSS 2025, arXiv:2502.01143.
    """

    def __init__(
        self,
        *,
        lr: float,
        policy_lr: float,
        entropy_coef: float,
        rho: float,
        shrink: float,
        steps: int,
        simulated_episodes: int,
        updates: int,
        slice_len: int,
        action_noise: float,
    ):
        check_simulated(simulated_episodes, 1)
        if steps < 1 or shrink < 0:
            raise ValueError(f"steps={steps} must be 1 or more, and shrink={shrink} 0 or more.")
        check_objective(steps, rho)
        self.lr, self.policy_lr, self.entropy_coef = lr, policy_lr, entropy_coef
        self.rho, self.shrink, self.steps = rho, shrink, steps
        self.simulated_episodes, self.updates = simulated_episodes, updates
        self.slice_len, self.action_noise = slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        agent.train_only(("q_ensemble", "policy_head"), lr=self.lr, policy_lr=self.policy_lr, following=("target_q",))
        model = agent.model
        self.corrected = DeltaAction(model.dynamics, model.latent_dim, model.action_dim, lr=self.lr).to(agent.device)

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        data = to_slices(batch, agent.device)
        with torch.no_grad():
            encoded = agent.model.encode(data.observation)  # [T + 1, B, D]
        real = len(batch) // 2
        seen = Slices(*(x[:, :real] for x in data))
        metrics = self.corrected.fit(seen, encoded[:, :real], rho=self.rho, shrink=self.shrink)
        noise = agent.noise(self.steps, encoded.shape[1])
        found = branches(agent.model, encoded[0], noise, dynamics=self.corrected)
        return floats(metrics | fit_soft(agent, found, entropy_coef=self.entropy_coef))

    def state_dict(self) -> dict[str, Any]:
        parts = {"delta": self.corrected.state_dict(), "optimizer": self.corrected.optimizer.state_dict()}
        return copy.deepcopy(parts)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.corrected.load_state_dict(state["delta"])
        self.corrected.optimizer.load_state_dict(state["optimizer"])
