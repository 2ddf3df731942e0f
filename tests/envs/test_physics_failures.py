"""A physics failure ends its episode, is counted and logged once, and touches nobody else."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict


def _break(env, i: int, how: str) -> None:
    value = {"nan": np.nan, "inf": np.inf, "huge": 1e12}[how]
    env.backend.qvel[i, 0] = value


@pytest.mark.parametrize("gap", [{}, {"state_torque": {"rate": 0.1}}], ids=["whole period", "step by step"])
@pytest.mark.parametrize("how", ["nan", "inf", "huge"])
@pytest.mark.parametrize("at", [0, 2], ids=["first step", "later"])
def test_an_unstable_environment_is_invalid_and_alone(make_env, empty_folder, caplog, gap, how, at) -> None:
    broken, whole = (make_env("pendulum", 3, effects_=gap, history=1) for _ in range(2))
    states = []
    for env in (broken, whole):
        env.set_seed(0)
        states.append(env.reset())
    others = [0, 2]
    for k in range(5):
        if k == at:
            _break(broken, 1, how)
        for i, env in enumerate((broken, whole)):
            states[i]["action"] = torch.full((3, 1), 0.5)
            states[i] = env.step(states[i])["next"]
        failed = k >= at  # until it is reset
        assert states[0]["invalid"][:, 0].tolist() == [False, failed, False]
        assert states[0]["truncated"][:, 0].tolist() == [False, failed, False]
        assert states[0]["done"][:, 0].tolist() == [False, failed, False]
        assert not states[0]["terminated"].any() and not states[0]["success"][1]
        for key in ("observation", "reward"):
            assert torch.isfinite(states[0][key]).all()
            assert torch.equal(states[0][key][others], states[1][key][others]), (k, key)
    assert broken.backend.counters["unstable"] == 1
    assert [r.message for r in caplog.records if "unstable" in r.message] == [
        "environment 1: physics unstable (BADQVEL); the episode ends and the step is dropped"
    ]
    assert whole.backend.counters["unstable"] == 0

    mask = torch.tensor([[False], [True], [False]])
    state = broken.reset(states[0].clone().set("_reset", mask))
    for _ in range(3):
        state["action"] = torch.full((3, 1), 0.5)
        state = broken.step(state)["next"]
        assert not state["invalid"].any() and torch.isfinite(state["observation"]).all()
    assert broken.backend.counters["unstable"] == 1


def test_the_episode_after_a_failure_is_like_any_other(make_env, play, random_actions, empty_folder) -> None:
    failed, whole = (make_env("push", 2, randomised=True) for _ in range(2))
    actions = random_actions(3, 2, 2)
    state = failed.reset()
    _break(failed, 0, "nan")
    state["action"] = torch.zeros(2, 2)
    assert failed.step(state)["next"]["invalid"][:, 0].tolist() == [True, False]
    assert torch.equal(play(failed, actions, 5)["observation"], play(whole, actions, 5)["observation"])


@pytest.mark.parametrize("task", ["push", "pendulum", "walker_walk", "cheetah_run"])
def test_random_episodes_stay_stable(make_env, random_actions, task) -> None:
    env = make_env(task, 16, randomised=True, history=1)
    env.set_seed(0)
    state = env.reset()
    for action in random_actions(env.task.episode_steps, 16, env.action_dim):
        state["action"] = torch.as_tensor(action, dtype=torch.float32)
        state = env.step(state)["next"]
        assert not state["invalid"].any()
        assert torch.isfinite(state["observation"]).all() and torch.isfinite(state["reward"]).all()
    assert state["truncated"].all() and env.backend.counters["unstable"] == 0


def test_step_and_maybe_reset_drops_the_failed_episode(make_env, empty_folder) -> None:
    env = make_env("pendulum", 2)
    state = env.reset()
    _break(env, 1, "nan")
    state["action"] = torch.zeros(2, 1)
    row, following = env.step_and_maybe_reset(state)
    assert row["next", "invalid"][:, 0].tolist() == [False, True]
    assert isinstance(following, TensorDict) and env._clock.tolist() == [1, 0]
    following["action"] = torch.zeros(2, 1)
    assert not env.step(following)["next"]["invalid"].any()
