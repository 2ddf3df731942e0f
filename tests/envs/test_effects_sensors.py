"""Effects in what is observed, and the frame that is turned."""

import numpy as np
import pytest

from envs.effects import load
from envs.tasks import push


def _episode(make_backend, gap, steps=6, **kwargs):
    """What is sensed [T+1, N, O], and the true states of every physics step (qpos [N, T S, nq], qvel)."""
    backend = make_backend("push", kwargs.pop("num_envs", 2), effects_=gap, **kwargs)
    backend.seed(1)
    seen, qpos, qvel = [backend.reset(np.arange(backend.num_envs))], [], []
    first = backend.qpos.copy(), backend.qvel.copy()
    rng = np.random.default_rng(0)
    for _ in range(steps):
        seen.append(backend.send(rng.uniform(-1, 1, (backend.num_envs, 2))).observation)
        qpos.append(backend._last["qpos"].copy())
        qvel.append(backend._last["qvel"].copy())
    states = tuple(np.concatenate([s[:, None], *parts], 1) for s, parts in zip(first, (qpos, qvel), strict=True))
    return backend, np.stack(seen), states


@pytest.mark.parametrize("gap", [{"sensor_offset": {"offset": [0.3, -0.1]}}, {"sensor_gain": {"gain": [0.3, -0.1]}}])
def test_each_name_has_its_own_number_whatever_their_order(make_backend, gap) -> None:
    """In simulation as in recorded data, where `measured` goes by the name."""
    (name, numbers), names = *gap.items(), ["puck_x", "tip_y"]
    (effect,) = load({name: numbers | {"at": names}})
    plain, seen = (_episode(make_backend, table, steps=2)[1] for table in ({}, {name: numbers | {"at": names}}))
    for column, observed in enumerate(["tip_x", "tip_y", "puck_x", "puck_y"]):
        told = effect.measured(plain[..., column], observed, np.zeros(len(plain)))
        np.testing.assert_allclose(seen[..., column], told, atol=1e-12)


def test_offset_is_added_to_what_it_names(make_backend) -> None:
    plain, seen = (
        _episode(make_backend, gap)[1]
        for gap in ({}, {"sensor_offset": {"offset": [0.01, -0.02], "at": ["tip_y", "puck_x"]}})
    )
    np.testing.assert_allclose(seen - plain, np.broadcast_to([0, 0.01, -0.02, 0], seen.shape), atol=1e-12)


def test_noise_has_its_standard_deviation_and_no_memory(make_backend) -> None:
    gap = {"sensor_noise": {"sd": 0.02, "at": ["tip_x", "puck_y"]}}
    plain, seen = (_episode(make_backend, g, steps=30, num_envs=32)[1] for g in ({}, gap))
    noise = seen - plain
    assert not noise[..., 1:3].any()
    noise = noise[..., [0, 3]]
    assert noise.std() == pytest.approx(0.02, rel=0.05) and abs(noise.mean()) < 0.002
    assert abs(np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1]) < 0.1  # over time
    assert abs(np.corrcoef(noise[:, 0].ravel(), noise[:, 1].ravel())[0, 1]) < 0.3  # over environments


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.2, 0.3, 1.0])
def test_delay_shows_the_true_state_of_then(make_backend, delay) -> None:
    backend, seen, (qpos, qvel) = _episode(make_backend, {"sensor_delay": {"delay": delay}})
    per_period, back = 50, round(delay / 0.004)
    for k in range(len(seen)):
        then = max(k * per_period - back, 0)  # before the start, the first state
        np.testing.assert_allclose(seen[k], backend.task.observe(qpos[:, then], qvel[:, then]), atol=1e-12)


def test_the_longest_delay_is_remembered_whole(make_backend) -> None:
    backend, seen, (qpos, qvel) = _episode(make_backend, {"sensor_delay": {"delay": 2.0}}, steps=13)
    then = 13 * 50 - 500
    np.testing.assert_allclose(seen[-1], backend.task.observe(qpos[:, then], qvel[:, then]), atol=1e-12)


def test_only_the_named_sensor_is_late(make_backend) -> None:
    backend, seen, (qpos, qvel) = _episode(make_backend, {"sensor_delay": {"delay": 0.2, "at": ["puck_x", "puck_y"]}})
    now, then = (backend.task.observe(qpos[:, k * 50], qvel[:, k * 50]) for k in (5, 4))
    np.testing.assert_allclose(seen[5][:, :2], now[:, :2], atol=1e-12)
    np.testing.assert_allclose(seen[5][:, 2:], then[:, 2:], atol=1e-12)


def test_a_reset_forgets_what_was_seen_before(make_backend) -> None:
    backend, _, _ = _episode(make_backend, {"sensor_delay": {"delay": 0.5}})
    recorded = backend._last["qpos"].copy()
    seen = backend.reset(np.array([1]))
    np.testing.assert_allclose(seen, backend.task.observe(backend.qpos[1:], backend.qvel[1:]), atol=1e-12)
    assert np.array_equal(recorded, backend._last["qpos"])  # the record of the last period is not rewritten
    after = backend.send(np.zeros((2, 2))).observation
    np.testing.assert_allclose(after[1], seen[0], atol=1e-12)


def test_effects_act_in_their_order(make_backend) -> None:
    gap = {"sensor_delay": {"delay": 0.2}, "sensor_offset": {"offset": 0.05}}
    late = _episode(make_backend, {"sensor_delay": {"delay": 0.2}})[1]
    np.testing.assert_allclose(_episode(make_backend, gap)[1], late + 0.05, atol=1e-12)


@pytest.mark.parametrize("reward", ["truth", "observed"])
def test_reward_is_that_of_the_truth_unless_it_is_asked_for_as_observed(make_backend, reward) -> None:
    backend = make_backend("push", 2, effects_={"sensor_offset": {"offset": [0.1, 0.0, 0.3, 0.0]}}, reward=reward)
    backend.seed(0)
    backend.reset(np.arange(2))
    out = backend.send(np.full((2, 2), 0.5))
    truth = backend.task.observe(backend.qpos, backend.qvel)
    rewards = {"truth": backend.task.reward(truth, out.action_sent)}
    rewards["observed"] = backend.task.reward(truth + [0.1, 0.0, 0.3, 0.0], out.action_sent)
    np.testing.assert_allclose(out.reward, rewards[reward])
    assert (np.abs(rewards["truth"] - rewards["observed"]) > 0.01).all()
    np.testing.assert_array_equal(out.success, backend.task.success(truth))
    with pytest.raises(ValueError, match="reward='seen'; allowed: truth, observed"):
        make_backend("push", reward="seen")


def test_a_turned_base_moves_along_turned_axes(make_task) -> None:
    task = make_task("push")
    (effect,) = load({"frame_rotation": {"angle": np.pi / 2}})
    seen = np.array([[0.1, 0.2, 0.3, 0.4]])
    np.testing.assert_allclose(
        effect.command(np.array([[1.0, 0.0], [0.0, 0.5]]), task, seen), [[0, 1], [-0.5, 0]], atol=1e-12
    )
    (effect,) = load({"frame_rotation": {"angle": 0.6}})
    assert effect.sense(seen, lambda s: seen, np.zeros, task) is seen  # the camera is right
    np.testing.assert_allclose(effect.command(np.array([[1.0, 0.0]]), task, seen), [[np.cos(0.6), np.sin(0.6)]])


def test_the_arm_goes_where_a_turned_base_points(make_env, play) -> None:
    ahead = np.concatenate([np.full((3, 1, 2), [1.0, 0.0]), np.zeros((3, 1, 2))])
    env = make_env("push", 1, effects_={"frame_rotation": {"angle": np.pi / 2}}, changes={"start_noise": 0.0})
    env.set_seed(0)
    start = env.reset()["observation"][0, :2]
    moved = play(env, ahead)["observation"][-1, 0, :2] - start
    np.testing.assert_allclose(moved.numpy(), [0.0, 0.15], atol=0.008)


def test_a_turned_camera_turns_what_is_seen_about_its_centre(make_backend, make_task) -> None:
    (effect,) = load({"frame_rotation": {"angle": np.pi / 2, "at": "camera", "centre": [0.1, 0.0]}})
    seen = effect.sense(np.array([[0.3, 0.0, 0.1, 0.2]]), lambda s: None, np.zeros, make_task("push"))
    np.testing.assert_allclose(seen, [[0.1, 0.2, -0.1, 0.0]], atol=1e-12)
    plain, turned = (_episode(make_backend, gap)[1] for gap in ({}, {"frame_rotation": {"angle": 0.4, "at": "camera"}}))
    c, s = np.cos(0.4), np.sin(0.4)
    points = plain.reshape(*plain.shape[:-1], 2, 2) - [0.25, 0.0]
    expected = points @ np.array([[c, -s], [s, c]]).T + [0.25, 0.0]
    np.testing.assert_allclose(turned.reshape(expected.shape), expected, atol=1e-12)
    assert push.Push.observation_names == ("tip_x", "tip_y", "puck_x", "puck_y")
