"""A round of exploration in simulation, as a function of its number and of the policy: the same wherever it runs."""

import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import Act, collect, planner_policy, random_policy, shown
from mpc_sgft.storage.metrics import progress
from planners.policy import PolicyPlanner

POLICY = ("normalizer", "encoder", "policy_head", "recurrent_policy")  # what acting takes of the model


class Round(NamedTuple):
    """What a worker must know to collect one round: one episode's length in every environment."""

    number: int
    weights: dict[str, Tensor] | None  # of the parts in POLICY; None: uniform random actions
    shapes: tuple[tuple[float, float], ...] | None = None  # Beta distributions of the draws; None: uniform


class Collected(NamedTuple):
    """What came of a round."""

    steps: TensorDict  # [N, T], episodes numbered from 0
    unstable: int  # episodes that the simulator had to give up
    places: Tensor  # where in its range each draw lay, [N, D]; nan where the episode says nothing about the policy
    shapes: tuple[tuple[float, float], ...] | None  # what these places were drawn from
    seconds: dict[str, float]  # that the workers' physics, and their policies, took together

    def state_dict(self) -> dict[str, Any]:
        """As nested dicts of tensors and numbers, for `Collected.of`."""
        flat, state = self.steps.flatten_keys("."), self._asdict()
        return state | {"steps": {str(k): v for k, v in flat.items()}, "size": tuple(flat.shape)}

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> "Collected":
        """What `state_dict` wrote down."""
        steps = TensorDict(state["steps"], state["size"]).unflatten_keys(".")
        seconds = state.get("seconds", {})  # runs of before did not count them
        return cls(steps, state["unstable"], state["places"], state["shapes"], seconds)


def policy_weights(model: WorldModel) -> dict[str, Tensor]:
    """Copies of what acting takes of a model, on the CPU."""
    return {name: x.detach().cpu().clone() for name, x in model.state_dict().items() if name.split(".")[0] in POLICY}


class Explorer:
    """One worker's environments and policy.

    Args:
        cfg: The run's config.
        sizes: Of the world model.
        part, parts: Which share of the environments is this worker's; each share has its own random numbers.
        threads: Of the physics; 0 takes all cores. They do not change the numbers.
    """

    def __init__(self, cfg: DictConfig, sizes: dict, part: int = 0, parts: int = 1, threads: int = 0) -> None:
        self.cfg, self.part, self.parts = cfg, part, parts
        with torch.random.fork_rng(devices=[]):  # the learner's own random numbers may be in this process
            self.model = WorldModel(**sizes).eval()
        count = share(cfg.num_envs, part, parts)
        self.env = build.make_env(cfg, count, randomised=True, learning=True, threads=threads)

    def collect(self, order: Round, bar: tqdm | None = None) -> Collected:
        """Collect this worker's share of a round; a progress bar counts its steps."""
        before = self.env.backend.counters["unstable"]
        seed = round_seed(self.cfg.seed, order.number * self.parts + self.part)
        randomizer = self.env.backend.randomizer
        randomizer.shapes = None if order.shapes is None else np.array(order.shapes)
        if order.weights is None:
            act = random_policy(self.env, seed)
        else:
            self.model.load_state_dict(order.weights, strict=False)
            act = explorer(self.model, self.cfg, self.env.batch_size[0], seed)
        began, acting = time.monotonic(), [0.0]
        act = _timed(act, acting)
        steps = collect(self.env, shown(act, bar) if bar is not None else act, seed=seed)
        seconds = {"act": acting[0], "physics": time.monotonic() - began - acting[0]}
        places = torch.from_numpy(randomizer.places.copy())
        roaming = len(places) if order.weights is None else int(self.cfg.detours.share * len(places))
        places[:roaming] = torch.nan
        places[steps["episode"][:, 0] != steps["episode"][:, -1]] = torch.nan  # drawn anew since
        return Collected(steps, self.env.backend.counters["unstable"] - before, places, order.shapes, seconds)


def _timed(act: Act, total: list[float]) -> Act:
    """The same policy; its seconds are added to the one number in `total`."""

    def timed(observation: Tensor, fresh: Tensor) -> Tensor:
        began = time.monotonic()
        action = act(observation, fresh)
        total[0] += time.monotonic() - began
        return action

    return timed


def explored(cfg: DictConfig, model: WorldModel, episodes: int) -> TensorDict:
    """Episodes [N, T] of a pretrained policy that explores in the randomised simulator as configs/pretrain.yaml says.

    Args:
        cfg: A deployment's config: its seed, its `task.` settings, and the simulator of the task that its agent is of.
        model: The policy.
        episodes: N.

    Raises:
        UserError: If the policy does not fit the task.
    """
    task = build.agents_of(cfg)
    own = [text for text in cfg.overrides if text.startswith("task.")] if task == cfg.chosen.task else []
    words = [f"task={task}", f"num_envs={episodes}", f"seed={cfg.seed}", f"physics={cfg.physics}", *own]
    worker = Explorer(compose("pretrain", words, []), dict(model.sizes))
    build.check_fits(model, worker.env)
    steps = worker.env.task.episode_steps
    with closing(worker.env.backend), progress(steps, desc="simulate", disable=cfg.quiet, leave=False) as bar:
        return worker.collect(Round(0, policy_weights(model)), bar).steps


def share(count: int, part: int, parts: int) -> int:
    """How many of `count` environments the worker `part` has; the first ones take what is left over."""
    return count // parts + (part < count % parts)


def joined(collected: list[Collected]) -> Collected:
    """The shares of a round together, their episodes numbered one after the other."""
    following = 0
    for found in collected:
        found.steps["episode"] += following
        following = int(found.steps["episode"].max()) + 1
    steps, places = torch.cat([c.steps for c in collected]), torch.cat([c.places for c in collected])
    seconds = {part: sum(c.seconds[part] for c in collected) for part in collected[0].seconds}
    return Collected(steps, sum(c.unstable for c in collected), places, collected[0].shapes, seconds)


def explorer(model: WorldModel, cfg: DictConfig, num_envs: int, seed: int) -> Act:
    """The policy with its own noise; a share of the environments also makes detours, so that the model sees mistakes.

    A detour holds one action for some steps: none at all, or one drawn uniformly. Without, the critic never learns what
    it is worth to rest at the goal, because the policy, whose actions are noisy, never rests.
    """
    detour = cfg.detours
    generator = torch.Generator().manual_seed(seed)
    policy = PolicyPlanner(action_dim=model.action_dim, horizon=1)
    sample = planner_policy(model, policy, seed, explore=True)
    roaming = int(detour.share * num_envs)
    left = torch.zeros(roaming, dtype=torch.long)  # steps of the detour that are left
    held = torch.zeros(roaming, policy.action_dim)

    def act(observation: Tensor, fresh: Tensor) -> Tensor:
        action = sample(observation, fresh)
        chance, kind = torch.rand(2, roaming, generator=generator)
        length = torch.randint(detour.steps[0], detour.steps[1], (roaming,), generator=generator)
        drawn = 2 * torch.rand(roaming, policy.action_dim, generator=generator) - 1
        starts = (left == 0) & (chance < detour.rate)
        left[:] = torch.where(starts, length, (left - 1).clamp(min=0))
        held[starts] = torch.where(kind < detour.rest, 0.0, drawn.T).T[starts]
        action[:roaming] = torch.where((left > 0)[:, None], held, action[:roaming])
        return action

    return act


def check_exploration(cfg: DictConfig) -> None:
    """Raise UserError unless detours, and what a task is asked in training alone, can be: no worker has begun yet."""
    for name in ("share", "rate", "rest"):
        value = cfg.detours[name]
        if value is None or not 0 <= value <= 1:
            raise UserError(f"detours.{name}={value}: a share, between 0 and 1.")
    steps = cfg.detours.steps or ()
    if len(steps) != 2 or not all(isinstance(n, int) for n in steps) or not 0 < steps[0] < steps[1]:
        raise UserError(f"detours.steps={steps}: from and to (without), two whole numbers, 0 < from < to.")
    build.make_env(cfg, 1, randomised=True, learning=True).backend.close()


def round_seed(seed: int, number: int) -> int:
    return (seed * 1_000_003 + number) % 2**31
