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

    def numbers(self) -> dict[str, Tensor]:
        """What must be finite."""
        return {"observation": self.observation, "action": self.action, "reward": self.reward}


def to_slices(batch: TensorDictBase, device: torch.device) -> Slices:
    """A batch [B, T] of the buffer as `arranged`.

    Raises:
        FloatingPointError: If an entry is not finite.
    """
    data = arranged(batch, device)
    check_finite(data.numbers())
    return data


def arranged(batch: TensorDictBase, device: torch.device) -> Slices:
    """Rearrange a batch [B, T] of the buffer; nothing is asked of the device."""
    first = batch.get("observation")[:, :1]
    observation = torch.cat([first, batch.get(("next", "observation"))], 1).transpose(0, 1)
    reward, terminated = (batch.get(("next", key)).squeeze(-1).t() for key in ("reward", "terminated"))
    return Slices(*(x.to(device) for x in (observation, batch.get("action").transpose(0, 1), reward, terminated)))


def check_finite(values: Mapping[str, Tensor]) -> None:
    """Raise FloatingPointError that names every tensor with an entry that is not finite."""
    watch = FiniteWatch()
    watch.note(values)
    watch.check()


class FiniteWatch:
    """Notes on the device which values were not finite, so that the host need not wait until it asks."""

    def __init__(self) -> None:
        self._finite: dict[str, Tensor] = {}

    def note(self, values: Mapping[str, Tensor]) -> None:
        """Look at values of any shape."""
        self.also({name: x.detach().isfinite().all() for name, x in values.items()})

    def also(self, finite: Mapping[str, Tensor]) -> None:
        """Take in what was found elsewhere: bool scalars."""
        for name, found in finite.items():
            self._finite[name] = found & self._finite[name] if name in self._finite else found.clone()

    def taken(self) -> dict[str, Tensor]:
        """What was noted since the last time, bool scalars on the device."""
        noted, self._finite = self._finite, {}
        return noted

    def check(self) -> None:
        """Raise FloatingPointError that names what was not finite since the last check."""
        noted = self.taken()
        finite = torch.stack([*noted.values()]).tolist() if noted else []
        bad = [name for name, ok in zip(noted, finite, strict=True) if not ok]
        if bad:
            raise FloatingPointError(f"{', '.join(bad)} is not finite in an update.")


def floats(metrics: Mapping[str, Tensor]) -> dict[str, float]:
    """Scalars as Python numbers, in one transfer from the device."""
    values = torch.stack([m.detach().float() for m in metrics.values()]).tolist()
    return dict(zip(metrics, values, strict=True))
