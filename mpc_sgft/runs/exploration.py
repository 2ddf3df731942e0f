"""How to drive a machine so that a few rollouts tell most about what randomisation draws.

Expected information of the draws' places theta in their ranges, from observations with independent noise of sd sigma:

    I = E[sum_t sum_k (d o_tk / d theta)^T (d o_tk / d theta)] / sigma^2

over episodes of the randomised simulator, under the actions that the driver takes there. What is least is the variance
that is expected to be left of theta after one rollout, tr((I + 12)^-1), with 12 the information of a uniform place.

What differs from the publication: the driver is the policy prior pushed by a few offsets over time, found by the
cross-entropy method, where there it is a policy trained by reinforcement; derivatives are differences of simulations.

Source: Memmel et al., "ASID: Active Exploration for System Identification in Robotic Manipulation", ICLR 2024,
arXiv:2404.12308.
"""

from collections.abc import Callable, Iterable
from contextlib import closing
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from envs.env import ControlEnv
from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from planners.exploring import offset_at, pushed

STEP = 0.1  # of a range, to either side, for the derivatives
UNIFORM = 12.0  # information of what is uniform over its range: 1 / variance
STILL = 1e-3  # [m or rad] least sd of what is observed, where randomisation adds no noise
ELITES = 0.25  # share of the proposals that the next ones are drawn around


class Exploration(NamedTuple):
    """How to drive, and what that tells.

    Attributes:
        weight: Of the policy prior.
        offsets: Knots of the offsets, [K, A].
        left: Standard deviation expected to be left of each draw's place after one rollout, [D], in episodes that did
            not choose the offsets; 0.29 is what was there before.
        plain: The same of the policy prior alone.
    """

    weight: float
    offsets: Tensor
    left: Tensor
    plain: Tensor


def explore(
    cfg: DictConfig,
    model: WorldModel,
    *,
    seed: int,
    knots: int = 8,
    proposals: int = 12,
    starts: int = 2,
    rounds: int = 10,
    track: Callable[[range], Iterable[int]] = iter,
) -> Exploration:
    """The most telling offsets that the cross-entropy method finds; the policy prior alone is among the proposals.

    Args:
        cfg: Of pretraining: the task and what is randomised.
        model: Whose policy prior drives.
        seed: Of the search and the simulated episodes.
        knots: K.
        proposals: Driven side by side a round.
        starts: Episodes that each is driven in, the same for all of a round.
        rounds: Of proposals.
        track: Shows how far the search is, as tqdm does.

    Raises:
        UserError: If nothing is drawn, or the model does not fit the task.
    """
    draws = len(build.draws_of(cfg))
    if not draws:
        raise UserError(
            f"randomize={cfg.chosen.randomize} draws nothing, so there is nothing to learn. Give another one."
        )
    env = build.make_env(cfg, proposals * starts * (1 + 2 * draws), randomised=True)
    build.check_fits(model, env)
    generator = torch.Generator().manual_seed(seed)
    size = knots * env.action_dim
    mean, sd = torch.zeros(size + 1), torch.full((size + 1,), 0.5)
    mean[-1] = 1.0  # the weight of the policy prior
    best = mean
    with closing(env.backend):
        noise = max(env.backend.noise_sd, STILL)
        env.backend.noise_sd = 0.0

        def left(drawn: Tensor, number: int) -> Tensor:
            """Variance that each driver leaves of each place in the starts of a round, [M, D]."""
            pushes = drawn[:, :-1].view(proposals, knots, -1)
            found = information(env, model, drawn[:, -1], pushes, draws, seed * (rounds + 1) + number, noise)
            return torch.linalg.inv(found + UNIFORM * torch.eye(draws)).diagonal(dim1=-2, dim2=-1)

        for number in track(range(rounds)):
            drawn = mean + sd * torch.randn(proposals, size + 1, generator=generator)
            drawn[0], drawn[0, -1], drawn[1] = 0.0, 1.0, best
            drawn[:, -1].clamp_(0, 1)
            drawn[:, :-1].clamp_(-2, 2)
            order = left(drawn, number).sum(1).argsort()
            elites = drawn[order[: max(2, int(ELITES * proposals))]]
            mean, sd = elites.mean(0), elites.std(0) + 0.02
            best = drawn[order[0]]
        drawn = best.repeat(proposals, 1)
        drawn[0], drawn[0, -1] = 0.0, 1.0
        plain, found = left(drawn, rounds)[:2].sqrt()  # in starts and draws that chose nothing
    return Exploration(float(best[-1]), best[:-1].view(knots, -1), found, plain)


@torch.no_grad()
def information(
    env: ControlEnv, model: WorldModel, weight: Tensor, offsets: Tensor, draws: int, seed: int, noise: float
) -> Tensor:
    """Expected information of the draws' places, [M, D, D], from one rollout of each driver.

    An episode's driver sees the episode as drawn; its actions are taken in neighbours, too, whose one draw lies a step
    to either side.

    Args:
        env: Randomised, of M S (1 + 2 D) environments.
        model: Whose policy prior drives.
        weight, offsets: Of the M drivers, [M] and [M, K, A].
        draws: D.
        seed: Of starts and draws, the same for all drivers.
        noise: sd of what is observed.
    """
    drivers, group = len(weight), 1 + 2 * draws
    starts = env.batch_size[0] // (drivers * group)
    rng = np.random.default_rng(seed)
    centre = rng.uniform(STEP, 1 - STEP, (starts, draws))
    aside = np.concatenate([np.zeros((1, draws)), STEP * np.eye(draws), -STEP * np.eye(draws)])
    places = centre[None, :, None] + aside  # [1, S, G, D]
    backend, steps = env.backend, env.task.episode_steps
    backend.randomizer.given = np.broadcast_to(places, (drivers, *places.shape[1:])).reshape(-1, draws)
    which = np.broadcast_to(np.arange(starts)[:, None], (drivers, starts, group)).ravel()
    env.set_seed(seed)
    backend.rngs = [np.random.default_rng((seed, int(s))) for s in which]  # neighbours start alike
    state = env.reset()
    alive, seen = torch.ones(drivers, starts, group, dtype=torch.bool), []
    for t in range(steps):
        first = state["observation"].view(drivers, starts, group, -1)[:, :, 0]
        prior = model.policy_prior(model.encode(first), None)  # [M, S, A]
        offset = offset_at(offsets, torch.tensor([t / max(steps - 1, 1)]))  # [M, 1, A]
        action = pushed(prior, weight[:, None, None], offset)
        state["action"] = action[:, :, None].expand(-1, -1, group, -1).reshape(-1, env.action_dim)
        state = env.step(state)["next"]
        alive = alive & ~(state["terminated"] | state["invalid"]).view(drivers, starts, group)
        raw = state["observation"].view(drivers, starts, group, -1)[..., : env.raw_dim]
        seen.append(torch.where(alive.all(-1)[..., None, None], raw, 0.0))
    path = torch.stack(seen, 2).double()  # [M, S, T, G, O]
    slope = (path[..., 1 : 1 + draws, :] - path[..., 1 + draws :, :]) / (2 * STEP * noise)
    return torch.einsum("mstdo,msteo->mde", slope, slope).float() / starts
