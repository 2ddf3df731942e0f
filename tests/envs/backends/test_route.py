"""From anywhere on the table to the start and down: inside the limits all the way, at rest at both ends."""

import numpy as np
import pytest
import yaml

from envs.backends.limits import Limits
from envs.backends.route import reset_route
from envs.backends.safety import Gate, NotSafe
from envs.kinematics import inverse, tip_position
from envs.tasks.push import Push
from mpc_sgft.command.choices import CONFIG_DIR


def test_every_way_to_the_start_is_allowed(robot_push: Push, robot_config: dict) -> None:
    task, rng = robot_push, np.random.default_rng(0)
    gate = Gate(Limits(**robot_config["limits"]), tool_length=task.arm.tool_length, sample_dt=0.008)
    way = {"safe_tip": np.array(robot_config["safe_tip"]), "rest": task.arm.rest, "tool_length": task.arm.tool_length}
    for _ in range(20):
        here = task.home()
        goal = np.array([[rng.uniform(-0.07, 0.5), rng.uniform(-0.28, 0.28)]])
        for share in np.linspace(0, 1, 12):
            xy = task.move(goal * share + (1 - share) * np.array([[-0.07, 0.0]]), np.zeros((1, 2)))
            here = inverse(here, np.c_[xy, [[0.012]]] + task.origin, task.arm.rest, task.arm.tool_length)
        start = task.start(rng).qpos[0, :7]
        away, down = reset_route(here[0], start, speed=robot_config["reset_speed"], sample_dt=0.008, **way)
        gate.route(away)
        gate.route(down)
        np.testing.assert_allclose(away[0], here[0])
        np.testing.assert_allclose(down[-1], start)
        np.testing.assert_allclose(away[-1], down[0])
        np.testing.assert_allclose(tip_position(down[:1], task.arm.tool_length)[0], robot_config["safe_tip"], atol=2e-3)
        assert np.abs(down[1] - down[0]).max() < 1e-4 and np.abs(down[-1] - down[-2]).max() < 1e-4


def test_an_arm_that_sagged_out_of_the_box_may_return_but_not_leave_again(robot_push: Push, robot_config: dict) -> None:
    task, limits = robot_push, Limits(**robot_config["limits"])
    gate = Gate(limits, tool_length=task.arm.tool_length, sample_dt=0.008)
    way = {"safe_tip": np.array(robot_config["safe_tip"]), "rest": task.arm.rest, "tool_length": task.arm.tool_length}
    above = inverse(task.home(), np.array([[0.72, 0.2, limits.low[2] + 0.02]]), task.arm.rest, task.arm.tool_length)

    def away(depth: float) -> np.ndarray:
        sagged, tip = above, np.array([[0.72, 0.2, limits.low[2] - depth]])
        for _ in range(5):
            sagged = inverse(sagged, tip, task.arm.rest, task.arm.tool_length)
        np.testing.assert_allclose(tip_position(sagged, task.arm.tool_length), tip, atol=5e-4)
        return reset_route(sagged[0], task.home()[0], speed=robot_config["reset_speed"], sample_dt=0.008, **way)[0]

    for depth in (0.0005, 0.005, 0.025):
        gate.route(away(depth))
    with pytest.raises(NotSafe, match="workspace box"):
        gate.route(away(0.035))
    with pytest.raises(NotSafe, match="workspace box"):
        gate.route(away(0.005)[::-1])  # the same way, outwards
    with pytest.raises(NotSafe, match="already outside"):
        gate.step(away(0.005)[:1], away(0.005)[:1], 25)  # an action never starts out there


def test_the_nominal_scene_would_be_refused_on_a_robot() -> None:
    settings = yaml.safe_load((CONFIG_DIR / "task" / "push.yaml").read_text())["env"]
    settings.pop("_target_")
    folded = Push(**settings).home()
    assert (folded[:, 3] < -3.0421 + 0.1).any()  # why on_robot moves the table
