"""Rotors, play, springs, tilt and soft contacts, against closed forms and independent integrations."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from envs import effects

MASS, STEP, G = 2.0, 0.001, 9.81
KP, KV = 2000.0, 80.0  # of a servo
SLIDE = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 -{G}" integrator="implicitfast"/>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide" axis="1 0 0" ARMATURE/><geom size="0.1" mass="{MASS}"/></body>
  </worldbody>
  <actuator><motor name="pull" joint="slide"/></actuator>
</mujoco>
"""
PLAIN = SLIDE.replace("ARMATURE", "")
# a point-like bob hanging from a hinge, in degrees as MJCF is by default
PENDULUM = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 -{G}" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" gravcomp="COMPENSATED">
      <joint name="hinge" type="hinge" axis="0 1 0" range="-170 170"/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="1e-9 1e-9 1e-9"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="200" kv="20"/></actuator>
</mujoco>
"""
HANGING = PENDULUM.replace("COMPENSATED", "0").replace('kp="200" kv="20"', 'kp="0" kv="0"')
HELD = PENDULUM.replace("COMPENSATED", "0")
COMPENSATED = PENDULUM.replace("COMPENSATED", "1")


def test_armature_is_inertia_at_the_joint(build, simulate) -> None:
    for extra in (0.0, 0.7, 5.0):
        _, v = simulate(build(PLAIN, {"armature": {"inertia": extra}}), np.full((500, 1), 3.0))
        assert v[-1, 0] == pytest.approx(3.0 / (MASS + extra) * 0.5, rel=1e-9)


def test_armature_has_no_weight(build, simulate) -> None:
    """A rotor turns, it does not hang on the joint: the sag of a servo stays, though the pendulum swings slower."""
    ctrl = np.full((4000, 1), 0.3)
    q = [simulate(build(HELD, {"armature": {"inertia": a}}), ctrl)[0][-1, 0] for a in (0.0, 0.3)]
    assert q[0] == pytest.approx(q[1], abs=1e-6)
    assert 200 * (0.3 - q[0]) == pytest.approx(1.0 * G * 0.5 * np.sin(q[0]), rel=1e-6)


def _geared_servo(targets: np.ndarray, gap: float, rotor: float, link: float, drag: float) -> np.ndarray:
    """Link positions [T]: rotor and link with a gap between, a stiff damped flank, 40 steps to one of MuJoCo's."""
    stiffness, damping, dt = 1e6, 2 * np.sqrt(1e6 * rotor * link / (rotor + link)), STEP / 40
    q = v = turn = speed = 0.0
    positions = []
    for target in targets[:, 0].tolist():
        for _ in range(40):
            twist = turn - q
            beyond = max(twist - gap, 0.0) + min(twist + gap, 0.0)
            push = stiffness * beyond + damping * (speed - v) if beyond else 0.0
            push = push if push * beyond > 0 else 0.0  # it never pulls
            speed += (KP * (target - turn) - KV * speed - push) / rotor * dt
            v += (push - drag * v) / link * dt
            turn, q = turn + speed * dt, q + v * dt
        positions.append(q)
    return np.array(positions)


@pytest.mark.parametrize("gap", [0.005, 0.03])
@pytest.mark.parametrize(("armature", "given"), [(0.4, 0.0), (0.0, 0.4), (0.0, 0.0)])
def test_backlash_is_two_masses_with_play(build, simulate, gap, armature, given) -> None:
    drag = 20.0
    scene = SLIDE.replace("ARMATURE", f'armature="{armature}" damping="{drag}"')
    scene = scene.replace("<motor", f'<position kp="{KP}" kv="{KV}"')
    targets = 0.1 * np.sin(2 * np.pi * STEP * np.arange(2000))[:, None]
    rotor = armature or given or 0.05 * MASS
    with_play, rigid = (
        simulate(build(scene, g), targets)[0][:, 0] for g in ({"backlash": {"gap": gap, "inertia": given}}, {})
    )
    truth, rigid_truth = (_geared_servo(targets, g, rotor, MASS + armature - rotor, drag) for g in (gap, 0.0))
    assert np.abs(truth - rigid_truth).max() > 0.9 * gap
    # 1 % of the play, and half a time step at the speed of crossing it
    np.testing.assert_allclose(with_play - rigid, truth - rigid_truth, atol=0.01 * gap + 0.5 * STEP * 0.4)


def test_a_gear_that_is_pushed_one_way_is_rigid(build, simulate) -> None:
    ctrl = np.full((1000, 1), 2.0)
    q, v = simulate(build(PLAIN, {"backlash": {"gap": 0.001}}), ctrl)
    assert v[-1, 0] == pytest.approx(2.0 / MASS * 1.0, rel=5e-3)
    assert q[-1, 1] - q[-1, 0] == pytest.approx(0.001, rel=0.02)  # the rotor leads by half of the play


def test_play_of_a_servo_is_seen_at_the_joint_not_at_the_motor(build, simulate) -> None:
    """A pendulum hangs to one side within the play: the motor is where it should be, the joint is not."""
    model = build(HELD, {"backlash": {"gap": 0.05}})
    q, _ = simulate(model, np.full((5000, 1), 0.6), qpos=[0.6])
    torque = 1.0 * G * 0.5 * np.sin(q[-1, 0])
    assert q[-1, 0] == pytest.approx(0.6 - torque / 200 - 0.05, abs=1e-3)


def test_play_adds_up_and_moves_keyframes_along(build) -> None:
    scene = HELD.replace("</mujoco>", '<keyframe><key name="home" qpos="0.7"/></keyframe></mujoco>')
    model = build(scene, {"backlash": {"gap": 0.01}})
    np.testing.assert_allclose(model.key("home").qpos, [0.7, 0.7])
    spec = mujoco.MjSpec.from_string(scene)
    for _ in range(2):
        effects.load({"backlash": {"gap": 0.01}})[0].edit_spec(spec)
    twice = spec.compile()
    assert twice.nq == 2 and twice.tendon_range[0].tolist() == [-0.02, 0.02]


def test_a_joint_that_nothing_drives_has_no_play(build) -> None:
    scene = PLAIN.replace("<geom", '<body><joint name="idle"/><geom size="0.1"/></body><geom')
    assert build(scene, {"backlash": {"gap": 0.1}}).nq == 3
    with pytest.raises(ValueError, match="no actuator drives the joint 'idle'"):
        build(scene, {"backlash": {"gap": 0.1, "at": ["idle"]}})
    heavy = PLAIN.replace('type="slide"', 'type="slide" armature="50"')  # a rotor that is most of what moves
    assert heavy != PLAIN and build(heavy, {"backlash": {"gap": 0.1}}).dof_armature.tolist() == [0.0, 50.0]
    with pytest.raises(ValueError, match="backlash.inertia=9.0: all that moves with 'slide' is only 2"):
        build(PLAIN, {"backlash": {"gap": 0.1, "inertia": 9.0}})


def _edited(scene: str, *gaps: dict) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(scene)
    for gap in gaps:
        for effect in effects.load(gap):
            effect.edit_spec(spec)
    return spec.compile()


@pytest.mark.parametrize(("armature", "given"), [(0.4, 0.0), (0.0, 0.4), (0.0, 0.0)])
def test_an_elastic_drive_is_two_masses_and_a_spring(build, simulate, armature, given) -> None:
    """From rest under a constant force: the centre of both moves as one mass, and they swing against each other."""
    force, stiffness = 3.0, 400.0
    rotor, whole = armature or given or 0.05 * MASS, MASS + armature
    gap = {"flexible_joint": {"compliance": 1 / stiffness, "damping_ratio": 0.0, "inertia": given}}
    q, _ = simulate(build(SLIDE.replace("ARMATURE", f'armature="{armature}"'), gap), np.full((1500, 1), force))
    t = STEP * np.arange(1, 1501)
    reduced = rotor * (whole - rotor) / whole
    twist = force * reduced / (rotor * stiffness) * (1 - np.cos(np.sqrt(stiffness / reduced) * t))
    link = force * t**2 / (2 * whole) - rotor / whole * twist
    assert np.ptp(twist) > 5e-3
    np.testing.assert_allclose(q[:, 0], link, atol=0.02 * np.ptp(twist) + force / whole * STEP * t[-1])
    np.testing.assert_allclose(q[:, 1] - q[:, 0], twist, atol=0.05 * np.ptp(twist))


def test_an_elastic_drive_rings_down_by_its_damping(build, simulate) -> None:
    model = build(PLAIN, {"flexible_joint": {"compliance": 1 / 400, "damping_ratio": 0.1}})
    q, _ = simulate(model, np.where(np.arange(2000) < 20, 5.0, 0.0)[:, None])
    twist = (q[:, 1] - q[:, 0])[20:]
    tops = twist[1:-1][(twist[1:-1] > twist[:-2]) & (twist[1:-1] > twist[2:])]
    np.testing.assert_allclose(np.log(tops[:-1] / tops[1:])[:4], 2 * np.pi * 0.1 / np.sqrt(1 - 0.01), rtol=0.05)


def test_springs_in_a_row_add_up_and_pull_beyond_the_play(simulate) -> None:
    play, soft = {"backlash": {"gap": 0.03}}, {"flexible_joint": {"compliance": 0.01}}
    for gaps, away in (([soft], 0.01), ([soft, soft], 0.02), ([play, soft], 0.04), ([soft, play], 0.04)):
        scene = HELD.replace('range="-170 170"', 'range="-170 170" damping="2"')
        model = _edited(scene.replace('kv="20"', 'kv="20" forcerange="-1 1"'), *gaps)
        assert model.nq == 2
        q, _ = simulate(model, np.full((8000, 1), 3.0), qpos=[0.1, 0.1])  # 1 N m against gravity
        assert q[-1, 1] - q[-1, 0] == pytest.approx(away, rel=0.02), gaps


@pytest.mark.parametrize("integrator", ["implicitfast", "implicit", "Euler"])
@pytest.mark.parametrize("numbers", [{"compliance": 1e-12}, {"compliance": 1e-12, "damping_ratio": 5.0}])
def test_a_spring_that_no_step_can_follow_is_as_good_as_rigid(build, simulate, integrator, numbers) -> None:
    ctrl = 3.0 * np.sin(20 * STEP * np.arange(3000))[:, None]
    scene = PLAIN.replace("implicitfast", integrator)
    stiff, rigid = (simulate(build(scene, g), ctrl)[0][:, 0] for g in ({"flexible_joint": numbers}, {}))
    np.testing.assert_allclose(stiff, rigid, atol=1e-3 * np.ptp(rigid))


def test_rotors_are_ahead_by_the_twist_that_moves_their_joint(build, simulate) -> None:
    model = build(PLAIN, {"flexible_joint": {"compliance": 0.01}})
    qpos, qvel = np.array([[0.3, 9.0]]), np.array([[1.0, 9.0]])
    effects.place_rotors(model, qpos, qvel, np.array([[2.0, 0.0]]), np.array([[30.0, 0.0]]))
    np.testing.assert_allclose(qpos, [[0.3, 0.3 + 0.01 * 0.95 * MASS * 2.0]])
    np.testing.assert_allclose(qvel, [[1.0, 1.0 + 0.01 * 0.95 * MASS * 30.0]], rtol=1e-6)


def test_a_spring_oscillates_about_its_rest(build, simulate) -> None:
    stiffness, rest = 50.0, 0.1
    q, _ = simulate(build(PLAIN, {"joint_stiffness": {"stiffness": stiffness, "rest": rest}}), np.zeros((3000, 1)))
    t = STEP * np.arange(1, 3001)
    np.testing.assert_allclose(q[:, 0], rest * (1 - np.cos(np.sqrt(stiffness / MASS) * t)), atol=1e-3 * rest * 5)


def test_a_spring_of_a_hinge_counts_in_radians(build, simulate) -> None:
    """The scene is in degrees. kp (target - q) = m g l sin q + k (q - rest)."""
    model = build(HELD, {"joint_stiffness": {"stiffness": 30.0, "rest": -0.5}})
    q = simulate(model, np.full((4000, 1), 0.4))[0][-1, 0]
    expected = brentq(lambda x: 200 * (0.4 - x) - G * 0.5 * np.sin(x) - 30 * (x + 0.5), -1, 1)
    assert q == pytest.approx(expected, abs=1e-6)


def test_a_second_spring_adds_to_a_curved_one(build, simulate) -> None:
    scene = PLAIN.replace('axis="1 0 0"', 'axis="1 0 0" stiffness="20 0 400" springref="0.2" damping="30"')
    model = build(scene, {"joint_stiffness": {"stiffness": 25.0, "rest": -0.3}})
    q = simulate(model, np.zeros((6000, 1)))[0][-1, 0]
    expected = brentq(lambda x: 20 * (x - 0.2) + 400 * (x - 0.2) ** 3 + 25 * (x + 0.3), -1, 1)
    assert q == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("angle", [-0.3, 0.02, 0.2])
def test_a_tilted_slide_slips_and_a_tilted_pendulum_hangs_aside(build, simulate, angle) -> None:
    tilt = {"gravity_tilt": {"angle": angle}}
    _, v = simulate(build(PLAIN, tilt), np.zeros((1000, 1)))
    assert v[-1, 0] == pytest.approx(G * np.sin(angle) * 1.0, rel=1e-9)
    q = simulate(build(HANGING, tilt), np.zeros((3000, 1)), qpos=[0.4])[0][:, 0]

    def motion(t, state):
        return [state[1], -G / 0.5 * np.sin(state[0] + angle)]

    t = STEP * np.arange(1, 3001)
    truth = solve_ivp(motion, (0, t[-1]), [0.4, 0.0], t_eval=t, rtol=1e-10, atol=1e-10).y[0]
    np.testing.assert_allclose(q, truth, atol=0.02 * np.ptp(truth))


def test_a_roll_is_felt_along_y(build) -> None:
    gravity = build(PLAIN, {"gravity_tilt": {"roll": 0.1}}).opt.gravity
    np.testing.assert_allclose(gravity, [0, -G * np.sin(0.1), -G * np.cos(0.1)], atol=1e-12)
    both = build(PLAIN, {"gravity_tilt": {"roll": 0.4, "angle": 0.3}}).opt.gravity
    assert np.linalg.norm(both) == pytest.approx(G)


@pytest.mark.parametrize("angle", [0.15, -0.4])
def test_gravity_compensation_believes_to_stand_level(build, simulate, angle) -> None:
    """MuJoCo's would follow the tilt and nothing would sag; here the bob feels the difference."""
    q = simulate(build(COMPENSATED, {"gravity_tilt": {"angle": angle}}), np.full((4000, 1), 0.5))[0][-1, 0]
    gx, gz = G * np.sin(angle), -G * np.cos(angle)  # as felt; -G along z is compensated

    def balance(x):
        bob = np.array([-0.5 * np.sin(x), -0.5 * np.cos(x)])  # x and z of the bob
        force = np.array([gx, gz + G])
        return 200 * (0.5 - x) + bob[1] * force[0] - bob[0] * force[1]

    assert q == pytest.approx(brentq(balance, -1, 2), abs=1e-6)


def test_an_arm_that_leans_has_to_hold_what_is_not_compensated(make_task, build) -> None:
    """At rest: the joints feel the sum of J' m (g_leaning - gravcomp g_level) of all bodies."""
    task = make_task("push")
    model = build(task.spec(), {"gravity_tilt": {"angle": 0.2, "roll": -0.1}})
    data = mujoco.MjData(model)
    data.qpos[:7] = data.ctrl[:] = data.act[:] = task.home()[0]
    data.qpos[7:] = [0.5, 0, 0.5, 1, 0, 0, 0]
    mujoco.mj_forward(model, data)
    expected = np.zeros(model.nv)
    for body in range(1, model.nbody):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
        level = np.array([0, 0, -G]) * model.body_gravcomp[body]
        expected += jacobian.T @ (model.body_mass[body] * (model.opt.gravity - level))
    felt = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
    np.testing.assert_allclose(felt[:7], expected[:7], atol=1e-6)
    assert np.abs(felt[:7]).max() > 1


BALL = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 -{G}" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="ball" pos="0 0 0.1"><joint name="lift" type="slide" axis="0 0 1"/><geom name="ball" size="0.1"/></body>
  </worldbody>
</mujoco>
"""


def _rest_depth(time_constant: float) -> float:
    """Where a(r) = 0: (1 - d) (-g) + d k r = 0 with k = d / (dmax tc)^2 and the impedance d(r) of the defaults."""

    def acceleration(r):
        x = min(r / 0.001, 1.0)
        rise = 2 * x**2 if x < 0.5 else 1 - 2 * (1 - x) ** 2
        d = 0.9 + (0.95 - 0.9) * rise
        return d * d / (0.95 * time_constant) ** 2 * r - (1 - d) * G

    return brentq(acceleration, 1e-9, 1.0)


@pytest.mark.parametrize("extra", [0.0, 0.03, 0.2])
@pytest.mark.parametrize("at", [[], ["ball"]])
def test_a_soft_contact_gives_way_by_its_time_constant_squared(build, simulate, extra, at) -> None:
    model = build(BALL, {"contact_softness": {"time_constant": extra, "at": at}})
    q = simulate(model, np.zeros((6000, 0)))[0][-1, 0]
    assert -q == pytest.approx(_rest_depth(0.02 + extra), rel=0.02)


def test_a_contact_given_by_stiffness_and_damping_gets_softer_alike(build, simulate) -> None:
    """solref (-k, -b) with the numbers of a time constant of 0.02 s and a damping ratio of 1."""
    direct = BALL.replace('name="ball" size', f'name="ball" priority="2" solref="{-1 / (0.02**2)} {-2 / 0.02}" size')
    direct = direct.replace('solref="', 'solimp="1 1 0.001" solref="')
    usual = BALL.replace('name="ball" size', 'name="ball" priority="2" solimp="1 1 0.001" size')
    gap = {"contact_softness": {"time_constant": 0.05, "at": ["ball"]}}
    falls = [simulate(build(scene, gap), np.zeros((300, 0)), qpos=[0.05])[0] for scene in (direct, usual)]
    np.testing.assert_allclose(falls[0], falls[1], atol=1e-6)
    assert falls[0].min() < -1e-3
