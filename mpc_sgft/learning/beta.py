"""Beta distributions over the ranges of the randomisation's draws."""

import torch
from torch import Tensor
from torch.distributions import Beta

EDGE = 1e-6  # of a place in a range, 0 to 1: a Beta density may be infinite at the ends
MOST = 1000.0  # largest parameter of a Beta distribution


def beta(x: Tensor) -> Beta:
    """Of the logarithms of the parameters, [D, 2]."""
    return Beta(*x.exp().unbind(-1), validate_args=False)


def quantile(shapes: Tensor, share: Tensor) -> Tensor:
    """Below which shares [..., D] of Beta distributions (a, b) [D, 2] lie, [..., D]."""
    from scipy.special import betaincinv  # late: no start waits for it that has no such distribution

    return torch.from_numpy(betaincinv(*shapes.T.numpy(), share.numpy()))
