"""The leg goes into the hole and nowhere else, in the simulator and in its reality."""

import numpy as np
import yaml

from tests.envs.conftest import CONFIGS, first_and_last


def test_the_leg_goes_in(make_backend) -> None:
    backend = make_backend("insert", 32)
    _, seen = first_and_last(backend, backend.task.scripted)
    assert backend.task.success(seen).mean() >= 0.95
    assert (seen[:, 5] - seen[:, 8]).min() > -0.001, "the hole has a floor"


def test_beside_the_hole_is_the_table(make_backend) -> None:
    backend = make_backend("insert", 16)
    task = backend.task

    def aside(seen: np.ndarray) -> np.ndarray:
        return task.scripted(seen + np.r_[np.zeros(6), 0.02, 0.0, 0.0])

    _, seen = first_and_last(backend, aside)
    assert not task.success(seen).any() and (seen[:, 5] > 0.095).all()


def test_the_real_one_can_be_done_by_who_knows_the_drift_and_where_the_hole_is(make_backend) -> None:
    gap = yaml.safe_load((CONFIGS / "gap/insert_real.yaml").read_text())["effects"]
    wrong = np.zeros(9)
    wrong[[6, 7]] = gap["sensor_offset"]["offset"]
    rates, drift = [], np.array(gap["actuator_offset"]["offset"])
    for known in (0.0, 1.0):
        backend = make_backend("insert", 32, effects_=gap)

        def act(s: np.ndarray, known: float = known, task=backend.task) -> np.ndarray:
            return task.scripted(s - known * wrong) - known * drift

        _, seen = first_and_last(backend, act)
        rates.append(float(backend.task.success(seen - wrong).mean()))
    assert rates[0] < 0.5 and rates[1] > 0.85, rates


def test_rewards_by_hand(make_task) -> None:
    task = make_task("insert")
    seen = np.zeros((3, 9))
    seen[:, 3:6] = [[0.0, 0.0, 0.0], [0.009, 0.0, -0.009], [0.02, 0.5, 0.0]]
    np.testing.assert_allclose(
        task.reward(seen, np.zeros((3, 3))), [1.0, 1 - 100 * 2 * 0.009**2, -100 * (0.02**2 + 0.1**2)], atol=1e-12
    )
    assert task.success(seen).tolist() == [True, True, False]


def test_a_state_is_seen_and_placed_again(make_backend) -> None:
    backend = make_backend("insert", 8)
    seen = backend.reset(np.arange(8))
    task, qpos = backend.task, backend.qpos.copy()
    assert np.ptp(seen[:, 6]) > 0.04 and (np.abs(seen[:, 7]) <= 0.05).all()
    np.testing.assert_allclose(seen[:, 2] - seen[:, 5], 0.08, atol=1e-3)  # the leg hangs down
    np.testing.assert_allclose(task.place(seen, qpos), qpos, atol=1e-9)
    np.testing.assert_allclose(task.hold(qpos), seen[:, 3:6], atol=1e-9)
