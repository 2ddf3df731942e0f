"""What a method of deployment must say; each file in mpc_sgft/methods/ is one."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.observation_map import Sensed


class Gate(NamedTuple):
    """When fine-tuned parts may act: once they predicted rollouts that nobody had trained on clearly better.

    Attributes:
        margin: They must lower the error to this share of the pretrained error, in the geometric mean over the last
            `memory` rollouts: one odd rollout shuts nothing. Once they act, any lower error than that will do.
        memory: Rollouts that the gate looks back on.
        excess: The dynamics beneath the maps act fine-tuned only where, as they were pretrained, they predict these
            rollouts this many times worse than simulated ones: no network is exact, and what it also gets wrong in
            simulation is no gap. 0: wherever the maps act.
    """

    margin: float
    memory: int
    excess: float = 0.0


class AbstractMethod(ABC):
    """What `deploy method=NAME` freezes and what it learns from real rollouts.

    configs/method/NAME.yaml names the class and holds its numbers. The planner is that of configs/planner/, on the
    model that acts; a method that needs another one says so in its yaml, in `defaults`
    (`override /planner@_global_.planner: NAME`).

    Attributes:
        updates: Gradient steps after each rollout that is learned from; 0 learns nothing.
        slice_len: Consecutive steps of a slice of the replay [T].
        action_noise: Standard deviation of the noise on real actions, action units.
        gate: When fine-tuned parts may act; None: at once.
        suspicion_margin: What the observation map suspects by how things move is corrected once it lowers the error of
            the pretrained dynamics with the maps to this share, looked at as the gate does in rollouts that failed; 0:
            never.
        average_decay: Of the averaged weights that are tested and act, per update; 0: the last ones.
        win_stay: After so many rollouts in a row that reached their goal nothing is learned, and what acts stays, until
            one does not (win-stay, lose-shift: Robbins, Bull. AMS 1952); 0: every rollout is learned from. One that a
            person took over, or that ended at once, ends a streak too; those of the warm-up do not count.
        terminal: What plans end in, as `WorldModel` has it.
        policy_share: Of the way from the pretrained policy prior to the fine-tuned one that acts.
        simulated_episodes: Of the pretrained policy in the randomised simulator, exploring as in pretraining; half of
            each batch is from these then. 0: real data alone.
    """

    updates: int
    slice_len: int
    action_noise: float
    gate: Gate | None = None
    suspicion_margin: float = 0.0
    average_decay: float = 0.0
    policy_share: float = 1.0
    win_stay: int = 0
    terminal: str = "value"
    simulated_episodes: int = 0

    @abstractmethod
    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        """Freeze a pretrained agent but for what this method trains; called once, before the first rollout.

        Args:
            agent: Pretrained.
            sensed: What the task observes, and where its simulated episodes start.
        """

    @abstractmethod
    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict:
        """One step on slices [B, T], real ones first; returns metrics, {name: float}.

        Args:
            agent: That this method took over.
            batch: As from the buffer.
            starts: The first observation of each rollout so far, [R, O].

        Raises:
            FloatingPointError: If an entry of the batch or a loss is not finite; that loss has changed nothing then.
        """

    def state_dict(self) -> dict[str, Any]:
        """What must be kept to go on exactly, beside the agent's own state."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`, after `take_over`."""
        assert not state, state


def check_simulated(episodes: int, least: int) -> None:
    """Raise ValueError if a method is given too few simulated episodes."""
    if episodes < least:
        raise ValueError(f"simulated_episodes={episodes} must be {least} or more.")


def check_acting(gate_margin: float, gate_memory: int, average_decay: float, policy_share: float) -> None:
    """Raise ValueError for numbers by which nothing, or nothing that was learned, would act."""
    if gate_margin <= 0:
        raise ValueError(f"gate_margin={gate_margin} must be more than 0.")
    if gate_memory < 1:
        raise ValueError(f"gate_memory={gate_memory} must be 1 rollout or more.")
    if not 0 <= average_decay < 1:
        raise ValueError(f"average_decay={average_decay} must lie in [0, 1).")
    if not 0 <= policy_share <= 1:
        raise ValueError(f"policy_share={policy_share} must lie in [0, 1].")


def check_win_stay(win_stay: int) -> None:
    """Raise ValueError if the rollouts of a streak are no number of them."""
    if not isinstance(win_stay, int) or win_stay < 0:
        raise ValueError(f"win_stay={win_stay} must be 0 or more rollouts.")


def check_objective(horizon: int, rho: float) -> None:
    """Raise ValueError if the horizon is not positive or rho lies outside (0, 1]."""
    if horizon < 1:
        raise ValueError(f"horizon={horizon} must be at least one control step.")
    if not 0 < rho <= 1:
        raise ValueError(f"rho={rho} must lie in (0, 1].")
