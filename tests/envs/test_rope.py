"""The peg swings on its rope, is pulled and never pushed, and goes into the hole, whose rim it cannot pass."""

import numpy as np
import pytest
import yaml

from envs.tasks.rope import BEADS, TOP
from tests.envs.conftest import CONFIGS, first_and_last


def _strings(backend) -> np.ndarray:
    """Lengths [N, BEADS + 1] m between the ties of the rope, from hand to peg."""
    task, qpos = backend.task, backend.qpos
    beads = qpos[:, 7 : 7 + 3 * BEADS].reshape(-1, BEADS, 3)
    w, x, y, z = qpos[:, 10 + 3 * BEADS : 14 + 3 * BEADS].T
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    top = qpos[:, 7 + 3 * BEADS : 10 + 3 * BEADS] + task.peg_half_height * up
    ties = np.concatenate([task.hold(qpos)[:, None], beads, top[:, None]], 1)
    return np.linalg.norm(np.diff(ties, axis=1), axis=2)


def test_the_peg_goes_in(make_backend) -> None:
    backend = make_backend("rope_peg_in_hole", 32)
    first, seen = first_and_last(backend, backend.task.scripted)
    assert not backend.task.success(first).any() and backend.task.success(seen).mean() >= 0.95
    assert seen[:, 5].min() > TOP - backend.task.depth - 0.011, "the hole has a floor"


def test_beside_the_hole_is_the_table(make_backend) -> None:
    backend = make_backend("rope_peg_in_hole", 16)
    task = backend.task

    def aside(seen: np.ndarray) -> np.ndarray:
        return task.scripted(seen + np.r_[np.zeros(6), 0.05, 0.0, 0.0])

    _, seen = first_and_last(backend, aside)
    assert not task.success(seen).any() and (seen[:, 5] > TOP).all()


@pytest.mark.parametrize("gap", ["rope_real", "dev_rope"])
def test_the_real_one_can_be_done(make_backend, gap) -> None:
    effects = yaml.safe_load((CONFIGS / f"gap/{gap}.yaml").read_text())["effects"]
    backend = make_backend("rope_peg_in_hole", 32, effects_=effects)
    _, seen = first_and_last(backend, backend.task.scripted)
    assert backend.task.success(seen).mean() >= 0.95


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_rope_is_as_long_as_told_and_no_longer(make_backend, scale) -> None:
    backend = make_backend("rope_peg_in_hole", 4, effects_={"rope_length": {"scale": scale}})
    backend.reset(np.arange(4))
    longest = 0.0
    for step in range(20):
        backend.send(np.full((4, 3), [(-1.0) ** step, 0.5, 0.3]))
        strings = _strings(backend)
        longest = max(longest, strings.max())
        assert strings.sum(1).max() < scale * 0.12 + 0.003
    assert longest > 0.99 * scale * 0.12 / (BEADS + 1), "it hangs from it"


def test_it_swings_like_a_pendulum_of_its_length(make_backend) -> None:
    backend = make_backend("rope_peg_in_hole", 1, changes={"start_noise": 0.0, "drag": 0.0})
    backend.reset(np.arange(1))
    for _ in range(5):
        backend.send(np.array([[0.0, 0.6, 0.0]]))  # sets it swinging
    aside = []
    for _ in range(15):
        backend.send(np.zeros((1, 3)))
        qpos = backend.samples()["qpos"]
        aside.append(qpos[:, 8 + 3 * BEADS])
    swing = np.concatenate(aside) - np.mean(np.concatenate(aside))
    crossings = np.flatnonzero(np.diff(np.sign(swing)))
    rate = len(swing) / (15 * 0.2)  # samples a second
    period = 2 * np.diff(crossings).mean() / rate
    assert period == pytest.approx(2 * np.pi * np.sqrt((0.12 + 0.02) / 9.81), rel=0.05)


def test_a_rope_does_not_push(make_backend) -> None:
    backend = make_backend("rope_peg_in_hole", 2)
    backend.reset(np.arange(2))
    for _ in range(25):
        backend.send(np.tile([0.0, 0.0, -1.0], (2, 1)))
    peg, hand = backend.qpos[:, 9 + 3 * BEADS], backend.task.hold(backend.qpos)[:, 2]
    assert (peg > TOP - 0.05).all() and (hand - peg < 0.12).all(), "the peg lies, the rope is slack"


def test_rewards_by_hand(make_task) -> None:
    task = make_task("rope_peg_in_hole")
    seen = np.zeros((3, 9))
    seen[:, 3:6] = [[0.0, 0.0, 0.0], [0.01, 0.0, 0.01], [0.03, 0.0, 0.04]]
    expected = [1.0, 1 - 5 * np.hypot(0.01, 0.01), -5 * 0.05]
    np.testing.assert_allclose(task.reward(seen, np.zeros((3, 3))), expected, atol=1e-12)
    assert task.success(seen).tolist() == [True, True, False]


def test_a_state_is_seen_and_placed_again(make_backend) -> None:
    backend = make_backend("rope_peg_in_hole", 8)
    seen = backend.reset(np.arange(8))
    task, qpos = backend.task, backend.qpos.copy()
    assert np.ptp(seen[:, 6]) > 0.04 and (np.abs(seen[:, 7]) <= 0.05).all()
    np.testing.assert_allclose(seen[:, 2] - seen[:, 5], 0.14, atol=1e-3)  # it hangs down
    np.testing.assert_allclose(task.place(seen, qpos), qpos, atol=1e-9)
    np.testing.assert_allclose(task.hold(qpos), seen[:, :3], atol=1e-9)


def test_each_episode_has_a_rope_of_its_own(make_env) -> None:
    env = make_env("rope_peg_in_hole", 32, randomised=True)
    env.set_seed(0)
    env.reset()
    drawn = env.backend.randomizer.arrays["tendon_range"][:, :, 1] * (BEADS + 1) / env.task.rope_length
    assert (np.ptp(drawn, axis=1) < 1e-9).all(), "all its strings alike"
    assert 0.75 <= drawn.min() < 0.8 and 1.2 < drawn.max() <= 1.25
