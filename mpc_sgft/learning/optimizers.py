"""What moves an agent's parameters: an Adam for the model, one for the policy prior, one for the entropy's weight."""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from mpc_sgft.learning.world_model import WorldModel

PRETRAINED = ("encoder", "dynamics", "reward_head", "q_ensemble", "value_head", "policy_head", "decoder")


class Optimizers:
    """Fresh optimisers of the parameters that train.

    Args:
        model: Its parameters with `requires_grad`, the policy prior's aside, go to the model's optimiser.
        log_entropy_coef: Trained alone.
        lr: Of the model; the encoder takes its share of it.
        encoder_lr_share: That share.
        policy_lr, entropy_lr: Of the policy prior and of the entropy's weight.
        command_lr, observation_lr: Of the dynamics' command maps and of the observation map; None: lr.
        recorded: Steps are recorded in CUDA graphs: what they read lies on the device then.

    Attributes:
        model, policy, entropy: The three.
        trained: Parameters of the first.
    """

    def __init__(
        self,
        model: WorldModel,
        log_entropy_coef: Tensor,
        *,
        lr: float,
        encoder_lr_share: float,
        policy_lr: float,
        entropy_lr: float,
        command_lr: float | None = None,
        observation_lr: float | None = None,
        recorded: bool = False,
    ) -> None:
        of_commands = model.dynamics.command_maps()
        maps = (*((part, command_lr) for part in of_commands), (model.observation_map, observation_lr))
        groups = [{"params": [*part.parameters()], "lr": lr if own is None else own} for part, own in maps if part]
        command = [p for part in of_commands for p in part.parameters()]
        for part in PRETRAINED:
            parameters = [p for p in getattr(model, part).parameters() if p.requires_grad and part != "policy_head"]
            parameters = [p for p in parameters if all(p is not c for c in command)]
            if parameters:
                groups.append({"params": parameters, "lr": lr * (encoder_lr_share if part == "encoder" else 1.0)})
        self.trained: list[Tensor] = [p for group in groups for p in group["params"]]
        self.model = torch.optim.Adam(groups, fused=True)
        self.policy = torch.optim.Adam(model.policy_head.parameters(), lr=policy_lr, eps=1e-5, fused=True)
        self.entropy = torch.optim.Adam([log_entropy_coef], lr=entropy_lr, fused=True)
        self._device, self._recorded = log_entropy_coef.device, recorded
        self._prepare()

    def scale(self, share: float) -> None:
        """Set the learning rates of model and policy prior to a share of the configured ones."""
        for optimizer in (self.model, self.policy):
            for group in optimizer.param_groups:
                rate = share * group.setdefault("full_lr", float(group["lr"]))
                if isinstance(group["lr"], Tensor):
                    group["lr"].fill_(rate)
                else:
                    group["lr"] = rate

    def state_dict(self) -> dict[str, Any]:
        return {name: copy.deepcopy(optimizer.state_dict()) for name, optimizer in self._all().items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, optimizer in self._all().items():
            optimizer.load_state_dict(copy.deepcopy(state[name]))
        self._prepare()

    def _prepare(self) -> None:
        for optimizer in self._all().values():
            for group in optimizer.param_groups:
                rate = float(group["lr"])
                group["lr"] = torch.tensor(rate, device=self._device) if self._recorded else rate
                group["capturable"] = self._recorded

    def _all(self) -> dict[str, torch.optim.Adam]:
        return {"model": self.model, "policy": self.policy, "entropy": self.entropy}
