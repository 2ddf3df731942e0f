"""One step of what learns from real data: the dynamics and the maps of commands and observations, or a whole model."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mpc_sgft.learning import losses
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.dynamics import Dynamics, side_by_side
from mpc_sgft.learning.precision import in_own_precision
from mpc_sgft.learning.slices import Slices, check_finite
from mpc_sgft.learning.world_model import WorldModel


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

    def parameters(self) -> list[nn.Parameter]:
        """All that learn."""
        own = [p for part in self.parts for p in part.parameters()]
        return list(dict.fromkeys([*own, *(self.suspicion.parameters if self.suspicion else ())]))


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
    with torch.no_grad():
        encoded = agent.model.encode(data.observation)  # [T + 1, B, D]
    metrics = dict[str, Tensor]()

    def add(name: str, loss: Tensor, penalties: tuple[Penalty, ...]) -> Tensor:
        metrics[name] = loss
        for penalty in penalties:
            metrics[penalty.name] = penalty.value()
            loss = loss + penalty.weight * metrics[penalty.name]
        return loss

    (error,) = _errors([agent.model.dynamics], encoded, data.action, rho)
    total = add("consistency_loss", error, (penalty,) if penalty else ())
    of_maps = None if maps is None else _explain(agent.model, data, rho, maps, add)
    check_finite(metrics)
    agent.optimizers.model.zero_grad()
    scale = agent.weights["consistency_loss"]
    (scale * total).backward(inputs=agent.dynamics_parameters() if maps else None)
    if maps is not None and of_maps is not None:
        (scale * of_maps).backward(inputs=maps.parameters())
    metrics["grad_norm"] = torch.nn.utils.clip_grad_norm_(agent.optimizers.trained, agent.grad_clip, foreach=True)
    agent.optimizers.model.step()
    return metrics, encoded


def _explain(
    model: WorldModel, data: Slices, rho: float, maps: Maps, add: Callable[[str, Tensor, tuple[Penalty, ...]], Tensor]
) -> Tensor:
    """Sum of the losses of what maps explain, scalar; all are imagined in one pass."""
    looks = (False, True) if maps.suspicion else (None,)
    corrected = torch.stack([model.corrected(data.observation, suspected=look) for look in looks], 1)
    encoded = model.encode_corrected(corrected).unbind(1)  # each [T + 1, B, D]
    told = [("map_loss", maps.simulated, encoded[0], maps.penalties)]
    if maps.rival is not None:
        told.append(("rival_loss", maps.rival, encoded[0].detach(), ()))
    if maps.suspicion is not None:
        told.append(("suspicion_loss", maps.suspicion.simulated, encoded[1], maps.suspicion.penalties))
    names, dynamics, targets, penalties = zip(*told, strict=True)
    errors = _errors(dynamics, torch.cat(targets, 1), data.action, rho)
    return torch.stack([add(*each) for each in zip(names, errors, penalties, strict=True)]).sum()


def _errors(dynamics: Sequence[Dynamics], encoded: Tensor, action: Tensor, rho: float) -> list[Tensor]:
    """Loss of each of K dynamics, scalars, on its share of [T + 1, K B, D], with the same actions [T, B, A] for all.

    What is to be predicted is no constant: the maps move it.
    """
    count = len(dynamics)
    zs = losses.imagine(side_by_side(dynamics), encoded[0], action.repeat(1, count, 1))
    squared = (zs[1:] - encoded[1:]).square().mean(-1)  # [T, K B]
    return [losses.over_time(part, rho) for part in squared.chunk(count, 1)]


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
