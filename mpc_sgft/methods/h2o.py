"""Dynamics-aware hybrid learning: soft actor-critic on real data, and on simulated as far as they could be real."""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.actor_critic import fit_soft, of_slices
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.dynamics_gap import DynamicsGap
from mpc_sgft.learning.method import AbstractMethod, check_simulated
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import floats, to_slices

LEAST = 1e-5  # weight of a simulated transition; the publication's
DEEPEST = 10.0  # largest gap [nat] that weighs in the penalty


class H2O(AbstractMethod):
    """Critics and policy train as in `SAC` on batches of which half is simulated; two classifiers learn which of these
    transitions could be real.

        w = P_real(z'|z, a) / P_sim(z'|z, a) of simulated transitions, in [1e-5, 1], and 1 of real ones
        u = -log of that ratio, in [1e-5, 10]
        the critics' losses are weighed by w, and to them comes
        beta (log E_sim[u / E_sim[u] exp Q(z, a)] - E_real[Q(z, a)])

    so that what simulation promises where its dynamics are wrong is not believed.

    What differs from the publication: policy and critics begin as they were pretrained; real data grow by the rollout,
    where there they are offline, and simulated ones are of the pretrained policy, where there the policy collects anew;
    u is that of the one transition that was seen, where there it is a mean over the simulator's; the gap is judged
    between latents of the pretrained world model, of which the simulated ones have its noise of observation; the
    critics are two-hot.

    Args:
        lr, policy_lr: Of Adam for critics and classifiers, and for the policy.
        entropy_coef: alpha, fixed.
        penalty: beta, of the term that pushes Q down where the dynamics differ. Two-hot critics hold against it with a
            bounded force: at 0.3 they diverge.
        simulated_episodes, updates, slice_len, action_noise: As in `AbstractMethod`.

    Raises:
        ValueError: If there are no simulated episodes, or the penalty is negative.

    Source: Niu et al., "When to Trust Your Simulator", NeurIPS 2022, arXiv:2206.13464.
    """

    def __init__(
        self,
        *,
        lr: float,
        policy_lr: float,
        entropy_coef: float,
        penalty: float,
        simulated_episodes: int,
        updates: int,
        slice_len: int,
        action_noise: float,
    ):
        check_simulated(simulated_episodes, 1)
        if penalty < 0:
            raise ValueError(f"penalty={penalty} must be 0 or more.")
        self.lr, self.policy_lr, self.entropy_coef, self.penalty = lr, policy_lr, entropy_coef, penalty
        self.simulated_episodes, self.updates = simulated_episodes, updates
        self.slice_len, self.action_noise = slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        agent.train_only(("q_ensemble", "policy_head"), lr=self.lr, policy_lr=self.policy_lr, following=("target_q",))
        model = agent.model
        self.gap = DynamicsGap(model.latent_dim, model.action_dim, lr=self.lr).to(agent.device)

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        found = of_slices(agent.model, to_slices(batch, agent.device))
        slices = len(batch)
        real = torch.arange(len(found.z), device=agent.device) % slices < slices // 2  # time first: slices side by side
        metrics = self.gap.fit(found, real)
        ratio = self.gap.log_ratio(found)
        weight = torch.where(real, 1.0, ratio.exp().clamp(LEAST, 1.0))
        doubt = (-ratio[~real]).clamp(LEAST, DEEPEST)

        def believed(q: Tensor) -> Tensor:
            """The penalty, scalar, of Q [E, N]."""
            promised = torch.logsumexp(q[:, ~real] + (doubt / doubt.sum()).log(), 1)
            return self.penalty * (promised - q[:, real].mean(1)).mean()

        metrics |= fit_soft(agent, found, entropy_coef=self.entropy_coef, weight=weight, penalty=believed)
        return floats(metrics | {"simulated_weight": weight[~real].mean()})

    def state_dict(self) -> dict[str, Any]:
        return copy.deepcopy({"gap": self.gap.state_dict(), "optimizer": self.gap.optimizer.state_dict()})

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.gap.load_state_dict(state["gap"])
        self.gap.optimizer.load_state_dict(state["optimizer"])
