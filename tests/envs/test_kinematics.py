"""The arm's own model: against MuJoCo, against a published pose, and inverted."""

import mujoco
import numpy as np

from envs import fr3, kinematics
from envs.tasks import push


def test_forward_kinematics_is_that_of_the_mjcf(make_task) -> None:
    model = make_task("push").spec().compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for q in rng.uniform(fr3.Q_MIN, fr3.Q_MAX, (50, 7)):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        origins, axes, tip = kinematics.chain(q[None], push.TOOL_LENGTH)
        np.testing.assert_allclose(tip[0], data.site("tip").xpos, atol=1e-9)
        for i in range(7):
            link = data.body(f"link{i + 1}")
            np.testing.assert_allclose(origins[0, i], link.xpos, atol=1e-9)
            np.testing.assert_allclose(axes[0, i], link.xmat.reshape(3, 3)[:, 2], atol=1e-9)


def test_flange_of_the_straight_arm_is_where_franka_says() -> None:
    np.testing.assert_allclose(kinematics.tip_position(np.zeros((1, 7)), 0.0), [[0.088, 0, 0.926]], atol=1e-12)


def _error_mm(q: np.ndarray, target: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(kinematics.tip_position(q, push.TOOL_LENGTH) - target, axis=1).max())


def test_inverse_reaches_every_point_where_a_puck_may_be(make_task) -> None:
    task = make_task("push")
    x, y = np.meshgrid(np.linspace(push.WORKSPACE_LOW[0], task.goal_x, 15), np.linspace(-0.28, 0.28, 15))
    grid = np.stack([x.ravel(), y.ravel()], 1)
    xy = task.move(grid, np.zeros((len(grid), 2)))
    near = np.linalg.norm(grid + push.ORIGIN[:2], axis=1) < push.REACH
    np.testing.assert_allclose(xy[near], grid[near])  # beyond its reach the command itself is drawn in
    assert near.mean() > 0.9
    target = np.concatenate([xy, np.full((len(xy), 1), push.TOOL_HEIGHT)], 1) + push.ORIGIN
    q = np.repeat(task.home(), len(xy), 0)
    for _ in range(4):
        q = kinematics.inverse(q, target, push.REST, push.TOOL_LENGTH)
    assert _error_mm(q, target) < 1.0


def test_one_call_follows_the_largest_step(make_task) -> None:
    task, rng = make_task("push"), np.random.default_rng(0)
    q, xy = np.repeat(task.home(), 64, 0), np.repeat([[-0.07, 0.0]], 64, 0)
    q = task.ctrl(xy, q)
    for k in range(40):
        if k % 8 == 0:
            action = rng.choice([-1.0, 1.0], (64, 2))
        xy = task.move(xy, action)
        q = task.ctrl(xy, q)
        target = np.concatenate([xy, np.full((64, 1), push.TOOL_HEIGHT)], 1) + push.ORIGIN
        assert _error_mm(q, target) < 0.5, k
        assert ((q >= fr3.Q_MIN) & (q <= fr3.Q_MAX)).all()


def test_a_target_out_of_reach_keeps_the_joints_in_range() -> None:
    q = np.repeat(push.REST[None], 4, 0)
    far = np.array([[3.0, 0, 0], [0, 0, 3.0], [0, -3.0, 0.2], [0.0, 0.0, 0.4]])
    for _ in range(20):
        q = kinematics.inverse(q, far, push.REST, push.TOOL_LENGTH)
    assert np.isfinite(q).all() and ((q >= fr3.Q_MIN) & (q <= fr3.Q_MAX)).all()
