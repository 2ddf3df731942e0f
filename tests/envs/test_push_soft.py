"""Towel and ball: they lie where they are seen, give way, and can be brought to the line in both worlds."""

import numpy as np
import pytest
import yaml

from tests.envs.conftest import CONFIGS, first_and_last, told

TASKS = ["push_towel", "push_ball"]
SHORT = {"push_towel": 0.0, "push_ball": 0.04}  # [m] before the line, where the ball is let go


def _gap(name: str) -> dict:
    return yaml.safe_load((CONFIGS / f"gap/{name}.yaml").read_text())["effects"]


def _who_knows(task, gap: dict):
    """The scripted policy of one who knows the gap, and how far the object goes on by itself."""

    def act(seen: np.ndarray) -> np.ndarray:
        line, task.goal_x = task.goal_x, task.goal_x - SHORT[task.name]
        wanted = task.scripted(seen)
        task.goal_x = line
        return told(wanted, gap)

    return act


@pytest.mark.parametrize("task", TASKS)
def test_it_can_be_pushed_home_in_both_worlds(make_backend, task) -> None:
    for gap in ({}, _gap(f"{task}_real")):
        backend = make_backend(task, 12, effects_=gap)
        _, seen = first_and_last(backend, _who_knows(backend.task, gap))
        assert backend.task.success(seen).mean() >= 0.9, gap


@pytest.mark.parametrize("task", TASKS)
def test_it_lies_where_it_is_seen(make_backend, task) -> None:
    backend = make_backend(task, 8)
    seen = backend.reset(np.arange(8))
    task_, qpos = backend.task, backend.qpos.copy()
    assert np.ptp(seen[:, 2]) > 0.1 and np.ptp(seen[:, 3]) > 0.2
    np.testing.assert_allclose(task_.observe(task_.place(seen, qpos), np.zeros(0)), seen, atol=1e-9)
    nodes = qpos[:, 7:].reshape(8, -1, 3)
    turned = np.ptp(nodes - nodes.mean(1, keepdims=True), axis=1).max(1)
    assert (turned[1:] != turned[0]).all() and nodes[:, :, 2].max() == 0, "turned about the vertical, and flat"
    held = backend.task.hold(qpos)
    for _ in range(5):
        backend.target[:] = held
        after = backend.send(np.zeros((8, 2))).observation
    np.testing.assert_allclose(after[:, 2:], seen[:, 2:], atol=4e-3)
    np.testing.assert_allclose(task_.place_of(backend.qpos)[:, 2], task_.origin[2] + task_.height, atol=6e-3)


@pytest.mark.parametrize("task", TASKS)
def test_it_gives_way_where_it_is_pushed(make_backend, task) -> None:
    backend = make_backend(task, 4)
    seen, widths = backend.reset(np.arange(4)), []
    for _ in range(backend.task.episode_steps):
        at = backend.task._nodes + backend.qpos[:, 7:].reshape(4, -1, 3)
        apart = np.linalg.norm(at[:, :, None] - at[:, None], axis=-1)
        widths.append(apart.max((1, 2)))
        seen = backend.send(backend.task.scripted(seen)).observation
    assert (np.ptp(widths, axis=0) > 5e-4).all()


def test_the_ball_rolls_on_and_the_towel_drags(make_backend) -> None:
    ahead = []
    for task in TASKS:
        backend = make_backend(task, 8)
        _, seen = first_and_last(backend, backend.task.scripted)
        ahead.append(float((seen[:, 2] - seen[:, 0]).mean()))
    assert ahead[1] > ahead[0] + 0.02


def test_gaps_name_it_as_they_name_the_puck(make_backend) -> None:
    ends = []
    for friction in (0.2, 2.0):
        backend = make_backend(
            "push_towel", 8, effects_={"contact_friction": {"coefficient": friction, "at": ["puck"]}}
        )
        _, seen = first_and_last(backend, backend.task.scripted)
        ends.append(seen[:, 2].mean())
    assert ends[0] > ends[1] + 0.005
