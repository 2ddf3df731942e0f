"""TD-MPC2 on real data: everything goes on training on the ordinary objective, without guidance. The plain baseline."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import PRETRAINED, Agent
from mpc_sgft.learning.method import AbstractMethod
from mpc_sgft.learning.observation_map import Sensed


class TDMPC2(AbstractMethod):
    """Every part but the observation's normalisation trains, with pretraining's learning rates and target critics.

    Args:
        updates, slice_len, action_noise: As in `AbstractMethod`.

    Source: Hansen, Su, Wang, arXiv:2310.16828.
    """

    def __init__(self, *, updates: int, slice_len: int, action_noise: float):
        self.updates, self.slice_len, self.action_noise = updates, slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        agent.train_only(PRETRAINED, lr=agent.lr, policy_lr=agent.lr, following=("target_q",))

    def update(
        self, agent: Agent, batch: TensorDictBase, *, starts: Tensor, weight: Tensor | None = None
    ) -> dict[str, float]:
        if weight is not None:
            raise ValueError("method tdmpc2 weighs all slices alike; weight must be None")
        return agent.update(batch)
