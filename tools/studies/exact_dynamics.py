"""What bounds the transfer, the learned dynamics or the frozen critic? Plan with a gap's own physics and see.

    python -m tools.studies.exact_dynamics results/exact_dynamics/exact_dynamics.csv --gaps glide [--horizons 4]

MPPI as in `deploy`, with the shipped checkpoint's encoder, reward head, V and policy prior, but the next state comes
from MuJoCo with the effects of the gap: what fine-tuned dynamics without any error would imagine. What still fails is
not their fault. `--reward true` takes the task's reward in place of the learned one. A plan costs some 1800 control
steps, an episode about a minute of one core.
"""

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from envs.effects.sensor_delay import SensorDelay
from envs.env import ControlEnv
from envs.task import Array
from mpc_sgft.command.compose import compose, normalise
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import collect, planner_policy, score
from mpc_sgft.runs.pretrain import EVAL_SEED
from tools.studies.runner import measured

COLUMNS = ["gap", "horizon", "reward", "episodes", "success", "success_low", "success_high", "episode_return"]


class ExactModel:
    """A `planners.base.Model` whose latent [..., S + 1 + O] is a simulation's state, last reward and observation.

    Args:
        model: Frozen encoder, reward head, V and policy prior.
        env: The simulations that act; `encode` reads their state.
        imagined: Makes as many simulations of the same gap as are imagined at once.
        true_reward: Take the task's reward, not the model's.
    """

    def __init__(
        self, model: WorldModel, env: ControlEnv, imagined: Callable[[int], ControlEnv], *, true_reward: bool
    ) -> None:
        if any(isinstance(effect, SensorDelay) for effect in env.backend.effects):
            raise ValueError("sensor_delay: what a late sensor will read is kept elsewhere, and not copied here")
        self.model, self.env, self.imagined, self.true_reward = model, env, cache(imagined), true_reward

    def parameters(self) -> Iterator[Tensor]:
        return self.model.parameters()

    def encode(self, observation: Tensor) -> Tensor:
        """Latents of the acting simulations, [N, S + 1 + O]; `observation` [N, O] is theirs."""
        now = torch.from_numpy(state(self.env))
        return torch.cat([now, torch.zeros(len(now), 1), observation.double()], -1)

    @property
    def value_range(self) -> float:
        return self.model.value_range

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        rows, commands = z.flatten(0, -2), action.flatten(0, -2)
        env, width = self.imagined(len(rows)), self.env.obs_dim
        restore(env, rows[:, : -width - 1].numpy())
        out = env.backend.send(commands.numpy())
        if out.invalid.any():
            raise FloatingPointError(f"{out.invalid.sum()} imagined simulations are unstable")
        past = rows[:, -width:]
        seen, did = past[:, : env.history * env.raw_dim], past[:, (env.history + 1) * env.raw_dim :]
        did = torch.cat([commands, did], 1)[:, : did.shape[1]]
        after = [state(env), out.reward[:, None], out.observation, seen.numpy(), did.numpy()]
        return torch.from_numpy(np.concatenate(after, 1)).view_as(z)

    def reward(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        if self.true_reward:
            return next_z[..., -self.env.obs_dim - 1]
        return self.model.reward(self._latent(z), action.float(), self._latent(next_z)).double()

    def terminal_value(self, z: Tensor) -> Tensor:
        return self.model.terminal_value(self._latent(z)).double()

    def policy_prior(self, z: Tensor, noise: Tensor | None) -> Tensor:
        return self.model.policy_prior(self._latent(z), None if noise is None else noise.float()).double()

    def _latent(self, z: Tensor) -> Tensor:
        return self.model.encode(z[..., -self.env.obs_dim :].float())


def state(env: ControlEnv) -> Array:
    """Everything that the next period depends on but the past observations, [N, S]."""
    return np.concatenate([x.reshape(len(x), -1) for x in _fields(env)], 1)


def restore(env: ControlEnv, rows: Array) -> None:
    """Set what `state` read."""
    start = 0
    for x in _fields(env):
        flat = x.reshape(len(x), -1)
        x[...] = rows[:, start : start + flat.shape[1]].reshape(x.shape)
        start += flat.shape[1]


def _fields(env: ControlEnv) -> list[Array]:
    b = env.backend  # type: ignore[attr-defined]
    return [*b.state, b.act, b.signal, b.delayed, b.clock, b.batch.bind("qacc_warmstart"), b.target, b.told]


def measure(gap: str, horizon: int, reward: str, episodes: int, settings: Sequence[str] = ()) -> dict[str, object]:
    """Success over the first evaluation episodes of a gap, a row of the CSV; `settings` are overrides of deploy."""
    words = [f"gap={gap}", f"planner.horizon={horizon}", "planner.chunk_rows=832", *map(normalise, settings)]
    cfg = compose("deploy", words, list(settings))
    build.prepare_process(cfg)
    agent, _ = build.load_agent(cfg)
    env = build.make_env(cfg, episodes)
    model = ExactModel(agent.model, env, lambda n: build.make_env(cfg, n), true_reward=reward == "true")
    act = planner_policy(model, build.make_planner(cfg, env.action_dim), EVAL_SEED)  # type: ignore[arg-type]
    result = score(collect(env, lambda o, fresh: act(o, fresh).float(), seed=EVAL_SEED))
    row = [
        gap,
        horizon,
        reward,
        episodes,
        result.success,
        result.success_low,
        result.success_high,
        result.episode_return,
    ]
    return dict(zip(COLUMNS, row, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--gaps", nargs="+", default=["glide"])
    parser.add_argument("--horizons", nargs="+", type=int, default=[4])
    parser.add_argument("--reward", nargs="+", choices=("learned", "true"), default=["learned"])
    parser.add_argument("--episodes", type=int, default=24)
    told = "overrides, e.g. task=hammer; rows do not tell them, so take another CSV"
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help=told)
    args = parser.parse_args()
    keys = [
        {"gap": gap, "horizon": horizon, "reward": reward}
        for gap, horizon, reward in itertools.product(args.gaps, args.horizons, args.reward)
    ]
    measured(args.csv, COLUMNS, keys, partial(measure, episodes=args.episodes, settings=args.set))


if __name__ == "__main__":
    main()
