"""Soft actor-critic on the latents of a frozen encoder: what methods without a planner learn from.

A batch is flat transitions, and what a method does to them is one function after the other: `of_slices`, then perhaps
`shaped` or `guided`, then `fit_soft`. `guided` is Algorithm 1 of SGFT: it makes of any method that learns from
transitions its guided version.

Source: Haarnoja et al., arXiv:1812.05905 (SAC); the critics are TD-MPC2's, two-hot (arXiv:2310.16828).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mpc_sgft.learning import losses
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.precision import in_own_precision
from mpc_sgft.learning.shaping import shape_reward
from mpc_sgft.learning.slices import Slices, check_finite
from mpc_sgft.learning.world_model import WorldModel


class Transitions(NamedTuple):
    """N transitions between latents, in the order of time within [T, B] where they come from slices."""

    z: Tensor  # [N, D]
    action: Tensor  # [N, A]
    reward: Tensor  # [N]
    next_z: Tensor  # [N, D]
    ended: Tensor  # [N] bool: nothing is worth anything after it


@torch.no_grad()
def of_slices(model: WorldModel, data: Slices) -> Transitions:
    """Every step of some slices, encoded."""
    z = model.encode(data.observation)  # [T + 1, B, D]
    flat = (x.flatten(0, 1) for x in (z[:-1], data.action, data.reward, z[1:], data.terminated))
    return Transitions(*flat)


@torch.no_grad()
def shaped(model: WorldModel, found: Transitions, discount: float) -> Transitions:
    """With rewards r + gamma (1 - ended) V(z') - V(z), V the frozen value of the simulator."""
    value, next_value = model.terminal_value(found.z), model.terminal_value(found.next_z)
    return found._replace(reward=shape_reward(found.reward, value, next_value, found.ended, discount))


def guided(model: WorldModel, found: Transitions, discount: float, steps: int) -> Transitions:
    """`shaped`, and every `steps` consecutive steps are an episode of their own, which the last of them ends.

    What the last step leads to is still worth its V: its shaped reward holds it. Only critics of shaped rewards count
    no further. A critic of one step (`steps` 1) is the shaped reward itself. Critics of more do not see how many steps
    are left: slices begin anywhere, so a step is their last in one case of T, and they learn the mean of what is left.

    Args:
        model: Whose V.
        found: T steps of B slices, time first.
        discount: gamma.
        steps: T = H, after which the world ends.
    """
    found = shaped(model, found, discount)
    ended = found.ended.unflatten(0, (steps, -1)).clone()
    ended[-1] = True
    return found._replace(ended=ended.flatten(0, 1))


@torch.no_grad()
def branches(
    model: WorldModel, z: Tensor, noise: Tensor, dynamics: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Transitions:
    """Short rollouts of the policy in the learned dynamics from latents [N, D], time first.

    Args:
        model: Whose policy, dynamics and reward.
        z: Where they start.
        noise: Standard normal, [T, N, A]; as many steps they have.
        dynamics: Others than the model's, (z, action) -> next z.

    Source: Dyna (Sutton 1991); MBPO (Janner et al. 2019).
    """
    rows, following = [], model.next if dynamics is None else dynamics
    for step_noise in noise:
        action = model.policy(z, step_noise)[0]
        next_z = following(z, action)
        never = torch.zeros(len(z), dtype=torch.bool, device=z.device)
        rows.append((z, action, model.reward(z, action, next_z), next_z, never))
        z = next_z
    return Transitions(*(torch.cat(column) for column in zip(*rows, strict=True)))


def joined(*parts: Transitions) -> Transitions:
    """All transitions of some batches."""
    return Transitions(*(torch.cat(column) for column in zip(*parts, strict=True)))


def forget_critics(model: WorldModel) -> None:
    """Let all critics say zero again: what a shaped reward is worth is not what its reward was."""
    for critic in (*model.q_ensemble, *model.target_q):
        nn.init.zeros_(critic[-1].weight)  # type: ignore[index]
        nn.init.zeros_(critic[-1].bias)  # type: ignore[index]


@in_own_precision
def fit_soft(
    agent: Agent,
    found: Transitions,
    *,
    entropy_coef: float,
    weight: Tensor | None = None,
    penalty: Callable[[Tensor], Tensor] | None = None,
) -> dict[str, Tensor]:
    """One step of the critics, of the policy and of the target critics.

        y = r + gamma (1 - ended) (min_e Qbar_e(z', a') - alpha log pi(a'|z')),   a' ~ pi(z')
        the policy climbs min_e Q_e(z, a) - alpha log pi(a|z)

    Args:
        agent: Whose critics and policy head train; everything else stays.
        found: Transitions.
        entropy_coef: alpha.
        weight: Of each transition in the critics' loss, [N]; None: 1.
        penalty: Of Q [E, N] at what was taken, added to the critics' loss; None: nothing.

    Raises:
        FloatingPointError: If a loss is not finite; that part has changed nothing then.
    """
    model = agent.model
    with torch.no_grad():
        next_action, log_prob = model.policy(found.next_z, agent.noise(len(found.z)))
        worth = model.q(found.next_z, next_action, target=True, heads=agent.two_heads()).amin(0)
        worth = worth - entropy_coef * log_prob
        target = found.reward + agent.discount * torch.where(found.ended, 0.0, worth)  # [N]
    logits = model.q_logits(found.z, found.action)  # [E, N, bins]
    goal = model.two_hot.encode(target).expand_as(logits)
    loss = losses.two_hot_loss(logits, goal)  # [E, N]
    metrics = {"q_loss": (loss if weight is None else weight * loss).mean()}
    if penalty is not None:
        metrics["q_penalty"] = penalty(model.two_hot.decode(logits))
    check_finite(metrics)
    total = torch.stack([*metrics.values()]).sum()
    metrics["q_grad_norm"] = agent.step_model(total, [*model.q_ensemble.parameters()])
    action, log_prob = model.policy(found.z, agent.noise(len(found.z)))
    worth = model.q(found.z, action, heads=agent.two_heads()).amin(0)
    metrics |= agent.step_policy((entropy_coef * log_prob - worth).mean(), log_prob)
    model.update_targets(agent.target_rate)
    return metrics | {"target_value": target.mean()}
