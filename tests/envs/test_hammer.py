"""The nail gives way to blows and not to pressure, in the simulator and in its reality."""

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import yaml

from envs.tasks.hammer import HIGH, LOW
from tests.envs.conftest import CONFIGS, first_and_last

Policy = Callable[[np.ndarray], np.ndarray]


def _left(backend, policy: Policy) -> np.ndarray:
    """How far each nail still is from its goal after an episode, [N] m; the board may not have moved."""
    first, seen = first_and_last(backend, policy)
    np.testing.assert_allclose(seen[:, 10:], first[:, 10:], atol=1e-4)
    return seen[:, 9] - seen[:, 11]


def test_blows_drive_the_nail(make_backend) -> None:
    backend = make_backend("hammer", 32)
    left = _left(backend, backend.task.scripted)
    assert (np.abs(left) < 0.005).mean() >= 0.95
    assert left.min() > -0.002, "the board stops its head"


def test_pressure_and_chance_do_not(make_backend) -> None:
    backend, rng = make_backend("hammer", 16), np.random.default_rng(0)
    task = backend.task

    def press(seen: np.ndarray) -> np.ndarray:
        step = task._reach(seen[:, 3:6], seen[:, [10, 9]] - [0.0, 0.1]) - seen[:, 3:6]
        return step / np.maximum(np.abs(step).max(1, keepdims=True), task.joint_step)

    for policy, least in ((press, 0.015), (lambda s: rng.uniform(-1, 1, (len(s), 3)), 0.005)):
        assert np.median(_left(backend, policy)) > least
    assert np.ptp(_left(backend, lambda s: np.zeros((len(s), 3)))) < 2e-4, "friction holds it"


def test_the_real_one_can_be_done_by_who_knows_it_and_not_by_who_does_not(make_backend) -> None:
    gap = yaml.safe_load((CONFIGS / "gap/hammer_real.yaml").read_text())["effects"]
    for aim, right in ((0.06, 0.0), (0.12, 1.0)):  # harder
        backend = make_backend("hammer", 16, effects_=gap, changes={"aim": aim})
        assert (np.abs(_left(backend, backend.task.scripted)) < 0.005).mean() == pytest.approx(right, abs=0.1)


def test_rewards_by_hand(make_task) -> None:
    task = make_task("hammer")
    seen = np.zeros((3, 12))
    seen[:, 9], seen[:, 11] = [0.60, 0.574, 0.57], 0.57
    np.testing.assert_allclose(task.reward(seen, np.zeros((3, 3))), [-0.3, -0.04, 0.0], atol=1e-12)
    assert task.success(seen).tolist() == [False, True, True]


def test_a_state_is_seen_and_placed_again(make_backend) -> None:
    backend = make_backend("hammer", 8)
    seen = backend.reset(np.arange(8))
    task, qpos = backend.task, backend.qpos.copy()
    assert (np.ptp(seen[:, 10]) > 0.03) and ((seen[:, 10] >= 0.3) & (seen[:, 10] <= 0.4)).all()
    np.testing.assert_allclose(seen[:, 9] - seen[:, 11], task.depth, atol=1e-6)
    np.testing.assert_allclose(task.place(seen, qpos), qpos, atol=1e-9)
    np.testing.assert_allclose(task.ctrl(task.hold(qpos), qpos[:, :7])[:, [1, 3, 5]], qpos[:, [1, 3, 5]])


def test_the_face_is_where_the_scene_has_it(make_task) -> None:
    task = make_task("hammer")
    model = task.spec().compile()
    data = mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(LOW, HIGH, (5, 3)):
        data.qpos[:7] = task._arm(q[None])[0]
        mujoco.mj_forward(model, data)
        down = data.body("link7").xmat.reshape(3, 3)[:, 2]
        face = data.geom("head").xpos + model.geom("head").size[1] * down
        np.testing.assert_allclose(task._face(q[None])[0], face[[0, 2]], atol=1e-6)
