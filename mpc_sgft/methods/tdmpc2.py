"""TD-MPC2 on real data: everything goes on training on the ordinary objective, without guidance. The baseline."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.method import AbstractMethod, Gate, check_acting, check_win_stay
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.optimizers import PRETRAINED
from mpc_sgft.learning.world_model import TERMINALS


class TDMPC2(AbstractMethod):
    """Every part but the observation's normalisation trains, with pretraining's target critics.

    What `sgft` adds beside its objective can be given to it too, so that the two objectives are compared alone.

    Args:
        lr: Of Adam; None: pretraining's.
        lr_decay: As in `SGFT`.
        terminal: What plans end in: "value", the head that all methods here share, or "q", the critics at the policy's
            action, as published.
        command_map: Also learn what the machine makes of a command, together with the dynamics and by the same loss.
        command_lr: Of Adam for it.
        gate, gate_margin, gate_memory: Whether there is a gate, and its numbers (`Gate`).
        updates, slice_len, action_noise, average_decay, policy_share, win_stay: As in `AbstractMethod`.

    Source: Hansen, Su, Wang, arXiv:2310.16828.
    """

    def __init__(
        self,
        *,
        lr: float | None,
        lr_decay: float,
        terminal: str,
        command_map: bool,
        command_lr: float,
        gate: bool,
        gate_margin: float,
        gate_memory: int,
        average_decay: float,
        policy_share: float,
        updates: int,
        slice_len: int,
        action_noise: float,
        win_stay: int = 0,  # runs of before have none
    ):
        check_win_stay(win_stay)
        check_acting(gate_margin, gate_memory, average_decay, policy_share)
        if terminal not in TERMINALS:
            raise ValueError(f"terminal={terminal!r}. Available: {', '.join(TERMINALS)}.")
        self.terminal = terminal
        self.lr, self.lr_decay, self.command_map, self.command_lr = lr, lr_decay, command_map, command_lr
        self.gate = Gate(gate_margin, gate_memory) if gate else None
        self.average_decay, self.policy_share, self.win_stay = average_decay, policy_share, win_stay
        self.updates, self.slice_len, self.action_noise = updates, slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        parts = PRETRAINED
        if self.command_map:
            if agent.model.dynamics.command is None:
                agent.model.add_command_map()
            parts += ("dynamics.command",)
        lr = agent.lr if self.lr is None else self.lr
        agent.train_only(parts, lr=lr, policy_lr=lr, command_lr=self.command_lr, following=("target_q",))

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict[str, float]:
        agent.scale_learning_rates(len(starts) ** -self.lr_decay)
        return agent.update(batch)
