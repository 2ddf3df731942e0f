"""The SGFT potential: shaped rewards, and the audit that says in which of the states seen it can be improved.

Source: Yin, Westenbroek et al., "Rapidly Adapting Policies to the Real World via Simulation-Guided Fine-Tuning", ICLR
2025, Definition 1; Ng, Harada, Russell 1999 for potential-based shaping.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from planners.base import Model


def shape_reward(reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, discount: float) -> Tensor:
    """Reward plus the gain in potential.

        rbar = r + gamma (1 - terminated) V(z') - V(z)

    so that sum_{t<H} gamma^t rbar_t = sum_{t<H} gamma^t r_t + gamma^H V(z_H) - V(z_0): V(z_0) off, a tail on.

    Args:
        reward, value, next_value: Of any one shape, reward units.
        terminated: Bool, the same shape; a terminal state has no value.
        discount: gamma in [0, 1], per control step.
    """
    return reward + discount * torch.where(terminated, 0.0, next_value) - value


class Audit(NamedTuple):
    """Outcome of `improvable`."""

    margin: Tensor  # [M] reward units; negative where no tried action satisfies Definition 1
    share: float  # of the states with margin >= 0
    action: Tensor  # [M, A] the best action found


@torch.inference_mode()
def improvable(
    model: Model,
    z: Tensor,
    *,
    action_dim: int,
    discount: float,
    generator: torch.Generator,
    num_prior: int = 16,
    num_uniform: int = 48,
    refinements: int = 3,
) -> Audit:
    """Where the frozen value can be improved by one step of the learned dynamics (Definition 1 of the paper).

        margin(s) = max_a r(z, a, z') + gamma V(z') - V(z),  z' = next(z, a)     >= 0 is asked of every state

    The paper writes r(s), with which its V(s) begins; here V(s) begins with the reward for arriving at z'. The maximum
    is over samples: the policy's mean action, samples of the policy and of the whole action box, then rounds of samples
    around the best one so far with half the spread of the round before. It is a lower bound, so a state called
    improvable is one (under the model).

    Args:
        model: Anything that satisfies `planners.base.Model`.
        z: Latents of states really visited, terminal ones left out, [M, D].
        action_dim: Entries of an action [A], in [-1, 1].
        discount: gamma, per control step.
        num_prior, num_uniform: Samples per state from the policy and from the box; a refinement has `num_uniform` too.
        refinements: Rounds around the best action.

    Raises:
        ValueError: If z is not [M, D], or M is zero.
    """
    if z.ndim != 2 or not len(z):
        raise ValueError(f"improvable wants z [M, D] with M > 0, got {tuple(z.shape)}.")
    states, device = len(z), z.device

    def normal(n: int) -> Tensor:
        return torch.randn(n, states, action_dim, generator=generator, device=device)

    def best_of(actions: Tensor) -> tuple[Tensor, Tensor]:  # [n, M, A]
        start = z.expand(len(actions), -1, -1)
        after = model.next(start, actions)
        gain = model.reward(start, actions, after) + discount * model.terminal_value(after)  # [n, M]
        top, index = gain.max(0)
        return top, actions[index, torch.arange(states, device=device)]

    prior = model.policy_prior(z.expand(num_prior, -1, -1), normal(num_prior)) if num_prior else normal(0)
    box = 2 * torch.rand(num_uniform, states, action_dim, generator=generator, device=device) - 1
    top, action = best_of(torch.cat([model.policy_prior(z, None).unsqueeze(0), prior, box]))
    spread = 0.5
    for _ in range(refinements):
        around = (action + spread * normal(num_uniform)).clamp(-1, 1)
        top, action = best_of(torch.cat([action.unsqueeze(0), around]))
        spread /= 2
    margin = top - model.terminal_value(z)
    return Audit(margin, (margin >= 0).double().mean().item(), action)
