"""Effects on commands and readings: on a task's action, on a scene's control signals, on recorded signals."""

import numpy as np
import pytest

from envs import effects

STEP = 0.001
SLIDE = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
  </worldbody>
  <actuator>DRIVE</actuator>
</mujoco>
"""
MOTOR = SLIDE.replace("DRIVE", '<motor name="pull" joint="slide" gear="3"/>')
SERVO = SLIDE.replace("DRIVE", '<position name="pull" joint="slide" kp="300" kv="30"/>')
FILTERED = SERVO.replace("kv=", 'timeconst="0.05" kv=')
CTRL = 2.0 * np.sin(2 * np.pi * STEP * np.arange(600))[:, None]


def _load(**gap) -> effects.Effect:
    return effects.load(gap)[0]


@pytest.mark.parametrize(
    ("scene", "gap"),
    [
        (MOTOR, {"actuator_gain": {"gain": 0.7}}),
        (SERVO, {"actuator_gain": {"gain": 0.7}}),
        (FILTERED, {"actuator_gain": {"gain": 0.7}}),
        (MOTOR, {"actuator_offset": {"offset": 0.4}}),
        (SERVO, {"actuator_offset": {"offset": 0.4}}),
    ],
)
def test_gain_and_offset_in_the_scene_equal_those_on_the_signal(build, simulate, scene, gap) -> None:
    named = {name: {**parameters, "at": ["pull"]} for name, parameters in gap.items()}
    (in_scene,), (on_signal,) = effects.load(named), effects.load(gap)
    assert in_scene.ctrl(CTRL, ["pull"]) is CTRL  # what the scene carries is not done twice
    q = simulate(build(scene, named), CTRL)[0]
    np.testing.assert_allclose(q, simulate(build(scene), on_signal.ctrl(CTRL, ["pull"]))[0], atol=1e-12)


def test_an_offset_behind_a_low_pass_is_there_from_the_start(build, simulate) -> None:
    named = {"actuator_offset": {"offset": 0.4, "at": ["pull"]}}
    early, late = (simulate(build(FILTERED, g), c)[0][:, 0] for g, c in ((named, 0 * CTRL), ({}, 0 * CTRL + 0.4)))
    assert early[30] > 1.5 * late[30] and early[-1] == pytest.approx(late[-1], abs=0.02)


def test_each_actuator_has_its_own_gain(build) -> None:
    scene = SLIDE.replace("DRIVE", '<motor name="a" joint="slide"/><motor name="b" joint="slide" gear="1"/>')
    model = build(scene, {"actuator_gain": {"gain": [3.0, 2.0], "at": ["b", "a"]}})
    assert model.actuator_gainprm[:, 0].tolist() == [2.0, 3.0]
    with pytest.raises(ValueError, match="3 numbers; give one, or 2"):
        build(scene, {"actuator_gain": {"gain": [3.0, 2.0, 1.0], "at": ["b", "a"]}})


@pytest.mark.parametrize("name", ["actuator_gain", "actuator_offset"])
def test_a_drive_that_is_not_linear_is_refused(build, name) -> None:
    scene = SLIDE.replace("DRIVE", '<intvelocity name="pull" joint="slide" kp="10" actrange="-1 1"/>')
    with pytest.raises(ValueError, match=f"{name}: actuator 'pull' is not linear in its control"):
        build(scene, {name: {"at": ["pull"]}})


@pytest.mark.parametrize("limit", [0.5, 1.5])
def test_a_saturated_drive_gives_its_limit_times_the_gear(build, simulate, limit) -> None:
    q, v = simulate(build(MOTOR, {"torque_saturation": {"limit": limit}}), CTRL)
    speed = np.cumsum(3 * np.clip(CTRL[:, 0], -limit, limit) / 2 * STEP)
    np.testing.assert_allclose(v[:, 0], speed, atol=1e-9)
    np.testing.assert_allclose(q[:, 0], np.cumsum(speed * STEP), atol=1e-9)


def test_saturation_keeps_tighter_limits(build) -> None:
    scene = MOTOR.replace('gear="3"', 'forcerange="-1 4"')
    assert build(scene, {"torque_saturation": {"limit": 2.0}}).actuator_forcerange.tolist() == [[-1.0, 2.0]]
    with pytest.raises(ValueError, match="actuator 'pull' gives 3.0 or more"):
        build(scene.replace("-1 4", "3 4"), {"torque_saturation": {"limit": 2.0}})


def test_deadband_takes_its_width_off_every_signal() -> None:
    signals = np.array([[-1.0, 0.3], [0.2, -0.2], [0.05, 0.9]])
    at_one = _load(deadband={"width": 0.2, "at": ["b"]})
    np.testing.assert_allclose(at_one.ctrl(signals, ["a", "b"]), [[-1.0, 0.1], [0.2, 0.0], [0.05, 0.7]])
    everywhere = _load(deadband={"width": 0.2})
    np.testing.assert_allclose(everywhere.ctrl(signals, ["a", "b"]), [[-0.8, 0.1], [0.0, 0.0], [0.0, 0.7]])
    assert signals[0, 0] == -1.0
    with pytest.raises(ValueError, match="No actuator 'c' in this scene. Available: a, b"):
        _load(deadband={"width": 0.2, "at": ["c"]}).ctrl(signals, ["a", "b"])


def test_gains_differ_by_direction_and_by_place(make_task) -> None:
    task, told = make_task("push"), np.array([[1.0, -0.5], [-1.0, 0.0], [0.5, 1.0]])
    truth = np.array([[0.3, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.9, 0.0, 0.0, 0.0]])
    by_direction = _load(directional_gain={"positive": [0.5, 1.0], "negative": [1.0, 2.0]})
    np.testing.assert_allclose(by_direction.command(told, task, truth), [[0.5, -1.0], [-1.0, 0.0], [0.25, 1.0]])
    by_place = _load(local_gain={"slope": -3.0, "centre": 0.5, "at": "tip_x"})
    np.testing.assert_allclose(by_place.command(told, task, truth), [[1.6, -0.8], [-1.0, 0.0], [0.0, 0.0]])


@pytest.mark.parametrize(
    "gap",
    [
        {"deadband": {"width": 0.5, "at": ["torque"]}},  # N m, of the 2 N m that the action 1 asks for
        {"actuator_gain": {"gain": 0.75, "at": ["torque"]}},
        {"actuator_offset": {"offset": -0.5, "at": ["torque"]}},
        {"torque_saturation": {"limit": 1.5, "at": ["torque"]}},
        {"deadband": {"width": 0.25}},  # of the largest action
        {"actuator_gain": {"gain": 0.75}},
        {"directional_gain": {"positive": 0.75, "negative": 3.0}},
    ],
)
def test_a_task_s_drive_gives_less_than_it_is_told(make_backend, gap) -> None:
    """Wherever the change sits, the machine records what was meant: a recording must not name the effect."""
    backend = make_backend("pendulum", 2, effects_=gap, changes={"max_torque": 2.0})
    backend.reset(np.arange(2))
    for _ in range(2):
        backend.send(np.ones((2, 1)))
    np.testing.assert_allclose(backend._last["force"][:, -1, 0], 1.5, atol=1e-6)
    np.testing.assert_allclose(backend._last["ctrl"][:, -1, 0], 2.0)


def test_a_local_gain_is_that_of_the_place_where_an_action_begins(make_backend) -> None:
    backend = make_backend("pendulum", 2, effects_={"local_gain": {"slope": 0.1, "centre": 1.0, "at": "cos"}})
    backend.reset(np.arange(2))
    for _ in range(3):
        cos = np.cos(backend.qpos[:, 0])
        backend.send(np.ones((2, 1)))
        realised = backend.task.max_torque * (1 + 0.1 * (cos - 1))
        np.testing.assert_allclose(backend._last["force"][:, -1, 0], realised, atol=1e-6)


def test_signals_of_recorded_data_are_read_as_a_sensor_would() -> None:
    time = np.linspace(0, 1, 101)
    true = np.sin(3 * time)
    gain = _load(sensor_gain={"gain": [1.1, 0.5], "at": ["qpos/a", "qpos/b"]})
    np.testing.assert_allclose(gain.measured(true, "qpos/b", time), 0.5 * true)
    assert gain.measured(true, "qpos/c", time) is true
    np.testing.assert_allclose(_load(sensor_gain={"gain": 0.9}).measured(true, "qpos/c", time), 0.9 * true)
    offset = _load(sensor_offset={"offset": 0.2, "at": ["qpos/a"]})
    np.testing.assert_allclose(offset.measured(true, "qpos/a", time), true + 0.2)
    late = _load(sensor_delay={"delay": 0.25}).measured(true, "qpos/a", time)
    np.testing.assert_allclose(late[:26], true[0])
    np.testing.assert_allclose(late[26:], np.sin(3 * (time[26:] - 0.25)), atol=1e-3)


def test_sensor_gain_scales_what_it_names(make_backend) -> None:
    seen = {}
    for gain in (1.0, 1.3):
        backend = make_backend("push", 2, effects_={"sensor_gain": {"gain": gain, "at": ["puck_x"]}})
        backend.seed(3)
        seen[gain] = backend.reset(np.arange(2))
    np.testing.assert_allclose(seen[1.3], seen[1.0] * [1, 1, 1.3, 1])
