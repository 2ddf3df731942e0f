"""One step of what learns from real data: the dynamics and the maps of commands and observations, or a whole model."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mpc_sgft.learning import losses
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.dynamics import Dynamics
from mpc_sgft.learning.precision import in_own_precision
from mpc_sgft.learning.slices import Slices, check_finite


class Penalty(NamedTuple):
    """What is added to a loss."""

    name: str
    weight: float
    value: Callable[[], Tensor]  # worked out after the loss


class Suspicion(NamedTuple):
    """What sensors could be suspected of, as another explanation than the maps.

    Attributes:
        parameters: What learns: shifts, and the command map that goes with them.
        simulated: The simulator's dynamics with this command map.
        penalties: On them.
    """

    parameters: tuple[nn.Parameter, ...]
    simulated: Dynamics
    penalties: tuple[Penalty, ...] = ()


class Maps(NamedTuple):
    """How the maps learn: they explain of the data what they can together with the simulator's dynamics.

    The dynamics learn the rest, with the maps as they are. Learned at once, a growing command map and shrinking
    dynamics explain the same data, and neither holds elsewhere.

    Attributes:
        parts: What learns.
        simulated: The simulator's dynamics, with the command map that acts, or would without a suspicion.
        penalties: On the maps.
        rival: The simulator's dynamics, with a command map that learns beside it; nothing else learns by these.
        suspicion: Learns beside them; while it acts, the maps learn as if it did not.
    """

    parts: tuple[nn.Module, ...]
    simulated: Dynamics
    penalties: tuple[Penalty, ...] = ()
    rival: Dynamics | None = None
    suspicion: Suspicion | None = None


@in_own_precision
def fit_dynamics(
    agent: Agent,
    data: Slices,
    *,
    rho: float,
    penalty: Penalty | None = None,
    maps: Maps | None = None,
) -> tuple[dict[str, Tensor], Tensor]:
    """One step of the dynamics toward the encoded observations; the encoder stays as it is.

    Args:
        agent: Whose dynamics train.
        data: Slices of T steps.
        rho: Weight of imagined step t is rho^t.
        penalty: On the dynamics.
        maps: How the maps learn; None: what the dynamics hold of them learns with these.

    Returns:
        Metrics, and the encoded observations, [T + 1, B, D].

    Raises:
        FloatingPointError: If a loss is not finite; nothing has changed then.
    """
    seen = agent.model.encode(data.observation)  # [T + 1, B, D]
    encoded = seen.detach()

    def error(dynamics: nn.Module, encoded: Tensor) -> Tensor:  # its targets are no constants: the maps move them
        zs = losses.imagine(dynamics, encoded[0], data.action)
        return losses.over_time((zs[1:] - encoded[1:]).square().mean(-1), rho)

    def with_penalties(loss: Tensor, penalties: tuple[Penalty, ...]) -> Tensor:
        for penalty in penalties:
            metrics[penalty.name] = penalty.value()
            loss = loss + penalty.weight * metrics[penalty.name]
        return loss

    metrics = {"consistency_loss": error(agent.model.dynamics, encoded)}
    total = with_penalties(metrics["consistency_loss"], (penalty,) if penalty else ())
    if maps is not None:
        trusted = agent.model.encode(data.observation, suspected=False) if maps.suspicion else seen
        metrics["map_loss"] = error(maps.simulated, trusted)
        of_maps = with_penalties(metrics["map_loss"], maps.penalties)
        if maps.rival is not None:
            metrics["rival_loss"] = error(maps.rival, trusted.detach())
            of_maps = of_maps + metrics["rival_loss"]
        if maps.suspicion is not None:
            suspected = agent.model.encode(data.observation, suspected=True)
            metrics["suspicion_loss"] = error(maps.suspicion.simulated, suspected)
            of_suspicion = with_penalties(metrics["suspicion_loss"], maps.suspicion.penalties)
    check_finite(metrics)
    agent.optimizers.model.zero_grad()
    scale = agent.weights["consistency_loss"]
    (scale * total).backward(inputs=agent.dynamics_parameters() if maps else None)
    if maps is not None:
        (scale * of_maps).backward(inputs=[p for part in maps.parts for p in part.parameters()])
        if maps.suspicion is not None:
            (scale * of_suspicion).backward(inputs=[*maps.suspicion.parameters])
    metrics["grad_norm"] = torch.nn.utils.clip_grad_norm_(agent.optimizers.trained, agent.grad_clip, foreach=True)
    agent.optimizers.model.step()
    return metrics, encoded


@in_own_precision
def fit_model(agent: Agent, data: Slices, *, rho: float) -> tuple[dict[str, Tensor], Tensor]:
    """One step of TD-MPC2's losses of a model without its critic: encoder, dynamics and reward.

    Args:
        agent: Whose encoder, dynamics and reward train.
        data: Slices of T steps.
        rho: Weight of imagined step t is rho^t.

    Returns:
        Metrics, and the encoded observations, [T + 1, B, D].

    Raises:
        FloatingPointError: If a loss is not finite; nothing has changed then.
    """
    model = agent.model
    first = model.encode(data.observation[0])  # [B, D], trains the encoder
    with torch.no_grad():
        encoded = torch.cat([first.unsqueeze(0), model.encode(data.observation[1:])])  # [T + 1, B, D]
    zs = losses.imagine(model.dynamics, first, data.action)
    target = model.two_hot.encode(data.reward)
    reward = losses.two_hot_loss(model.reward_logits(zs[:-1], data.action, zs[1:]), target)
    metrics = {
        "consistency_loss": losses.over_time((zs[1:] - encoded[1:]).square().mean(-1), rho),
        "reward_loss": losses.over_time(reward, rho),
    }
    check_finite(metrics)
    total = torch.stack([agent.weights[name] * loss for name, loss in metrics.items()]).sum()
    metrics["grad_norm"] = agent.step_model(total)
    return metrics, encoded.detach()
