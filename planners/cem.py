"""Cross-entropy method: every elite counts the same."""

from dataclasses import dataclass

import torch
from torch import Tensor

from planners.sampling import SamplingPlanner


@dataclass(frozen=True, kw_only=True)
class CEM(SamplingPlanner):
    """`SamplingPlanner` whose refit is the plain mean and standard deviation of the elites, w_k = 1 / K.

    Source: Rubinstein and Kroese, The Cross-Entropy Method, 2004; in latent space
    PlaNet, arXiv:1811.04551.
    """

    def weights(self, values: Tensor) -> Tensor:
        """The same weight for every elite, [B, K]."""
        return torch.full_like(values, 1.0 / values.shape[1])
