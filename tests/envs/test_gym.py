"""The thin adapters do what Gymnasium documents."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from envs.gym import GymEnv, GymVectorEnv

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("task", ["push", "pendulum", "walker_walk", "cheetah_run"])
def test_gymnasium_checks_the_environment(make_env, task) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(GymEnv(make_env(task, 1, randomised=True, history=2)))
    unexpected = [
        str(w.message)
        for w in caught
        if issubclass(w.category, UserWarning)
        and "infinity" not in str(w.message)
        and "having a spec" not in str(w.message)
    ]
    assert not unexpected


def test_an_episode_in_gymnasium_is_the_same_episode(make_env) -> None:
    wrapped, plain = GymEnv(make_env("pendulum", 1)), make_env("pendulum", 1)
    first, info = wrapped.reset(seed=3)
    assert info == {"success": False, "invalid": False}
    plain.set_seed(int(np.random.default_rng(3).integers(2**31)))
    state = plain.reset()
    np.testing.assert_array_equal(first, state["observation"][0].numpy())
    for k in range(40):
        action = np.array([np.sin(k)], np.float32)
        seen, reward, terminated, truncated, info = wrapped.step(action)
        state["action"] = state["observation"].new_tensor(action)[None]
        state = plain.step(state)["next"]
        np.testing.assert_array_equal(seen, state["observation"][0].numpy())
        assert reward == state["reward"].item() and isinstance(reward, float)
        assert (terminated, truncated) == (False, k == 39)
        assert info["success"] == state["success"].item()


def test_resets_without_a_seed_go_on_and_differ(make_env) -> None:
    env = GymEnv(make_env("push", 1))
    a, b = env.reset(seed=1)[0], env.reset()[0]
    assert not np.array_equal(a, b)
    np.testing.assert_array_equal(env.reset(seed=1)[0], a)
    np.testing.assert_array_equal(env.reset()[0], b)
    assert not np.array_equal(GymEnv(make_env("push", 1)).reset()[0], GymEnv(make_env("push", 1)).reset()[0])


def _vector(make_env, mode, n=3, steps=3):
    env = GymVectorEnv(make_env("pendulum", n, history=1, changes={"episode_steps": steps}), autoreset_mode=mode)
    first, infos = env.reset(seed=0)
    assert infos == {} and env.observation_space.contains(first)
    return env, first


def _act(env, value=0.5):
    return np.full(env.action_space.shape, value, np.float32)


def test_vector_spaces_and_metadata(make_env) -> None:
    env, _ = _vector(make_env, AutoresetMode.NEXT_STEP)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP and env.metadata["render_fps"] == 10
    assert env.num_envs == 3 and env.single_observation_space.shape == (7,) and env.observation_space.shape == (3, 7)
    assert env.single_action_space.shape == (1,) and env.action_space.shape == (3, 1)
    seen, reward, terminated, truncated, infos = env.step(env.action_space.sample())
    assert env.observation_space.contains(seen)
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    assert reward.dtype == np.float64 and terminated.dtype == truncated.dtype == bool
    assert infos["success"].shape == (3,) and infos["_success"].all()
    env.close()


def test_next_step_autoreset_ignores_one_action(make_env) -> None:
    env, first = _vector(make_env, AutoresetMode.NEXT_STEP)
    for _ in range(2):
        assert not env.step(_act(env))[3].any()
    last, reward, _, truncated, infos = env.step(_act(env))
    assert truncated.all() and "final_obs" not in infos
    begin, reward, terminated, truncated, infos = env.step(_act(env, 1.0))
    assert (reward == 0).all() and not terminated.any() and not truncated.any() and not infos["success"].any()
    assert not np.array_equal(begin, last) and not np.array_equal(begin, first)
    assert (begin[:, 6] == 0).all()  # no past action yet
    for k in range(3):
        seen, _, _, truncated, _ = env.step(_act(env))
        assert (seen[:, 6] == 0.5).all() and truncated.all() == (k == 2)


def test_same_step_autoreset_keeps_the_final_observation(make_env) -> None:
    same, first = _vector(make_env, AutoresetMode.SAME_STEP)
    following, _ = _vector(make_env, AutoresetMode.NEXT_STEP)
    for _ in range(2):
        np.testing.assert_array_equal(same.step(_act(same))[0], following.step(_act(following))[0])
    begin, reward, _, truncated, infos = same.step(_act(same))
    last, last_reward, *_ = following.step(_act(following))
    assert truncated.all() and infos["_final_obs"].all() and infos["_final_info"].all()
    np.testing.assert_array_equal(np.stack(list(infos["final_obs"])), last)
    np.testing.assert_array_equal(reward, last_reward)
    assert infos["final_info"]["success"].shape == (3,)
    np.testing.assert_array_equal(begin, following.step(_act(following))[0])


def test_only_the_failed_environment_begins_anew(make_env, empty_folder) -> None:
    env, _ = _vector(make_env, AutoresetMode.SAME_STEP, steps=10)
    env.env.backend.qvel[1, 0] = np.nan
    seen, _, terminated, truncated, infos = env.step(_act(env))
    assert truncated.tolist() == [False, True, False] and not terminated.any()
    assert infos["_final_obs"].tolist() == [False, True, False] and infos["final_info"]["invalid"].tolist() == [
        False,
        True,
        False,
    ]
    assert infos["final_obs"][0] is None and not infos["invalid"].any()
    assert seen[1, 6] == 0 and (seen[[0, 2], 6] == 0.5).all()
    assert env.env.backend.counters["unstable"] == 1


def test_what_the_adapters_refuse(make_env) -> None:
    with pytest.raises(ValueError, match="takes one environment, got 2"):
        GymEnv(make_env("pendulum", 2))
    with pytest.raises(ValueError, match="allowed: AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP"):
        GymVectorEnv(make_env("pendulum", 2), autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(ValueError, match="render_mode='human'; allowed: None, or 'rgb_array'"):
        GymEnv(make_env("pendulum", 1), render_mode="human")


PICTURE = """
import numpy as np
from envs.backends.sim import SimBackend
from envs.env import ControlEnv
from envs.gym import GymEnv, GymVectorEnv
from envs.tasks.pendulum import Pendulum

def make(n):
    task = Pendulum(episode_steps=40, control_dt=0.1, sim_dt=0.01, max_torque=6.0, start="down")
    return ControlEnv(SimBackend(task, n))

env = GymEnv(make(1), render_mode="rgb_array")
env.reset(seed=0)
before = env.render()
for _ in range(8):
    env.step(np.ones(1, np.float32))
after = env.render()
assert before.shape == after.shape == (240, 320, 3) and before.dtype == np.uint8, before.shape
assert np.ptp(before) > 100 and (before != after).mean() > 0.001
env.close()
env.close()
many = GymVectorEnv(make(2), render_mode="rgb_array")
many.reset(seed=0)
pictures = many.render()
assert len(pictures) == 2 and (pictures[0] != pictures[1]).any()
many.close()
"""


def test_pictures_move_with_the_simulation(mujoco_gl, tmp_path) -> None:
    env = {**os.environ, "MUJOCO_GL": mujoco_gl, "PYTHONPATH": str(ROOT)}
    line = [sys.executable, "-W", "ignore", "-c", PICTURE]
    done = subprocess.run(line, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
