"""Whole episodes, all environments in step: for collecting, and for measuring success."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from envs.env import ControlEnv
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs.proportion import wilson
from planners.base import Plan

Act = Callable[[Tensor, Tensor], Tensor]  # observation [N, O], fresh [N] -> action [N, A]


class Score(NamedTuple):
    """What a set of evaluation episodes came to."""

    episodes: int
    successes: int
    success: float
    success_low: float  # 95 % Wilson interval
    success_high: float
    episode_return: float


def collect(env: ControlEnv, act: Act, *, seed: int, first_episode: int = 0) -> TensorDict:
    """One episode's length in every environment, from a fresh reset, [N, T].

    An environment whose episode ends early goes on with a new one; `episode` numbers them without gaps in meaning.

    Args:
        env: Environments; they are reseeded, so the result is a function of `seed` and of what `act` does.
        act: What to do.
        seed: Of the environments' randomness.
        first_episode: Number of the first episode.
    """
    env.set_seed(seed)
    state = env.reset()
    n = env.batch_size[0]
    episode = first_episode + torch.arange(n)
    step, following = torch.zeros(n, dtype=torch.long), first_episode + n
    fresh, rows = torch.ones(n, dtype=torch.bool), []
    for left in reversed(range(env.task.episode_steps)):
        state["action"] = act(state["observation"], fresh)
        row, state = env.step_and_maybe_reset(state) if left else (env.step(state), state)  # no start is made unused
        row["episode"], row["step"] = episode, step
        rows.append(row)
        fresh = row["next", "done"][:, 0]
        episode, step = episode.clone(), torch.where(fresh, 0, step + 1)
        episode[fresh] = following + torch.arange(int(fresh.sum()))
        following += int(fresh.sum())
    return cast(TensorDict, TensorDict.stack(rows, 1))


def shown(act: Act, bar: tqdm) -> Act:
    """The same policy; a progress bar counts its steps."""

    def counted(observation: Tensor, fresh: Tensor) -> Tensor:
        action = act(observation, fresh)
        bar.update()
        return action

    return counted


def score(episodes: TensorDict) -> Score:
    """Success at the end of each environment's first episode, with its interval, and the mean return."""
    first = episodes["episode"] == episodes["episode"][:, :1]
    returns = (episodes["next", "reward"][..., 0] * first).sum(1)
    return score_of(succeeded(episodes).tolist(), returns.tolist())


def succeeded(episodes: TensorDict) -> Tensor:
    """Success at the end of each environment's first episode, of steps [N, T]: bool [N]."""
    first = episodes["episode"] == episodes["episode"][:, :1]
    last = first.long().cumsum(1).argmax(1)  # [N] index of the first episode's last step
    return episodes["next", "success"][torch.arange(len(last)), last, 0]


def score_of(successes: Sequence[bool], returns: Sequence[float]) -> Score:
    """The score of episodes of which only the outcome is known; at least one."""
    n, k = len(successes), sum(successes)
    return Score(n, k, k / n, *wilson(k, n), float(np.mean(returns)))


def planner_policy(model: WorldModel, planner, seed: int, *, explore: bool = False) -> Act:
    """A model acting through a planner, with a generator of its own and a warm start that ends with each episode."""
    device = next(model.parameters()).device
    generator = torch.Generator(device).manual_seed(seed)
    previous: Plan | None = None

    def act(observation: Tensor, fresh: Tensor) -> Tensor:
        nonlocal previous
        if fresh.all():
            previous = None  # nothing to warm-start from, and the number of environments may have changed
        with torch.inference_mode():
            z = model.encode(observation.to(device))
            previous = planner.plan(model, z, previous, fresh.to(device), generator, explore=explore)
        assert previous is not None
        return previous.action.cpu().clone()  # an ordinary tensor, not one of inference mode

    return act


def scripted_policy(env: ControlEnv) -> Act:
    """The task's hand-written policy."""

    def act(observation: Tensor, fresh: Tensor) -> Tensor:
        return torch.from_numpy(env.task.scripted(observation[:, : env.raw_dim].numpy().astype(np.float64))).float()

    return act


def random_policy(env: ControlEnv, seed: int, scale: float = 1.0) -> Act:
    """Uniform actions, scaled; scale 0 does nothing."""
    generator = torch.Generator().manual_seed(seed)

    def act(observation: Tensor, fresh: Tensor) -> Tensor:
        return scale * (2 * torch.rand(len(observation), env.action_dim, generator=generator) - 1)

    return act
