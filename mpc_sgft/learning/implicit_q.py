"""Implicit Q-learning on latents: no action is valued that nobody took.

Source: Kostrikov, Nair, Levine, "Offline Reinforcement Learning with Implicit Q-Learning", ICLR 2022, arXiv:2110.06169.
"""

import torch
from torch import Tensor

from mpc_sgft.learning import losses
from mpc_sgft.learning.actor_critic import Transitions
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.precision import in_own_precision
from mpc_sgft.learning.slices import check_finite

HEAVIEST = 100.0  # weight of an action in the policy's loss, at most; the publication's


def check_implicit(expectile: float, temperature: float) -> None:
    """Raise ValueError if the expectile lies outside (0.5, 1) or the temperature is not positive."""
    if not 0.5 < expectile < 1:
        raise ValueError(f"expectile={expectile} must lie between 0.5 and 1.")
    if not temperature > 0:
        raise ValueError(f"temperature={temperature} must be positive.")


def expectile_loss(error: Tensor, expectile: float) -> Tensor:
    """|tau - 1(error < 0)| error^2, any shape: least at the tau-expectile of what is predicted.

    Args:
        error: Target minus prediction.
        expectile: tau.
    """
    return torch.where(error < 0, 1 - expectile, expectile) * error.square()


@in_own_precision
def fit_implicit(agent: Agent, found: Transitions, *, expectile: float, temperature: float) -> dict[str, Tensor]:
    """One step of V, of the critics, of the policy and of the target critics.

        V(z) is the tau-expectile of min_e Qbar_e(z, a)
        y = r + gamma (1 - ended) V(z')
        the policy climbs exp((min_e Qbar_e(z, a) - V(z)) / lambda) log pi(a|z)

    Args:
        agent: Whose critics, V and policy head train; everything else stays.
        found: Transitions.
        expectile: tau.
        temperature: lambda, reward units.

    Raises:
        FloatingPointError: If a loss is not finite; that part has changed nothing then.
    """
    model = agent.model
    with torch.no_grad():
        worth = model.q(found.z, found.action, target=True, heads=agent.two_heads()).amin(0)  # [N]
        later = torch.where(found.ended, 0.0, model.two_hot.decode(model.value_head(found.next_z)))
        goal = model.two_hot.encode(found.reward + agent.discount * later)
    value = model.two_hot.decode(model.value_head(found.z))
    logits = model.q_logits(found.z, found.action)  # [E, N, bins]
    metrics = {
        "value_loss": expectile_loss(worth - value, expectile).mean(),
        "q_loss": losses.two_hot_loss(logits, goal.expand_as(logits)).mean(),
    }
    check_finite(metrics)
    trained = [*model.value_head.parameters(), *model.q_ensemble.parameters()]
    metrics["grad_norm"] = agent.step_model(metrics["value_loss"] + metrics["q_loss"], trained)
    advantage = worth - value.detach()
    weight = (advantage / temperature).exp().clamp_max(HEAVIEST)
    log_prob = model.log_prob(found.z, found.action)
    cloned = agent.step_policy(-(weight * log_prob).mean(), log_prob)
    model.update_targets(agent.target_rate)
    metrics |= {"policy_loss": cloned["policy_loss"], "cross_entropy": cloned["entropy"]}  # its actions are not its own
    return metrics | {"advantage": advantage.mean()}
