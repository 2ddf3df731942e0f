"""The squashed Gaussian of a policy: samples in the box of actions, and their exact densities."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

WITHIN = 0.999  # of the box of actions [-1, 1]: where one at its edge is taken to lie


def gaussian_tanh(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Sample of a squashed Gaussian and its exact log-density.

        a = tanh(u), u = mean + std noise,  log p(a) = log N(u) - sum log(1 - tanh(u)^2)

    with log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), which is exact where 1 - tanh^2 rounds to zero.

    Args:
        mean, log_std, noise: [..., A]; noise is standard normal.

    Returns:
        Action in (-1, 1), [..., A], and log-density, [...].

    Source: SAC, arXiv:1812.05905, appendix C.
    """
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    correction = 2 * (math.log(2) - u - F.softplus(-2 * u))
    return torch.tanh(u), (log_normal - correction).sum(-1)


def gaussian_tanh_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Log-density that a squashed Gaussian gives to an action.

    An action at the edge of the box would lie at infinity before it is squashed: it counts as just within.

    Args:
        mean, log_std, action: [..., A]; action in [-1, 1].

    Returns:
        Log-density, [...].
    """
    u = torch.atanh(action.clamp(-WITHIN, WITHIN))
    return gaussian_tanh(mean, log_std, (u - mean) / log_std.exp())[1]
