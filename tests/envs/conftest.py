"""Worlds to test, built from the numbers in configs/."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml

from envs import effects, randomize
from envs.backends.sim import SimBackend
from envs.env import ControlEnv

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def read(group: str, name: str) -> dict[str, Any]:
    """The numbers of configs/<group>/<name>.yaml and of the files that its defaults list names."""
    own = yaml.safe_load((CONFIGS / group / f"{name}.yaml").read_text())
    told: dict[str, Any] = {}
    for each in (*(read(group, parent) for parent in own.pop("defaults", []) if parent != "_self_"), own):
        told |= {key: told[key] | new if isinstance(new, dict) and key in told else new for key, new in each.items()}
    return told


@pytest.fixture
def make_task() -> Callable[..., Any]:
    """make_task(name, **changes): a task with the numbers of configs/task/<name>.yaml."""

    def make(name: str, **changes: Any) -> Any:
        numbers = read("task", name)["env"] | changes
        module, kind = numbers.pop("_target_").rsplit(".", 1)
        return getattr(importlib.import_module(module), kind)(**numbers)

    return make


@pytest.fixture
def build() -> Callable[..., mujoco.MjModel]:
    """build(xml, gap): the scene with the effects of a gap; an MjSpec is taken as well, and not changed."""

    def make(scene: str | mujoco.MjSpec, gap: dict[str, Any] | None = None) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_string(scene) if isinstance(scene, str) else scene.copy()
        for effect in effects.load(gap or {}):
            effect.edit_spec(spec)
        return spec.compile()

    return make


@pytest.fixture
def simulate() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """simulate(model, ctrl [T, nu], qpos, qvel): positions [T, nq] and speeds [T, nv] after each step of ctrl."""

    def run(model: mujoco.MjModel, ctrl: np.ndarray, qpos: Any = None, qvel: Any = None):
        data, moved = mujoco.MjData(model), []
        data.qpos[: len(qpos if qpos is not None else [])] = [] if qpos is None else qpos
        data.qvel[: len(qvel if qvel is not None else [])] = [] if qvel is None else qvel
        effects.place_rotors(model, data.qpos, data.qvel)
        for signal in ctrl:
            data.ctrl[:] = signal
            mujoco.mj_step(model, data)
            moved.append((data.qpos.copy(), data.qvel.copy()))
        return np.array([m[0] for m in moved]), np.array([m[1] for m in moved])

    return run


@pytest.fixture
def make_backend(make_task) -> Callable[..., SimBackend]:
    """make_backend(task, num_envs, effects={}, draws={}, randomised=False, task_changes={}, **SimBackend's own)."""

    def make(task, num_envs=1, *, effects_=None, draws=None, randomised=False, changes=None, **kwargs: Any):
        if randomised:
            table = read("randomize", task)
            draws = table["draws"]
            kwargs = {"noise_sd": table["noise_sd"], "noise_probability": table["noise_probability"], **kwargs}
        return SimBackend(
            make_task(task, **(changes or {})),
            num_envs,
            effects=effects.load(effects_ or {}),
            draws=randomize.load(draws or {}),
            **kwargs,
        )

    return make


def first_and_last(backend: SimBackend, policy: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """What is observed at the start and at the end of an episode, [N, O] each."""
    backend.seed(0)
    first = seen = backend.reset(np.arange(backend.num_envs))
    for _ in range(backend.task.episode_steps):
        seen = backend.send(policy(seen)).observation
    return first, seen


def told(wanted: np.ndarray, gap: dict[str, Any]) -> np.ndarray:
    """Commands of which a machine with these effects makes what is wanted, as far as their limits allow, [N, A]."""
    angle = gap.get("frame_rotation", {"angle": 0.0})["angle"]
    c, s = np.cos(angle), np.sin(angle)
    if angle:
        wanted = wanted @ np.array([[c, -s], [s, c]])
    if "directional_gain" in gap:
        wanted = wanted / np.where(wanted > 0, gap["directional_gain"]["positive"], gap["directional_gain"]["negative"])
    wanted = wanted / gap.get("actuator_gain", {"gain": 1.0})["gain"]
    wanted = wanted - np.array(gap.get("actuator_offset", {"offset": 0.0})["offset"])
    return wanted / np.maximum(1, np.abs(wanted).max(1, keepdims=True))


@pytest.fixture
def make_env(make_backend) -> Callable[..., ControlEnv]:
    """make_env(task, num_envs, history=0, **as make_backend): a ControlEnv."""

    def make(*args: Any, history: int = 0, **kwargs: Any) -> ControlEnv:
        return ControlEnv(make_backend(*args, **kwargs), history=history)

    return make


@pytest.fixture
def play() -> Callable[..., dict[str, torch.Tensor]]:
    """play(env, actions [T, N, A], seed): what a fresh episode returned, {key: [T, N, ...]}."""

    def run(env: ControlEnv, actions: np.ndarray, seed: int = 0) -> dict[str, torch.Tensor]:
        env.set_seed(seed)
        state, rows = env.reset(), []
        for action in actions:
            state["action"] = torch.as_tensor(action, dtype=torch.float32)
            state = env.step(state)["next"]
            rows.append(dict(state.items()))
        return {key: torch.stack([row[key] for row in rows]) for key in rows[0]}

    return run


@pytest.fixture
def random_actions() -> Callable[..., np.ndarray]:
    """random_actions(T, N, A, seed): uniform in [-1, 1]."""
    return lambda *shape, seed=0: np.random.default_rng(seed).uniform(-1, 1, shape)


@pytest.fixture
def empty_folder(tmp_path, monkeypatch) -> Path:
    """Work in an empty folder: MuJoCo writes its warnings to MUJOCO_LOG.TXT where it stands."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
