"""Effects in joints, bodies and contacts, against closed forms."""

import mujoco
import numpy as np
import pytest

from envs import effects
from envs.tasks import push

FREE = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
    <body name="wheel" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 0 1"/><geom type="cylinder" size="0.2 0.05" mass="3"/>
    </body>
    <body name="ball" pos="0 0 3"><freejoint name="free"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator><motor name="pull" joint="slide"/></actuator>
</mujoco>
"""
SERVO = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm" gravcomp="1">
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1.5"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="400" kv="40"/></actuator>
</mujoco>
"""


def _world(xml: str, gap: dict) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec.from_string(xml)
    for effect in effects.load(gap):
        effect.edit_spec(spec)
    model = spec.compile()
    return model, mujoco.MjData(model)


def _speeds(gap: dict, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] and speeds [T, 3] of cart, wheel and ball (along x) after a push of 1 m/s, 2 rad/s and 1 m/s."""
    model, data = _world(FREE, gap)
    data.qvel[:3] = [1.0, 2.0, 1.0]
    times, speeds = [], []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        times.append(data.time)
        speeds.append(data.qvel[:3].copy())
    return np.array(times), np.array(speeds)


def test_viscous_friction_decays_exponentially() -> None:
    t, v = _speeds({"viscous_friction": {"coefficient": 0.8}}, 2.0)
    wheel = 0.5 * 3 * 0.2**2
    np.testing.assert_allclose(v[:, 0], np.exp(-0.8 / 2 * t), rtol=2e-3)
    t, v = _speeds({"viscous_friction": {"coefficient": 0.05, "at": ["hinge"]}}, 2.0)
    np.testing.assert_allclose(v[:, 1], 2 * np.exp(-0.05 / wheel * t), rtol=2e-3)
    np.testing.assert_allclose(v[:, 0], 1.0)  # not named


def test_coulomb_friction_slows_evenly_and_then_holds() -> None:
    t, v = _speeds({"coulomb_friction": {"torque": 1.2, "at": ["slide"]}}, 3.0)
    np.testing.assert_allclose(v[:, 0], np.maximum(1 - 1.2 / 2 * t, 0), atol=2e-4)
    assert np.abs(v[-500:, 0]).max() < 1e-3
    np.testing.assert_allclose(v[:, 1], 2.0)  # not named
    t, v = _speeds({"coulomb_friction": {"torque": 0.03, "at": ["hinge"]}}, 3.0)
    np.testing.assert_allclose(v[:, 1], np.maximum(2 - 0.03 / 0.06 * t, 0), atol=2e-3)


@pytest.mark.parametrize("force", [1.0, 1.4])
def test_coulomb_friction_sticks_below_its_threshold(force) -> None:
    model, data = _world(FREE, {"coulomb_friction": {"torque": 1.2}})
    data.ctrl[0] = force
    mujoco.mj_step(model, data, nstep=1000)
    expected = max(force - 1.2, 0.0) / 2
    assert data.qvel[0] == pytest.approx(expected, abs=1e-5)  # MuJoCo's default friction creeps at 5e-4 here


@pytest.mark.parametrize("gap", [{"viscous_friction": {"coefficient": 5.0}}, {"coulomb_friction": {"torque": 5.0}}])
def test_a_free_body_has_no_joint_friction(gap) -> None:
    assert _speeds(gap, 0.5)[1][-1, 2] == pytest.approx(1.0)


def test_a_payload_makes_a_body_harder_to_accelerate() -> None:
    for extra in (0.0, 2.0, 6.0):
        model, data = _world(FREE, {"payload": {"mass": extra, "at": ["cart"]}})
        data.ctrl[0] = 4.0
        mujoco.mj_step(model, data, nstep=500)
        assert data.qvel[0] == pytest.approx(4.0 / (2 + extra) * 0.5, rel=1e-6)


def test_a_payload_off_the_axis_adds_its_moment_of_inertia() -> None:
    model, data = _world(FREE, {"payload": {"mass": 1.0, "at": ["wheel"], "position": [0.5, 0, 0]}})
    data.qfrc_applied[1] = 0.31
    mujoco.mj_step(model, data, nstep=100)
    assert data.qvel[1] == pytest.approx(0.31 / (0.06 + 0.25) * 0.1, rel=1e-3)


def test_a_payload_sags_though_the_arm_is_compensated() -> None:
    """Gravity compensation knows the arm, not what hangs on it: kp sag = m g L cos(sag)."""
    for mass in (0.0, 2.0):
        model, data = _world(SERVO, {"payload": {"mass": mass, "at": ["arm"], "position": [0.5, 0, 0]}})
        mujoco.mj_step(model, data, nstep=3000)
        sag = data.qpos[0]
        assert 400 * sag == pytest.approx(mass * 9.81 * 0.5 * np.cos(sag), abs=0.02)


def _scene(task, gap: dict, q: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The pushing scene with a gap, the arm held at q and the puck lying still, settled."""
    spec = task.spec()
    for effect in effects.load(gap):
        effect.edit_spec(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = data.ctrl[:] = data.act[:] = q
    data.qpos[7:] = [0.5, 0, push.ORIGIN[2] + push.PUCK_HALF_HEIGHT, 1, 0, 0, 0]
    mujoco.mj_step(model, data, nstep=100)
    return model, data


def test_a_payload_lowers_the_tip_of_the_arm(make_task) -> None:
    heights = []
    for mass in (0.0, 3.0):
        model, data = _scene(make_task("push"), {"payload": {"mass": mass}}, push.REST)
        mujoco.mj_step(model, data, nstep=400)
        mujoco.mj_kinematics(model, data)
        heights.append(data.site("tip").xpos[2])
    assert 0.0005 < heights[0] - heights[1] < 0.02


@pytest.mark.parametrize("mu", [0.05, 0.3, 0.9])
def test_a_sliding_puck_stops_after_v_squared_over_two_mu_g(make_task, mu) -> None:
    task = make_task("push")
    model, data = _scene(task, {"contact_friction": {"coefficient": mu}}, task.home()[0])
    speed, start = 0.4, data.qpos[7].copy()
    data.qvel[7:] = [speed, 0, 0, 0, 0, 0]
    mujoco.mj_step(model, data, nstep=round(4 * speed / (mu * 9.81) / task.sim_dt))
    assert data.qpos[7] - start == pytest.approx(speed**2 / (2 * mu * 9.81), rel=0.08)
    assert abs(data.qvel[7]) < 1e-3


def test_a_slippery_table_is_slippery_for_a_puck_that_decides_in_its_contacts(make_task) -> None:
    task, slid = make_task("push"), {}
    for mu in (0.05, 0.3):
        model, data = _scene(task, {"contact_friction": {"coefficient": mu, "at": ["table"]}}, task.home()[0])
        speed, start = 0.4, data.qpos[7].copy()
        data.qvel[7:] = [speed, 0, 0, 0, 0, 0]
        mujoco.mj_step(model, data, nstep=round(4 * speed / (mu * 9.81) / task.sim_dt))
        slid[mu] = (data.qpos[7] - start) / (speed**2 / (2 * mu * 9.81))
    assert slid == pytest.approx({0.05: 1.0, 0.3: 1.0}, rel=0.08)


def test_a_soft_table_is_soft_under_a_puck_that_decides_in_its_contacts(make_task) -> None:
    task, depth = make_task("push"), {}
    for at in ("table", "puck"):
        _, data = _scene(task, {"contact_softness": {"time_constant": 0.05, "at": [at]}}, task.home()[0])
        depth[at] = data.qpos[9]
    assert depth["table"] == pytest.approx(depth["puck"], abs=1e-5)


def test_a_payload_that_nothing_moves_is_refused(make_task) -> None:
    """The puck of the towel task is soft: its nodes move, the body that bears its name does not."""
    spec = make_task("push_towel").spec()
    (load,) = effects.load({"payload": {"mass": 1.0, "at": ["puck"]}})
    with pytest.raises(ValueError, match="payload at 'puck': nothing moves this body"):
        load.edit_spec(spec)


def test_two_payloads_at_one_body_add_up() -> None:
    model, _ = _world(FREE, {"payload": [{"mass": 1.0, "at": ["cart"]}, {"mass": 2.0, "at": ["cart"]}]})
    assert model.body_subtreemass[model.body("cart").id] == pytest.approx(2 + 3)


def test_contact_friction_decides_over_the_other_geom() -> None:
    slope = """
    <mujoco><option gravity="3 0 -9.3"/><worldbody>
      <geom name="floor" type="plane" size="5 5 0.1" friction="1.5 0.005 0.0001"/>
      <body pos="0 0 0.05"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.05"/></body>
    </worldbody></mujoco>"""
    slides = {}
    for mu in (0.1, 1.0):  # the slope's tangent is 0.32
        model, data = _world(slope, {"contact_friction": {"coefficient": mu, "at": ["box"]}})
        mujoco.mj_step(model, data, nstep=500)
        slides[mu] = data.qpos[0]
    assert slides[0.1] == pytest.approx(0.5 * (3 - 0.1 * 9.3), rel=0.1) and slides[1.0] < 0.01
