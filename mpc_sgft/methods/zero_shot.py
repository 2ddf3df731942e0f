"""The pretrained agent as it is: nothing learns from real rollouts."""

from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.method import AbstractMethod
from mpc_sgft.learning.observation_map import Sensed


class ZeroShot(AbstractMethod):
    """Everything is frozen; rollouts are driven, recorded and measured.

    Args:
        slice_len, action_noise: As in `AbstractMethod`; model errors are measured over `slice_len` steps.
    """

    updates = 0

    def __init__(self, *, slice_len: int, action_noise: float):
        self.slice_len, self.action_noise = slice_len, action_noise

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        agent.train_only((), lr=agent.lr, policy_lr=agent.lr)

    def update(self, agent: Agent, batch: TensorDictBase, *, starts: Tensor) -> dict:
        raise ValueError("method zero_shot learns nothing: it has no update")
