"""Model predictive path integral control in the latent space: elites weighted by how good they are."""

from dataclasses import dataclass

import torch
from torch import Tensor

from planners.sampling import SamplingPlanner


@dataclass(frozen=True, kw_only=True)
class MPPI(SamplingPlanner):
    """`SamplingPlanner` whose elites weigh

        w_k = exp((v_k - max v) / λ) / Σ_j exp((v_j - max v) / λ)

    temperature is λ > 0, a share of the model's `value_range`: it divides the value, so cold picks the best elite and
    hot averages all of them.

    Raises:
        ValueError: From the constructor, if a number is out of range.

    Source: Williams et al., Information theoretic MPC, ICRA 2017; elites and policy-prior candidates as in TD-MPC2,
    arXiv:2310.16828, where the temperature multiplies the value in reward units. The value range is ours, after the
    running scale by which TD-MPC2 divides values in the loss of its policy.
    """

    temperature: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.temperature > 0:
            raise ValueError(f"temperature={self.temperature}: it divides the value and must be above 0.")

    def weights(self, values: Tensor) -> Tensor:
        """Softmax of value / temperature, [B, K]; without the maximum taken off first, rewards of ±300 overflow."""
        return torch.softmax((values - values.amax(1, keepdim=True)) / self.temperature, 1)
