"""ControlEnv: one TorchRL environment for every task on every backend."""

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from envs.backends.base import Backend
from envs.task import Array


class ControlEnv(EnvBase):
    """N environments stepped together, `batch_size=[N]`.

    The observation holds what the task observes now, then the last `history` observations, then the last `history`
    actions, newest first: with a latency in the loop the present alone does not determine the future.

    Keys besides TorchRL's own: `success` (the goal holds), `action_sent` (after the interface's limits), `invalid`
    (the physics failed: the episode is truncated and the step must not be learned from).

    Args:
        backend: Where actions go.
        history: How many past observations and actions to add.
        privileged: What only a simulator knows now, [N, X]: stands under `privileged` then, for learning alone.
    """

    def __init__(self, backend: Backend, *, history: int = 0, privileged: Callable[[], Array] | None = None):
        if history < 0:
            raise ValueError(f"history={history}; it must be 0 or more")
        n = backend.num_envs
        super().__init__(device="cpu", batch_size=torch.Size([n]))
        self.backend, self.task, self.history = backend, backend.task, history
        self.raw_dim, self.action_dim = len(self.task.observation_names), self.task.action_dim
        self.obs_dim = self.raw_dim + history * (self.raw_dim + self.action_dim)
        flag = {"n": 1, "shape": torch.Size([n, 1]), "dtype": torch.bool}
        self.observation_spec = Composite(
            observation=Unbounded(torch.Size([n, self.obs_dim]), dtype=torch.float32),
            success=Binary(**flag),
            invalid=Binary(**flag),
            action_sent=Unbounded(torch.Size([n, self.action_dim]), dtype=torch.float32),
            shape=(n,),
        )
        self._privileged = privileged
        if privileged is not None:
            self.observation_spec["privileged"] = Unbounded(torch.Size(privileged().shape), dtype=torch.float32)
        self.action_spec = Bounded(-1.0, 1.0, torch.Size([n, self.action_dim]), dtype=torch.float32)
        self.reward_spec = Unbounded(torch.Size([n, 1]), dtype=torch.float32)
        self.done_spec = Composite(done=Binary(**flag), terminated=Binary(**flag), truncated=Binary(**flag), shape=(n,))
        self._clock = np.zeros(n, int)
        self._observations = np.zeros((n, history + 1, self.raw_dim))
        self._actions = np.zeros((n, history, self.action_dim))

    def _set_seed(self, seed: int | None) -> None:
        self.backend.seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        n = self.backend.num_envs
        mask = np.ones(n, bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(n).cpu().numpy()
        sims = np.flatnonzero(mask)
        if len(sims):
            self._observations[sims] = self.backend.reset(sims)[:, None]
            self._actions[sims], self._clock[sims] = 0.0, 0
        no = torch.zeros(n, 1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": self._stacked(),
                **self._known(),
                "success": no,
                "invalid": no.clone(),
                "action_sent": torch.zeros(n, self.action_dim),
                "done": no.clone(),
                "terminated": no.clone(),
                "truncated": no.clone(),
            },
            [n],
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = np.asarray(tensordict["action"].detach().cpu(), dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(action).all(1))
        if len(bad):
            raise FloatingPointError(f"action is not finite in environment {bad[0]}: {action[bad[0]]}")
        out = self.backend.send(action)
        self._clock += 1
        seen = np.where(out.invalid[:, None], self._observations[:, 0], out.observation)  # a failed state is not shown
        reward = np.where(out.invalid, 0.0, out.reward)
        for what, values in (("observation", seen), ("reward", reward[:, None])):
            if not np.isfinite(values).all():
                env, entry = np.argwhere(~np.isfinite(values))[0]
                name = f" {self.task.observation_names[entry]}" if what == "observation" else ""
                raise FloatingPointError(f"{what}{name} is not finite in environment {env}")
        self._observations = np.concatenate([seen[:, None], self._observations[:, :-1]], 1)
        if self.history:
            self._actions = np.concatenate([action[:, None], self._actions[:, :-1]], 1)
        bad = torch.from_numpy(out.invalid)[:, None]
        terminated = torch.from_numpy(out.terminated)[:, None] & ~bad
        truncated = (torch.from_numpy(self._clock >= self.task.episode_steps)[:, None] & ~terminated) | bad
        return TensorDict(
            {
                "observation": self._stacked(),
                **self._known(),
                "success": torch.from_numpy(out.success)[:, None] & ~bad,
                "invalid": bad,
                "action_sent": torch.from_numpy(out.action_sent.astype(np.float32)),
                "reward": torch.from_numpy(reward.astype(np.float32))[:, None],
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            [self.backend.num_envs],
        )

    def _known(self) -> dict[str, torch.Tensor]:
        known = {} if self._privileged is None else {"privileged": self._privileged()}
        return {name: torch.from_numpy(x.astype(np.float32)) for name, x in known.items()}

    def _stacked(self) -> torch.Tensor:
        """A fresh tensor each time: a reused one would change what was returned before."""
        flat = np.concatenate(
            [self._observations.reshape(len(self._observations), -1), self._actions.reshape(len(self._actions), -1)], 1
        )
        return torch.from_numpy(flat.astype(np.float32))
