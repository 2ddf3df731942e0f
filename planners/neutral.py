"""Searching around the action that a machine turns into nothing, where that is not zero.

A search whose plans are all worth the same ends at zero, the middle of what it draws. On a machine that drifts zero is
a movement: the search then moves where it has no reason to. So it draws plans v in coordinates whose zero is the
neutral action n, entry by entry:

    a = v + n (1 - |v|)        -1, 0 and 1 become -1, n and 1, with straight lines between

Without a neutral action, or where it is zero, a is v.
"""

from typing import cast

import torch
from torch import Tensor

from planners.base import Model, NeutralModel


def neutral_action(model: Model) -> Tensor | None:
    """`NeutralModel.neutral_action`, [A]; None for a model that has no such thing."""
    return cast(NeutralModel, model).neutral_action() if hasattr(model, "neutral_action") else None


def from_neutral(v: Tensor, neutral: Tensor | None) -> Tensor:
    """Actions in [-1, 1] of what was drawn, v in [-1, 1], any leading dimensions [..., A]."""
    return v if neutral is None else (v + neutral * (1 - v.abs())).clamp(-1, 1)  # rounding may leave it


def to_neutral(action: Tensor, neutral: Tensor | None) -> Tensor:
    """Inverse of `from_neutral`; where the neutral action is a limit, that limit is 0."""
    if neutral is None:
        return action
    away = action - neutral
    return away / (1 - neutral * away.sign()).clamp_min(torch.finfo(away.dtype).tiny)
