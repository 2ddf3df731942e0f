"""Objectives of the world model: tensors in, tensors out, no state but RunningScale.

Shapes are time first: [T, B, ...], T steps of a slice, B slices. A loss per step and slice becomes a scalar through
`over_time`.

Source: TD-MPC2, arXiv:2310.16828; entropy coefficient: SAC, arXiv:1812.05905; transfer objective: SGFT (Yin et al.,
ICLR 2025).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mpc_sgft.learning.layers import by_blocks
from mpc_sgft.learning.slices import Slices
from mpc_sgft.learning.world_model import WorldModel


def over_time(loss: Tensor, rho: float) -> Tensor:
    """Scalar (1/T) sum_t rho^t mean_b loss_tb.

    Args:
        loss: [T, B].
        rho: Decay per imagined step, in (0, 1]; later steps carry the errors of earlier ones.
    """
    steps = torch.arange(loss.shape[0], dtype=loss.dtype, device=loss.device)
    mean = loss.mean(1)  # [T]
    return (rho**steps * mean).mean()


def imagine(dynamics: Callable[[Tensor, Tensor], Tensor], z: Tensor, actions: Tensor) -> Tensor:
    """Latents from z [B, D] on, by actions [T, B, A]: [T + 1, B, D]."""
    zs = [z]
    for action in actions:
        zs.append(by_blocks(dynamics, zs[-1], action))
    return torch.stack(zs)


def consistency_loss(imagined: Tensor, encoded: Tensor) -> Tensor:
    """Mean squared error over the latent, [T, B, D] -> [T, B]. `encoded` is a constant."""
    return (imagined - encoded.detach()).square().mean(-1)


def two_hot_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy toward two-hot probabilities, both [..., num_bins] -> [...]."""
    bins = logits.shape[-1]
    loss = F.cross_entropy(logits.reshape(-1, bins), target.reshape(-1, bins), reduction="none")
    return loss.reshape(logits.shape[:-1])


def td_target(reward: Tensor, terminated: Tensor, next_q: Tensor, discount: float, td_lambda: float = 0.0) -> Tensor:
    """TD(lambda) within the slice; a truncated step bootstraps, a terminated one does not.

        y_t = r_t + gamma (1 - terminated_t) ((1 - lambda) v_{t+1} + lambda y_{t+1}),   y_T = v_T
        v = min_e Q_e(z', pi(z'))

    lambda 0 is TD-MPC2's one-step target. More brings rewards to earlier states in fewer updates, and judges in part
    the recorded actions instead of the policy's.

    Args:
        reward: [T, B].
        terminated: Bool, [T, B].
        next_q: Two target critics at the next latent and the policy's action, [2, T, B].
        discount: gamma.
        td_lambda: lambda, 0 to 1.

    Source: Sutton and Barto, Reinforcement Learning, 2018, section 12.1.
    """
    values = next_q.amin(0)
    targets, later = [], values[-1]
    for r, ended, value in zip(reward.flip(0), terminated.flip(0), values.flip(0), strict=True):
        later = r + discount * torch.where(ended, 0.0, torch.lerp(value, later, td_lambda))
        targets.append(later)
    return torch.stack(targets[::-1])


def value_target(q: Tensor, terminated: Tensor) -> Tensor:
    """Target of V(z): the mean of the target critics at (z, pi(z)), zero where the episode has terminated.

    Args:
        q: [E, T, B].
        terminated: Bool, [T, B]: the latent belongs to a terminal state, whose value is zero by definition.
    """
    return torch.where(terminated, 0.0, q.mean(0))


class Targets(NamedTuple):
    """What critics, V and reward are trained toward, two-hot."""

    q: Tensor  # [T, B, bins]
    value: Tensor  # [T + 1, B, bins]
    reward: Tensor  # [T, B, bins]
    mean: Tensor  # of the target critics, reward units, scalar


@torch.no_grad()
def targets(
    model: WorldModel,
    encoded: Tensor,
    data: Slices,
    noise: Tensor,
    heads: Sequence[int] | Tensor | None,
    discount: float,
    td_lambda: float,
) -> Targets:
    """`td_target` and `value_target` from the target critics at the policy's actions.

    Args:
        model: What is trained.
        encoded: Latents of the observations, [T + 1, B, D].
        data: The slices.
        noise: Of the policy's actions, [T + 1, B, A].
        heads: The two critics whose minimum is taken; None: there are two.
        discount, td_lambda: As in `td_target`.
    """
    ended = torch.cat([torch.zeros_like(data.terminated[:1]), data.terminated])  # [T + 1, B]
    q = model.q(encoded, model.policy(encoded, noise)[0], target=True)  # [E, T + 1, B]
    pair = q if heads is None else q[heads]
    towards = td_target(data.reward, data.terminated, pair[:, 1:], discount, td_lambda)
    value = value_target(q, ended)
    encode = model.two_hot.encode
    return Targets(encode(towards), encode(value), encode(data.reward), q.mean())


def policy_loss(q: Tensor, log_prob: Tensor, entropy_coef: Tensor | float, scale: Tensor | float) -> Tensor:
    """alpha log pi(a|z) - mean_e Q_e(z, a) / scale, [E, T, B] and [T, B] -> [T, B]."""
    return entropy_coef * log_prob - q.mean(0) / scale


def entropy_coef_loss(log_coef: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """-log alpha mean(log pi + target): alpha grows while the policy's entropy is below its target. Scalar."""
    return -log_coef * (log_prob.detach().mean() + target_entropy)


def imagined_objective(model: WorldModel, z: Tensor, noise: Tensor, discount: float) -> tuple[Tensor, Tensor]:
    """SGFT objective of the policy's own imagined actions, differentiable in the policy through the dynamics.

        J = sum_{t<H} gamma^t r_t + gamma^H V(z_H) - V(z_0),   a_t = pi(z_t)

    Args:
        z: Latents to start from, [M, D].
        noise: Standard normal, [H, M, A].

    Returns:
        Objective [M], and mean log-density of the actions taken [M].
    """
    objective, log_probs, weight = -model.terminal_value(z), [], 1.0
    for step_noise in noise:
        action, log_prob = model.policy(z, step_noise)
        next_z = model.next(z, action)
        objective = objective + weight * model.reward(z, action, next_z)
        log_probs.append(log_prob)
        z, weight = next_z, weight * discount
    return objective + weight * model.terminal_value(z), torch.stack(log_probs).mean(0)


class RunningScale:
    """Running 5-95 % range of values, at least one: keeps the policy loss alike across reward scales.

    Source: DreamerV3, arXiv:2301.04104; TD-MPC2's `RunningScale`.

    Args:
        rate: Share of the newest batch's range.
    """

    def __init__(self, rate: float, device: torch.device | str = "cpu") -> None:
        self.rate = rate
        self.ends = torch.tensor([0.05, 0.95], device=device)
        self.value = torch.ones((), device=device)

    @torch.no_grad()
    def update(self, x: Tensor) -> Tensor:
        """Take in a batch of any shape; returns the range, a scalar tensor."""
        low, high = torch.quantile(x.flatten(), self.ends)
        return self.value.lerp_((high - low).clamp_min(1.0), self.rate)
