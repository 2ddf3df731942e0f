"""What the losses read of a batch of the buffer: time first, on the learner's device, checked for NaN."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor


class Slices(NamedTuple):
    """T consecutive steps of B slices."""

    observation: Tensor  # [T + 1, B, O]
    action: Tensor  # [T, B, A]
    reward: Tensor  # [T, B]
    terminated: Tensor  # [T, B] bool


def to_slices(batch: TensorDictBase, device: torch.device) -> Slices:
    """Rearrange a batch [B, T] of the buffer.

    Raises:
        FloatingPointError: If an entry is not finite.
    """
    first = batch.get("observation")[:, :1]
    observation = torch.cat([first, batch.get(("next", "observation"))], 1).transpose(0, 1)
    reward, terminated = (batch.get(("next", key)).squeeze(-1).t() for key in ("reward", "terminated"))
    data = Slices(*(x.to(device) for x in (observation, batch.get("action").transpose(0, 1), reward, terminated)))
    check_finite({"observation": data.observation, "action": data.action, "reward": data.reward})
    return data


def check_finite(values: Mapping[str, Tensor]) -> None:
    """Raise FloatingPointError that names every tensor with an entry that is not finite."""
    finite = torch.stack([v.detach().isfinite().all() for v in values.values()]).tolist()
    if not all(finite):
        bad = [name for name, ok in zip(values, finite, strict=True) if not ok]
        raise FloatingPointError(f"{', '.join(bad)} is not finite; this update was not applied.")
