"""The benchmark for methods from elsewhere: tasks and gaps as Gymnasium environments, real rollouts counted.

import gymnasium
from mpc_sgft import benchmark                                 # registers the names

env = gymnasium.make("mpc_sgft/push-turned-v0", rollouts=20)   # reality: after 20 rollouts it refuses
sim = gymnasium.make("mpc_sgft/push-sim-v0")                   # the randomised simulator, as often as one likes
score = benchmark.evaluate("mpc_sgft/push-turned-v0", act)
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from envs.env import ControlEnv
from envs.gym import Floats, GymEnv
from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import Score, collect, score
from mpc_sgft.runs.pretrain import EVAL_SEED
from mpc_sgft.runs.real_rollout import begin, start_seed

EPISODES = 100  # of an evaluation, as in results/transfer
PUSH = "turned sluggish skate mild camera offset deadband tilt backlash lopsided warped"
GAPS = {  # by task and name, those that results are reported on
    "push": {gap: gap for gap in PUSH.split()},
    "push_towel": {"real": "push_towel_real"},
    "push_ball": {"real": "push_ball_real"},
    "hammer": {"real": "hammer_real"},
    "insert": {"real": "insert_real"},
    "rope_peg_in_hole": {"real": "rope_real"},
    "walker_walk": {"real": "walker_real"},
    "cheetah_run": {"real": "cheetah_real"},
}


class BudgetSpent(RuntimeError):
    """Raised by a step of a rollout beyond those that were allowed."""


class RealRollouts(GymEnv):
    """Reality of a task: a simulation with a hidden gap whose rollouts are counted, and end when they are spent.

    A rollout is spent with its first step, however early it is given up. Rollout k starts where rollout k of
    `deploy seed=...` does; `reset(seed=)` changes nothing, as in reality.

    Args:
        task, gap: Of configs/.
        rollouts: Allowed in all.
        seed: Of the starts.
        render_mode: As in `GymEnv`.

    Raises:
        ValueError: If no rollout is allowed.

    Attributes:
        spent: Rollouts so far.
    """

    def __init__(self, task: str, gap: str, *, rollouts: int = 30, seed: int = 0, render_mode: str | None = None):
        if rollouts < 1:
            raise ValueError(f"rollouts={rollouts}: at least one real rollout must be allowed.")
        super().__init__(_env(task, gap, 1), render_mode=render_mode)
        self.rollouts, self.seed, self.spent, self._stage = rollouts, seed, 0, "over"

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        gymnasium.Env.reset(self, seed=seed)
        first = begin(self.env, start_seed(self.seed, self.spent + 1)).get("observation")
        self._stage = "ready"
        return first[0].numpy(), {"success": False, "invalid": False, "spent": self.spent}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """As in Gymnasium; `info` also tells the rollouts that are `spent`.

        Raises:
            ResetNeeded: If the episode is over.
            BudgetSpent: If no rollout is left.
        """
        if self._stage == "over":
            raise ResetNeeded("This rollout is over. Call reset() before the next step.")
        if self._stage == "ready":
            if self.spent == self.rollouts:
                raise BudgetSpent(
                    f"All {self.rollouts} real rollouts are spent. Evaluate what was learned with "
                    "mpc_sgft.benchmark.evaluate, or make the environment anew with a larger rollouts=."
                )
            self.spent, self._stage = self.spent + 1, "running"
        observation, reward, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            self._stage = "over"
        return observation, reward, terminated, truncated, info | {"spent": self.spent}


def simulated(task: str, *, render_mode: str | None = None) -> GymEnv:
    """The simulator of a task, drawn and started anew each episode as in pretraining; nothing is counted."""
    return GymEnv(_env(task, "none", 1, randomised=True, learning=True), render_mode=render_mode)


def evaluate(name: str, act: Callable[[Floats], NDArray[Any]], *, episodes: int = EPISODES) -> Score:
    """Success and return in a benchmark environment, over the episodes that `deploy` is measured on; not counted.

    Args:
        name: Such as `mpc_sgft/push-turned-v0`.
        act: Observations [N, O] -> actions [N, A] in [-1, 1].
        episodes: N, all side by side.

    Raises:
        UserError: If the name is not of the benchmark.
        ValueError: If `act` gives actions of another shape.
    """
    known = gymnasium.registry.get(name)
    if known is None or not name.startswith("mpc_sgft/"):
        names = ", ".join(sorted(k for k in gymnasium.registry if k.startswith("mpc_sgft/")))
        raise UserError(f"{name!r} is no environment of the benchmark. Available: {names}.")
    gap = known.kwargs.get("gap", "none")
    env = _env(known.kwargs["task"], gap, episodes, randomised=gap == "none")

    def chosen(observation: torch.Tensor, fresh: torch.Tensor) -> torch.Tensor:
        action = np.asarray(act(observation.numpy()), np.float32)
        if action.shape != (episodes, env.action_dim):
            raise ValueError(f"act gave actions of shape {action.shape}; wanted is {(episodes, env.action_dim)}.")
        return torch.from_numpy(np.clip(action, -1.0, 1.0))

    return score(collect(env, chosen, seed=EVAL_SEED))


def _env(task: str, gap: str, num_envs: int, *, randomised: bool = False, learning: bool = False) -> ControlEnv:
    words = [f"task={task}", f"gap={gap}", f"randomize={task if randomised else 'none'}"]
    return build.make_env(compose("evaluate", words, []), num_envs, randomised=randomised, learning=learning)


def _register() -> None:
    for task, gaps in GAPS.items():
        ours = f"{__name__}:"
        gymnasium.register(id=f"mpc_sgft/{task}-sim-v0", entry_point=f"{ours}simulated", kwargs={"task": task})
        for name, gap in gaps.items():
            kwargs = {"task": task, "gap": gap}
            id_ = f"mpc_sgft/{task}-{name}-v0"  # a seed alone does not repeat a start: the count of rollouts does, too
            gymnasium.register(id=id_, entry_point=f"{ours}RealRollouts", nondeterministic=True, kwargs=kwargs)


_register()
