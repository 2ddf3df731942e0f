"""The average of a model's weights over its last updates: what is evaluated and saved."""

import copy
from collections.abc import Mapping
from typing import Any

import torch

from mpc_sgft.learning.world_model import WorldModel


class AveragedWeights:
    """average += (1 - decay) (weights - average) at each update, from the first one's weights on; buffers are copied.

    The numbers of `torch.optim.swa_utils.AveragedModel` with an exponential average, but the host need not wait for the
    device.

    Args:
        model: Whose weights.
        decay: 0…1.
    """

    def __init__(self, model: WorldModel, decay: float) -> None:
        self.model, self.decay, self.begun = copy.deepcopy(model), decay, False

    @torch.no_grad()
    def follow(self, model: WorldModel) -> None:
        """Take in the weights after an update."""
        share = 1 - self.decay if self.begun else 1.0
        torch._foreach_lerp_([*self.model.parameters()], [*model.parameters()], share)  # type: ignore
        for there, here in zip(self.model.buffers(), model.buffers(), strict=True):
            there.copy_(here)
        self.begun = True

    def state_dict(self) -> dict[str, Any]:
        return {"model": {k: x.clone() for k, x in self.model.state_dict().items()}, "begun": self.begun}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.model.load_state_dict(state["model"])
        self.begun = state["begun"]
