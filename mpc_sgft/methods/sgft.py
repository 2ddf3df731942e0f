"""Simulation-Guided Fine-Tuning: the simulated critic says what is worth reaching, real data teach how to get there."""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent, floats
from mpc_sgft.learning.dynamics import Dynamics
from mpc_sgft.learning.fit import Maps, Penalty, Suspicion, fit_dynamics
from mpc_sgft.learning.method import AbstractMethod, Gate, check_acting, check_objective, check_win_stay
from mpc_sgft.learning.observation_map import ObservationMap, Sensed
from mpc_sgft.learning.slices import to_slices
from mpc_sgft.learning.world_model import WorldModel

DOUBT = 0.03  # sum of squared distances from the simulated starts, in spreads of an entry, beyond which it is doubted


class SGFT(AbstractMethod):
    """Encoder, reward and critic stay as they were pretrained; the dynamics and the policy prior train.

    The dynamics learn to predict the encoded observations. The policy prior climbs, through the learned dynamics,

        J = sum_{t<H} gamma^t r_t + gamma^H V(z_H) - V(z_0)

    which the planner maximises too. Both maps, the anchor, the gate and the residual are ours.

    Args:
        horizon: Imagined steps of the policy's objective [H].
        lr, policy_lr, command_lr, observation_lr: Of Adam for dynamics, policy prior and the two maps.
        lr_decay: With r rollouts they are r^-lr_decay of that, so that many rollouts do not move them about.
        entropy_coef: Weight of the policy's entropy in its objective, fixed.
        rho: Weight of step t of the dynamics loss is rho^t.
        anchor: Weight of the squared distance of the dynamics' parameters from the pretrained ones, and of the
            observation map's from the identity.
        anchor_decay: With r rollouts this weight is r^-anchor_decay of that: 1 where data are independent and the model
            could be exact, so that a prior weighs less, the more there are; less where the same few places are seen
            again and again.
        residual: Train a correction that starts at zero on top of frozen pretrained dynamics.
        command_map: Also learn what the machine makes of a command, a few numbers that hold everywhere.
        command_band: With a command map, learn a second one beside it that also has a dead band: how small a command of
            each entry does nothing. It acts in place of the first once it predicted unseen rollouts clearly better, as
            the gate asks; without a gate, while it predicts them better.
        command_sparsity: Weight of the sum of their absolute differences from the identity, divided by the rollouts so
            far: what is wrong with a machine is mostly one thing (the lasso: Tibshirani, JRSS B 1996). The same of the
            shifts that sensors are suspected of.
        observation_map: Also learn what the sensors should have said: a turn of what a camera sees, a shift of each
            entry, where rollouts start where none does in simulation. Found like the command map, by what the
            simulator's dynamics can explain, and by where rollouts start.
        start_weight: Weight of the squared distance from there.
        suspicion_margin: Where they start as they should, shifts are learned by what the simulator's dynamics can
            explain alone, with a command map of their own: what is touched moves. They correct something once
            they lower the error on unseen rollouts that failed to this share; 0: never. Other physics can look a little
            like it, so this is less than the gate's.
        gate, gate_margin, gate_memory, gate_excess: Whether there is a gate, and its numbers (`Gate`).
        updates, slice_len, action_noise, average_decay, policy_share, win_stay: As in `AbstractMethod`.

    Raises:
        ValueError: If the horizon is not positive, rho lies outside (0, 1], gate_excess is negative, or
            suspicion_margin lies outside [0, 1).

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
        anchor_decay: float,
        residual: bool,
        command_map: bool,
        command_band: bool,
        command_sparsity: float,
        observation_map: bool,
        observation_lr: float,
        suspicion_margin: float,
        start_weight: float,
        lr_decay: float,
        average_decay: float,
        policy_share: float,
        gate: bool,
        gate_margin: float,
        gate_memory: int,
        gate_excess: float,
        updates: int,
        slice_len: int,
        action_noise: float,
        win_stay: int = 0,  # runs of before have none
    ):
        check_objective(horizon, rho)
        check_win_stay(win_stay)
        check_acting(gate_margin, gate_memory, average_decay, policy_share)
        if gate_excess < 0:
            raise ValueError(f"gate_excess={gate_excess} must be 0 or more.")
        if not 0 <= suspicion_margin < 1:
            raise ValueError(f"suspicion_margin={suspicion_margin} must lie in [0, 1).")
        self.horizon, self.lr, self.policy_lr, self.command_lr = horizon, lr, policy_lr, command_lr
        self.entropy_coef, self.rho, self.anchor, self.anchor_decay = entropy_coef, rho, anchor, anchor_decay
        self.residual, self.command_map, self.command_band = residual, command_map, command_map and command_band
        self.command_sparsity = command_sparsity
        self.gate = Gate(gate_margin, gate_memory, gate_excess) if gate else None
        self.updates, self.slice_len, self.action_noise = updates, slice_len, action_noise
        self.observation_map, self.observation_lr, self.start_weight = observation_map, observation_lr, start_weight
        self.suspicion_margin = suspicion_margin if observation_map else 0.0
        self.lr_decay, self.average_decay, self.policy_share = lr_decay, average_decay, policy_share
        self.win_stay = win_stay
        self._pretrained: list[Tensor] = []  # of the dynamics, where the anchor holds them
        self._simulated: Dynamics | None = None  # as they were pretrained, with the command map of those that train
        self._banded: Dynamics | None = None  # the same with the map that has a dead band
        self._joint: Dynamics | None = None  # the same with the map that goes with what sensors are suspected of

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        model, parts = agent.model, ("dynamics", "policy_head")
        if self.residual:
            if model.dynamics.residual is None:
                model.add_residual()
            parts = ("dynamics.residual", "policy_head")
        if self.command_map:
            if model.dynamics.command is None:
                model.add_command_map()
            parts += ("dynamics.command",)
            if self.command_band:
                if model.dynamics.banded is None:
                    model.add_command_band()
                parts += ("dynamics.banded",)
        if self.observation_map:
            if model.observation_map is None:
                model.add_observation_map(sensed.points())
            parts += ("observation_map",)
            if self.suspicion_margin and self.command_map:
                if model.dynamics.joint is None:
                    model.add_suspicion()
                parts += ("dynamics.joint",)
        agent.train_only(
            parts,
            lr=self.lr,
            policy_lr=self.policy_lr,
            command_lr=self.command_lr,
            observation_lr=self.observation_lr,
            following=("dynamics.band_acts", "dynamics.joint_acts") if self.residual else (),  # else of the dynamics
        )
        self._sensed = sensed
        self._pretrained = [p.detach().clone() for p in agent.dynamics_parameters()]
        if self.command_map or self.observation_map:
            self._simulated = copy.deepcopy(model.dynamics).requires_grad_(False)
            self._simulated.residual = self._simulated.banded = self._simulated.joint = None
            self._simulated.command = model.dynamics.command
            self._banded, self._joint = copy.deepcopy(self._simulated), copy.deepcopy(self._simulated)
            self._banded.base, self._banded.command = self._simulated.base, model.dynamics.banded
            self._joint.base, self._joint.command = self._simulated.base, model.dynamics.joint

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        def distance() -> Tensor:
            moved = zip(agent.dynamics_parameters(), self._pretrained, strict=True)
            return torch.stack([(now - then).square().sum() for now, then in moved]).sum()

        rollouts = len(starts)
        agent.scale_learning_rates(rollouts**-self.lr_decay)
        metrics, encoded = fit_dynamics(
            agent,
            to_slices(batch, agent.device),
            rho=self.rho,
            penalty=Penalty("anchor_distance", self._anchor(starts), distance) if self.anchor else None,
            maps=self._maps(agent.model, starts),
        )
        metrics |= agent.climb(encoded[0], horizon=self.horizon, entropy_coef=self.entropy_coef)
        return floats(metrics) | self._corrections(agent.model)

    def _maps(self, model: WorldModel, starts: Tensor) -> Maps | None:
        """How command map and observation map learn, given the first observation of each rollout [R, O]."""
        if self._simulated is None:
            return None
        acting, rival = self._simulated, self._banded if self.command_band else None
        if rival is not None and bool(model.dynamics.band_acts):
            acting, rival = rival, acting
        told = (acting, rival) if self.command_map else ()
        commands = [dynamics.command for dynamics in told if dynamics is not None and dynamics.command is not None]
        sensors = model.observation_map if self.observation_map else None
        parts = (*commands, *([] if sensors is None else [sensors]))

        def change() -> Tensor:
            return torch.stack([c.change() for c in commands]).sum()

        penalties: tuple[Penalty, ...] = ()
        if commands and self.command_sparsity:
            penalties += (Penalty("command_change", self._sparse(starts), change),)
        if sensors is None:
            return Maps(parts, acting, penalties, rival)
        simulated = self._sensed.starts.to(starts.device)
        box = simulated.amin(0), simulated.amax(0)
        sensors.doubt(starts, *box, DOUBT)

        def doubt() -> Tensor:
            far = sensors.outside(starts, *box, suspected=False)
            return self.start_weight * far + self._anchor(starts) * sensors.size()

        suspicion = self._suspicion(sensors, starts, box) if self.suspicion_margin else None
        return Maps(parts, acting, (*penalties, Penalty("sensor_doubt", 1.0, doubt)), rival, suspicion)

    def _suspicion(self, sensors: ObservationMap, starts: Tensor, box: tuple[Tensor, Tensor]) -> Suspicion:
        """What learns of the sensors by what moves, given the first observations [R, O] and where they may lie."""
        assert self._joint is not None  # there is an observation map
        command = self._joint.command

        def far() -> Tensor:
            return sensors.outside(starts, *box, suspected=True)

        def few() -> Tensor:
            return sensors.suspicion() + (0.0 if command is None else command.change())

        penalties = (
            Penalty("suspected_doubt", self.start_weight, far),
            Penalty("suspected_change", self._sparse(starts), few),
        )
        parameters = (sensors.shift, *([] if command is None else command.parameters()))
        return Suspicion(parameters, self._joint, penalties)

    def _anchor(self, starts: Tensor) -> float:
        return self.anchor * len(starts) ** -self.anchor_decay

    def _sparse(self, starts: Tensor) -> float:
        return self.command_sparsity / len(starts)

    def _corrections(self, model: WorldModel) -> dict[str, float]:
        """What the observation map makes of the sensors, by name: a turn [rad], shifts in raw units."""
        sensors = model.observation_map
        if not self.observation_map or sensors is None:
            return {}
        shifts = zip(self._sensed.names, sensors.shifted.tolist(), strict=True)
        return {"sensor_turn": sensors.turned.item()} | {f"sensor_shift_{name}": shift for name, shift in shifts}

    def state_dict(self) -> dict[str, Any]:
        simulated = self._simulated.base.state_dict() if self._simulated else None
        return {"pretrained": [x.clone() for x in self._pretrained], "simulated": simulated}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        here = [x.device for x in self._pretrained]
        self._pretrained = [x.to(device) for x, device in zip(state["pretrained"], here, strict=True)]
        if self._simulated:
            self._simulated.base.load_state_dict(state["simulated"])  # beneath both maps
