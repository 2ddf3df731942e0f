"""ControlEnv keeps TorchRL's contract: specs, seeds, partial resets, fresh tensors, how an episode ends."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

TASKS = "push pendulum hammer insert rope_peg_in_hole push_towel push_ball walker_walk cheetah_run".split()


def _shape(env, steps):
    return steps, env.batch_size[0], env.action_dim


@pytest.mark.parametrize("task", TASKS)
def test_specs_hold(make_env, task) -> None:
    check_env_specs(make_env(task, 3, history=2, randomised=True))


def test_specs_hold_for_joint_control(make_env) -> None:
    env = make_env("push", 2, changes={"control": "joint"})
    assert env.action_dim == 3
    check_env_specs(env)


@pytest.mark.parametrize("task", TASKS)
def test_same_seed_same_numbers_and_another_seed_others(make_env, play, random_actions, task) -> None:
    env = make_env(task, 4, randomised=True, noise_sd=0.004, noise_probability=0.5, history=1)
    actions = random_actions(*_shape(env, 12))
    first, again, other = play(env, actions, 7), play(env, actions, 7), play(env, actions, 8)
    fresh = play(make_env(task, 4, randomised=True, noise_sd=0.004, noise_probability=0.5, history=1), actions, 7)
    for key in first:
        assert torch.equal(first[key], again[key]), key
        assert torch.equal(first[key], fresh[key]), key
    assert not torch.equal(first["observation"], other["observation"])


def test_threads_do_not_change_the_numbers(make_env, play, random_actions) -> None:
    one, three = (make_env("push", 5, randomised=True, threads=n) for n in (1, 3))
    actions = random_actions(*_shape(one, 10))
    first, second = play(one, actions), play(three, actions)
    assert torch.equal(first["observation"], second["observation"])
    assert torch.equal(first["reward"], second["reward"])


def test_an_episode_does_not_depend_on_its_neighbours(make_env, play, random_actions) -> None:
    gap = {"sensor_noise": {"sd": 0.01}}
    few, many = (make_env("push", n, randomised=True, effects_=gap) for n in (2, 4))
    actions = random_actions(*_shape(many, 8))
    assert torch.equal(play(few, actions[:, :2])["observation"], play(many, actions)["observation"][:, :2])


@pytest.mark.parametrize("task", TASKS)
def test_a_partial_reset_leaves_the_others_bitwise_alone(make_env, random_actions, task) -> None:
    gap = {"sensor_delay": {"delay": 0.1}, "sensor_noise": {"sd": 0.01}, "actuator_delay": {"delay": 0.1}}
    left, right = (make_env(task, 4, randomised=True, effects_=gap, history=2) for _ in range(2))
    actions = random_actions(*_shape(left, 10))
    states = []
    for env in (left, right):
        env.set_seed(3)
        states.append(env.reset())
    mask = torch.tensor([[False], [True], [False], [True]])
    keep = ~mask[:, 0]
    for k, action in enumerate(actions):
        if k == 5:
            before = left.backend.batch.state.copy()
            states[0] = left.reset(states[0].clone().set("_reset", mask))
            assert np.array_equal(before[keep.numpy()], left.backend.batch.state[keep.numpy()])
            assert torch.equal(states[0]["observation"][keep], states[1]["observation"][keep])
            assert not torch.equal(states[0]["observation"][~keep], states[1]["observation"][~keep])
        for i, env in enumerate((left, right)):
            states[i]["action"] = torch.as_tensor(action, dtype=torch.float32)
            states[i] = env.step(states[i])["next"]
        assert torch.equal(states[0]["observation"][keep], states[1]["observation"][keep]), k
        assert torch.equal(states[0]["reward"][keep], states[1]["reward"][keep]), k
    assert np.array_equal(left._clock, [10, 5, 10, 5])


def test_a_reset_of_nobody_changes_nothing(make_env) -> None:
    env = make_env("pendulum", 2)
    env.reset()
    before = env.backend.batch.state.copy()
    env._reset(TensorDict({"_reset": torch.zeros(2, 1, dtype=torch.bool)}, [2]))
    assert np.array_equal(before, env.backend.batch.state)


def test_the_clock_truncates_and_the_task_terminates(make_env, play, monkeypatch) -> None:
    env = make_env("pendulum", 2, changes={"episode_steps": 3})
    still = np.zeros((3, 2, 1))
    out = play(env, still)
    assert out["truncated"][:, :, 0].tolist() == [[False, False], [False, False], [True, True]]
    assert not out["terminated"].any() and torch.equal(out["done"], out["truncated"])

    ends = iter([[False, False], [True, False], [True, False]])
    monkeypatch.setattr(env.task, "terminated", lambda observation: np.array(next(ends)))
    out = play(env, still)
    assert out["terminated"][:, :, 0].tolist() == [[False, False], [True, False], [True, False]]
    assert out["truncated"][:, :, 0].tolist() == [[False, False], [False, False], [False, True]]  # never both
    assert torch.equal(out["done"], out["terminated"] | out["truncated"])


def test_what_was_returned_never_changes(make_env, random_actions) -> None:
    env = make_env("pendulum", 2, history=2)
    state, kept = env.reset(), []
    for action in random_actions(4, 2, 1):
        state["action"] = torch.as_tensor(action, dtype=torch.float32)
        state = env.step(state)["next"]
        kept.append((state, state.clone()))
    env.reset()
    for now, then in kept:
        for key in ("observation", "reward", "success", "action_sent", "truncated", "done"):
            assert torch.equal(now[key], then[key]), key


def test_history_is_stacked_newest_first(make_env, play) -> None:
    plain, stacked = make_env("pendulum", 1), make_env("pendulum", 1, history=2)
    actions = np.array([0.1, -0.2, 0.3, 0.4])[:, None, None]
    plain.set_seed(0)
    start = plain.reset()["observation"][0]
    o = [start, *play(plain, actions)["observation"][:, 0]]
    a = torch.tensor([0.1, -0.2, 0.3, 0.4])[:, None]
    none = torch.zeros(1)
    stacked.set_seed(0)
    assert torch.equal(stacked.reset()["observation"][0], torch.cat([o[0], o[0], o[0], none, none]))
    out = play(stacked, actions)["observation"][:, 0]
    assert torch.equal(out[0], torch.cat([o[1], o[0], o[0], a[0], none]))
    assert torch.equal(out[1], torch.cat([o[2], o[1], o[0], a[1], a[0]]))
    assert torch.equal(out[3], torch.cat([o[4], o[3], o[2], a[3], a[2]]))


def test_actions_are_limited_and_what_was_sent_is_told(make_env, play) -> None:
    env = make_env("pendulum", 1)
    loud, limit = play(env, np.full((3, 1, 1), 5.0)), play(env, np.ones((3, 1, 1)))
    assert torch.equal(loud["observation"], limit["observation"])
    assert (loud["action_sent"] == 1).all()


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_an_action_that_is_no_number_stops_with_its_environment(make_env, wrong) -> None:
    env = make_env("pendulum", 3)
    state = env.reset()
    state["action"] = torch.tensor([[0.0], [wrong], [0.0]])
    with pytest.raises(FloatingPointError, match="environment 1"):
        env.step(state)


def test_numbers_that_make_no_sense_are_refused(make_env, make_task) -> None:
    with pytest.raises(ValueError, match="history=-1"):
        make_env("pendulum", 1, history=-1)
    with pytest.raises(ValueError, match="control_dt=0.1 s is not a whole number of sim_dt=0.003 s"):
        make_task("pendulum", sim_dt=0.003)
    with pytest.raises(ValueError, match="allowed: cartesian, joint"):
        make_task("push", control="torque")
    with pytest.raises(ValueError, match="allowed: down, anywhere"):
        make_task("pendulum", start="up")
