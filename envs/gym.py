"""Gymnasium's view of ControlEnv: one environment, or a vector of them."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict

from envs.backends.sim import SimBackend
from envs.camera import Camera
from envs.env import ControlEnv

Floats, Flags = NDArray[np.float32], NDArray[np.bool_]


class GymEnv(gymnasium.Env):
    """One ControlEnv as a `gymnasium.Env`; `info` tells `success` and `invalid` (the physics failed).

    Args:
        env: A ControlEnv of one environment.
        render_mode: None, or `rgb_array` for pictures from the task's camera (needs a simulation).

    Raises:
        ValueError: If `env` holds several environments, or cannot be drawn.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, env: ControlEnv, *, render_mode: str | None = None):
        if env.batch_size[0] != 1:
            raise ValueError(f"GymEnv takes one environment, got {env.batch_size[0]}; use GymVectorEnv")
        self.observation_space, self.action_space = _spaces(env)
        self.metadata = {**self.metadata, "render_fps": round(1 / env.task.control_dt)}
        self.env, self.render_mode, self._camera = env, render_mode, _camera(env, render_mode)
        self._seeded = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            self.env.set_seed(int(self.np_random.integers(2**31)))
            self._seeded = True
        return self.env.reset()["observation"][0].numpy(), {"success": False, "invalid": False}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        out = _step(self.env, np.asarray(action)[None])
        info = {key: bool(out[key][0, 0]) for key in ("success", "invalid")}
        terminated, truncated = (bool(out[key][0, 0]) for key in ("terminated", "truncated"))
        return out["observation"][0], float(out["reward"][0, 0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        return self._camera.picture(0) if self._camera else None

    def close(self) -> None:
        if self._camera:
            self._camera.close()


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """A ControlEnv as a `gymnasium.vector.VectorEnv`.

    Gymnasium's two ways of beginning anew are offered: with NEXT_STEP the step after the last one of an episode ignores
    its action and returns the first observation of the next, with reward 0; with SAME_STEP the last step returns it at
    once, and `infos["final_obs"]` and `infos["final_info"]` hold what the episode ended with.

    Args:
        env: A ControlEnv of any number of environments.
        autoreset_mode: NEXT_STEP or SAME_STEP.
        render_mode: None, or `rgb_array` for a tuple of pictures (needs a simulation).

    Raises:
        ValueError: If another mode is asked for, or `env` cannot be drawn.
    """

    def __init__(
        self,
        env: ControlEnv,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ):
        if autoreset_mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            raise ValueError(
                f"autoreset_mode={autoreset_mode}; allowed: AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP"
            )
        rate = round(1 / env.task.control_dt)
        self.metadata = {**GymEnv.metadata, "render_fps": rate, "autoreset_mode": autoreset_mode}
        self.num_envs, self.env, self.autoreset_mode = env.batch_size[0], env, autoreset_mode
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.render_mode, self._camera = render_mode, _camera(env, render_mode)
        self._ended, self._seeded = np.zeros(self.num_envs, bool), False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            self.env.set_seed(int(self.np_random.integers(2**31)))
            self._seeded = True
        self._ended = np.zeros(self.num_envs, bool)
        return self.env.reset()["observation"].numpy(), {}

    def step(self, actions: Floats) -> tuple[Floats, NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        out = _step(self.env, np.asarray(actions))
        observation, reward = out["observation"], out["reward"][:, 0].astype(np.float64)
        flags = {key: out[key][:, 0].copy() for key in ("terminated", "truncated", "success", "invalid")}
        infos: dict[str, Any] = {}
        begins = self._ended
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            reward[begins] = 0.0
            flags["terminated"][begins] = flags["truncated"][begins] = False
            self._ended = flags["terminated"] | flags["truncated"]
        else:
            begins = flags["terminated"] | flags["truncated"]
            for i in np.flatnonzero(begins).tolist():
                final = {key: bool(flags[key][i]) for key in ("success", "invalid")}
                infos = self._add_info(infos, {"final_obs": observation[i].copy(), "final_info": final}, i)
        flags["success"][begins] = flags["invalid"][begins] = False  # these are of the new episode
        if begins.any():
            first = self.env.reset(TensorDict({"_reset": torch.from_numpy(begins)[:, None]}, [self.num_envs]))
            observation[begins] = first["observation"].numpy()[begins]
        for i in range(self.num_envs):
            infos = self._add_info(infos, {key: bool(flags[key][i]) for key in ("success", "invalid")}, i)
        return observation, reward, flags["terminated"], flags["truncated"], infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        return tuple(self._camera.picture(i) for i in range(self.num_envs)) if self._camera else None

    def close_extras(self, **kwargs: Any) -> None:
        if self._camera:
            self._camera.close()


def _camera(env: ControlEnv, render_mode: str | None) -> Camera | None:
    if render_mode is None:
        return None
    if render_mode not in GymEnv.metadata["render_modes"] or not isinstance(env.backend, SimBackend):
        raise ValueError(f"render_mode={render_mode!r}; allowed: None, or 'rgb_array' with a simulation")
    return Camera(env.backend)


def _spaces(env: ControlEnv) -> tuple[spaces.Box, spaces.Box]:
    """Of one environment: observation and action."""
    return spaces.Box(-np.inf, np.inf, (env.obs_dim,), np.float32), spaces.Box(-1.0, 1.0, (env.action_dim,), np.float32)


def _step(env: ControlEnv, actions: Floats) -> dict[str, NDArray[Any]]:
    """What a step brought, {key: [N, ...]}."""
    action = torch.from_numpy(actions.astype(np.float32))
    out = env.step(TensorDict({"action": action}, [len(actions)]))["next"]
    return {str(key): value.numpy() for key, value in out.items()}
