"""Each task can be solved, and its rewards are the ones written down."""

import numpy as np
import pytest
import torch

from envs import fr3
from envs.tasks import push


def _successes(env, seed: int = 0) -> int:
    env.set_seed(seed)
    state = env.reset()
    for _ in range(env.task.episode_steps):
        action = env.task.scripted(state["observation"][:, : env.raw_dim].double().numpy())
        state["action"] = torch.as_tensor(action, dtype=torch.float32)
        state = env.step(state)["next"]
    assert state["truncated"].all()
    return int(state["success"].sum())


def test_the_scripted_policy_pushes_the_puck_home(make_env) -> None:
    assert _successes(make_env("push", 64)) >= 60


@pytest.mark.parametrize("randomised", [False, True])
def test_the_scripted_policy_swings_up(make_env, randomised) -> None:
    assert _successes(make_env("pendulum", 100, randomised=randomised)) >= 95


@pytest.mark.parametrize("task", ["push", "pendulum"])
def test_doing_nothing_solves_nothing(make_env, play, task) -> None:
    env = make_env(task, 16)
    assert not play(env, np.zeros((env.task.episode_steps, 16, env.action_dim)))["success"][-1].any()


def test_the_torque_is_too_weak_to_lift_the_pendulum_directly(make_env, play) -> None:
    env = make_env("pendulum", 8)
    for side in (-1.0, 1.0):
        cos = play(env, np.full((40, 8, 1), side))["observation"][:, :, 0]
        assert cos.max() < 0.7


def test_push_rewards_by_hand(make_task) -> None:
    task = make_task("push")
    seen = np.array([
        [0.065, 0.0, 0.1, 0.0],  # right behind the puck, 45 cm to go
        [0.10, 0.04, 0.165, 0.0],  # 3 cm and 4 cm from the place behind it
        [0.50, 0.0, 0.54, 0.0],  # at the goal
        [0.0, 0.0, 0.1, 0.46],  # fell
    ])  # fmt: skip
    behind = [0.0, 0.05, 0.005, np.hypot(0.065, 0.46)]
    expected = [-0.45, -0.05 - 0.385, -0.005 - 0.01 + 1, -behind[3] - 0.45 - 1]
    np.testing.assert_allclose(task.reward(seen, np.zeros((4, 2))), expected, atol=1e-12)
    assert task.success(seen).tolist() == [False, False, True, False]
    assert task.fell(seen).tolist() == [False, False, False, True]


def test_the_value_map_has_the_puck_in_the_middle_of_its_range(make_task) -> None:
    plane = make_task("push").value_plane(3)
    assert plane.marks == {"puck": pytest.approx((0.15, 0.0))} and (plane.observation[:, 2:] == [0.15, 0.0]).all()
    assert plane.observation[0, :2].tolist() == [plane.extent[0], plane.extent[2]]


def test_a_puck_that_goes_too_far_falls_where_the_table_ends(make_task) -> None:
    seen = np.array([[0.5, 0.0, 0.58, 0.0]])  # 5 mm past the goal line
    still, fell = (make_task("push", edge_x=x).reward(seen, np.zeros((1, 2))) for x in (0.75, 0.575))
    np.testing.assert_allclose(still - fell, 1.0)


def test_pendulum_rewards_by_hand(make_task) -> None:
    task = make_task("pendulum")
    seen = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 2.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(task.reward(seen, np.array([[0.0], [1.0], [0.5]])), [1.0, -0.05, 0.4975])
    assert task.success(seen).tolist() == [True, False, False]


def test_starts_are_where_the_config_says_and_touch_nothing(make_backend) -> None:
    backend = make_backend("push", 64)
    seen = backend.reset(np.arange(64))
    task = backend.task
    assert (np.abs(seen[:, :2] - [-0.07, 0.0]) < task.start_noise + 1e-3).all()
    for column, (low, high) in ((2, task.puck_x), (3, task.puck_y)):
        assert (seen[:, column] >= low).all() and (seen[:, column] <= high).all()
        assert np.ptp(seen[:, column]) > 0.7 * (high - low)
    np.testing.assert_allclose(backend.qpos[:, 9], push.ORIGIN[2] + push.PUCK_HALF_HEIGHT)


def test_the_arm_holds_still_and_follows_small_steps(make_env, play) -> None:
    env = make_env("push", 1, changes={"start_noise": 0.0})
    env.set_seed(0)
    start = env.reset()["observation"][0, :2]
    out = play(env, np.concatenate([np.zeros((5, 1, 2)), np.full((3, 1, 2), [0.2, 0.5]), np.zeros((5, 1, 2))]))
    seen = out["observation"][:, 0, :2]
    assert (seen[4] - start).abs().max() < 0.004  # dry friction in the joints leaves some millimetres
    moved = (seen[-1] - start).numpy()
    np.testing.assert_allclose(moved, [0.6 * 0.05, 1.5 * 0.05], atol=0.006)
    assert (np.abs(env.backend.samples()["force"]) <= fr3.TORQUE_MAX + 1e-9).all()


def test_the_command_stays_in_the_workspace(make_task) -> None:
    task = make_task("push")
    xy = np.zeros((4, 2))
    direction = np.array([[1.0, 1], [1, -1], [-1, 1], [1, 0]])
    for _ in range(30):
        xy = task.move(xy, direction)
    assert (xy >= push.WORKSPACE_LOW).all() and (xy <= push.WORKSPACE_HIGH).all()
    assert (np.linalg.norm(xy + push.ORIGIN[:2], axis=1) <= push.REACH + 1e-9).all()
