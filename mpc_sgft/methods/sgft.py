"""Simulation-Guided Fine-Tuning: the simulated critic says what is worth reaching, real data teach how to get there."""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent, floats
from mpc_sgft.learning.dynamics import Dynamics
from mpc_sgft.learning.method import AbstractMethod, Gate
from mpc_sgft.learning.slices import to_slices


class SGFT(AbstractMethod):
    """Encoder, reward and critic stay as they were pretrained; the dynamics and the policy prior train.

    The dynamics learn to predict the encoded observations. The policy prior climbs, through the learned dynamics,

        J = sum_{t<H} gamma^t r_t + gamma^H V(z_H) - V(z_0)

    which the planner maximises too. The command map, the anchor, the gate and the residual are ours.

    Args:
        horizon: Imagined steps of the policy's objective [H].
        lr, policy_lr, command_lr: Of Adam for dynamics, policy prior and command map.
        entropy_coef: Weight of the policy's entropy in its objective, fixed.
        rho: Weight of step t of the dynamics loss is rho^t.
        anchor: Weight of the squared distance of the dynamics' parameters from the pretrained ones, divided by the
            rollouts so far: a prior weighs less, the more data there are.
        residual: Train a correction that starts at zero on top of frozen pretrained dynamics.
        command_map: Also learn what the machine makes of a command, a few numbers that hold everywhere.
        gate, gate_margin, gate_memory: Whether there is a gate, and its numbers (`Gate`).
        updates, slice_len, action_noise: As in `AbstractMethod`.

    Raises:
        ValueError: If the horizon is not positive or rho lies outside (0, 1].

    Source: Yin, Westenbroek et al., ICLR 2025.
    """

    def __init__(
        self,
        *,
        horizon: int,
        lr: float,
        policy_lr: float,
        command_lr: float,
        entropy_coef: float,
        rho: float,
        anchor: float,
        residual: bool,
        command_map: bool,
        gate: bool,
        gate_margin: float,
        gate_memory: int,
        updates: int,
        slice_len: int,
        action_noise: float,
    ):
        if horizon < 1:
            raise ValueError(f"horizon={horizon} must be at least one control step.")
        if not 0 < rho <= 1:
            raise ValueError(f"rho={rho} must lie in (0, 1].")
        self.horizon, self.lr, self.policy_lr, self.command_lr = horizon, lr, policy_lr, command_lr
        self.entropy_coef, self.rho, self.anchor = entropy_coef, rho, anchor
        self.residual, self.command_map = residual, command_map
        self.gate = Gate(gate_margin, gate_memory) if gate else None
        self.updates, self.slice_len, self.action_noise = updates, slice_len, action_noise
        self._pretrained: list[Tensor] = []  # of the dynamics, where the anchor holds them
        self._simulated: Dynamics | None = None  # as they were pretrained, with the command map of those that train

    def take_over(self, agent: Agent) -> None:
        dynamics, parts = agent.model.dynamics, ("dynamics", "policy_head")
        if self.residual:
            if dynamics.residual is None:
                agent.model.add_residual()
            parts = ("dynamics.residual", "policy_head")
        if self.command_map:
            if dynamics.command is None:
                agent.model.add_command_map()
            parts += ("dynamics.command",)
        agent.train_only(parts, lr=self.lr, policy_lr=self.policy_lr, command_lr=self.command_lr)
        self._pretrained = [p.detach().clone() for p in agent.dynamics_parameters()]
        if self.command_map:
            self._simulated = copy.deepcopy(dynamics).requires_grad_(False)
            self._simulated.residual, self._simulated.command = None, dynamics.command

    def update(
        self, agent: Agent, batch: TensorDictBase, *, rollouts: int, weight: Tensor | None = None
    ) -> dict[str, float]:
        def distance() -> Tensor:
            moved = zip(agent.dynamics_parameters(), self._pretrained, strict=True)
            return torch.stack([(now - then).square().sum() for now, then in moved]).sum()

        data = to_slices(batch, agent.device)
        penalty = ("anchor_distance", self.anchor / rollouts, distance) if self.anchor else None
        metrics, encoded = agent.fit_dynamics(
            data, rho=self.rho, weight=weight, penalty=penalty, simulated=self._simulated
        )
        return floats(metrics | agent.climb(encoded[0], horizon=self.horizon, entropy_coef=self.entropy_coef))

    def state_dict(self) -> dict[str, Any]:
        simulated = self._simulated.base.state_dict() if self._simulated else None
        return {"pretrained": [x.clone() for x in self._pretrained], "simulated": simulated}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        here = [x.device for x in self._pretrained]
        self._pretrained = [x.to(device) for x, device in zip(state["pretrained"], here, strict=True)]
        if self._simulated:
            self._simulated.base.load_state_dict(state["simulated"])
