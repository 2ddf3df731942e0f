"""Frictions in joints, against independent integrations of the same equation at a fraction of the time step."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from envs import effects

MASS, STEP = 2.0, 0.001
SLIDE = f"""
<mujoco>
  <option timestep="{STEP}" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="{MASS}"/></body>
  </worldbody>
  <actuator><motor name="pull" joint="slide"/></actuator>
</mujoco>
"""


def _sine(size: float, frequency: float, seconds: float) -> np.ndarray:
    """Control [T, 1], held over each step."""
    return size * np.sin(2 * np.pi * frequency * STEP * np.arange(round(seconds / STEP)))[:, None]


def _with_dry_friction(ctrl: np.ndarray, kinetic, static, fine: int = 40) -> np.ndarray:
    """Positions [T] of a mass that sticks: semi-implicit steps, a reversal is a stop, breaking away is an event.

    kinetic(v, load) and static(load) are levels of friction, load is the drive's force.
    """
    q, v, dt, positions = 0.0, 0.0, STEP / fine, []
    for force in ctrl[:, 0]:
        for _ in range(fine):
            if v == 0.0:
                if abs(force) > static(force):
                    v = (force - np.sign(force) * static(force)) / MASS * dt
            else:
                after = v + (force - np.sign(v) * kinetic(abs(v), force)) / MASS * dt
                v = 0.0 if after * v < 0 else after
            q += v * dt
        positions.append(q)
    return np.array(positions)


@pytest.mark.parametrize(("forward", "backward"), [(3.0, 1.0), (0.5, 4.0), (0.0, 2.0)])
def test_asymmetric_friction_follows_its_equation(build, simulate, forward, backward) -> None:
    ctrl = _sine(4.0, 0.5, 6.0)
    gap = {"asymmetric_friction": {"forward": forward, "backward": backward}}
    q, v = simulate(build(SLIDE, gap), ctrl)

    def motion(t, state):
        resistance = (forward if state[1] > 0 else backward) * state[1]
        return [state[1], (4.0 * np.sin(np.pi * t) - resistance) / MASS]

    t = STEP * np.arange(1, len(ctrl) + 1)
    truth = solve_ivp(motion, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.01).y
    # the signal is held over each step, half a step late
    np.testing.assert_allclose(q[:, 0], truth[0], atol=2e-3 * np.ptp(truth[0]))
    np.testing.assert_allclose(v[:, 0], truth[1], atol=3e-3 * np.ptp(truth[1]))


def test_equal_asymmetric_friction_is_viscous_friction(build, simulate) -> None:
    ctrl = _sine(4.0, 1.0, 1.0)
    both = simulate(build(SLIDE, {"asymmetric_friction": {"forward": 1.5, "backward": 1.5}}), ctrl)
    same = simulate(build(SLIDE, {"viscous_friction": {"coefficient": 1.5}}), ctrl)
    assert np.array_equal(both[0], same[0])


def test_asymmetric_friction_stays_calm_when_it_is_strong(build, simulate) -> None:
    """A coefficient that an explicit step could not take: 20000 N s/m on 2 kg at 1 ms."""
    _, v = simulate(build(SLIDE, {"asymmetric_friction": {"forward": 2e4}}), np.zeros((5, 1)), qvel=[1.0])
    assert (v[:, 0] >= 0).all() and v[-1, 0] < 1e-3


@pytest.mark.parametrize("velocity", [0.02, 0.1, 0.4])
def test_stribeck_friction_follows_its_equation(build, simulate, velocity) -> None:
    coulomb, static = 1.0, 1.8
    ctrl = _sine(2.6, 0.7, 3.0)
    gap = {"stribeck_friction": {"coulomb": coulomb, "static": static, "velocity": velocity}}
    q = simulate(build(SLIDE, gap), ctrl)[0][:, 0]
    truth = _with_dry_friction(
        ctrl,
        kinetic=lambda v, load: coulomb + (static - coulomb) * np.exp(-((v / velocity) ** 2)),
        static=lambda load: static,
    )
    flat = _with_dry_friction(ctrl, kinetic=lambda v, load: coulomb, static=lambda load: coulomb)
    assert np.abs(flat - truth).max() > 0.2 * np.ptp(truth)  # the effect matters here
    np.testing.assert_allclose(q, truth, atol=0.01 * np.ptp(truth))


def test_stribeck_friction_at_steady_speeds(build) -> None:
    """The friction itself, at each speed, is 3 % of (static - coulomb) from the curve."""
    coulomb, static, velocity = 0.5, 1.5, 0.2
    model = build(SLIDE, {"stribeck_friction": {"coulomb": coulomb, "static": static, "velocity": velocity}})
    data = mujoco.MjData(model)
    for speed in (-1.0, -0.25, -0.05, 0.02, 0.1, 0.2, 0.3, 0.5, 2.0):
        data.qvel[0] = speed
        mujoco.mj_forward(model, data)
        expected = -np.sign(speed) * (coulomb + (static - coulomb) * np.exp(-((speed / velocity) ** 2)))
        assert MASS * data.qacc[0] == pytest.approx(expected, abs=0.03), speed


@pytest.mark.parametrize(("force", "moves"), [(1.7, False), (1.9, True)])
def test_stribeck_friction_breaks_away_at_its_static_level(build, simulate, force, moves) -> None:
    model = build(SLIDE, {"stribeck_friction": {"coulomb": 1.0, "static": 1.8, "velocity": 0.05}})
    q, _ = simulate(model, np.full((2000, 1), force))
    assert (q[-1, 0] > 0.1) == moves and (moves or abs(q[-1, 0]) < 1e-3)


def test_a_level_stribeck_curve_is_coulomb_friction(build, simulate) -> None:
    ctrl = _sine(2.6, 0.7, 2.0)
    level = simulate(build(SLIDE, {"stribeck_friction": {"coulomb": 1.2, "static": 1.2}}), ctrl)[0]
    same = simulate(build(SLIDE, {"coulomb_friction": {"torque": 1.2}}), ctrl)[0]
    np.testing.assert_allclose(level, same, atol=1e-9)


@pytest.mark.parametrize("deflection", [0.002, 0.02])
def test_stribeck_friction_with_bristles_is_lugre_friction(build, deflection) -> None:
    """In steps of 0.1 ms: MuJoCo's is of the first order."""
    coulomb, static, velocity, ratio, step = 1.0, 1.8, 0.05, 0.4, 1e-4
    numbers = {"coulomb": coulomb, "static": static, "velocity": velocity, "deflection": deflection}
    stiffness = static / deflection
    damping = 2 * ratio * np.sqrt(stiffness * MASS)

    def motion(t, state):
        _, v, z = state
        level = coulomb + (static - coulomb) * np.exp(-((v / velocity) ** 2))
        bend = v - stiffness * abs(v) * z / level
        return [v, (2.6 * np.sin(4.4 * t) - stiffness * z - damping * bend) / MASS, bend]

    t = step * np.arange(20000)
    truth = solve_ivp(motion, (0, t[-1]), [0, 0, 0], t_eval=t, rtol=1e-7, atol=1e-9, max_step=1e-3).y[0]
    scene = SLIDE.replace(f'timestep="{STEP}"', f'timestep="{step}"')
    positions = {}
    for name, more in {"bristles": {"damping_ratio": ratio}, "rigid": {"deflection": 0.0}}.items():
        model = build(scene, {"stribeck_friction": numbers | more})
        data, positions[name] = mujoco.MjData(model), []
        for force in 2.6 * np.sin(4.4 * (t + step / 2)):
            positions[name].append(data.qpos[0])
            data.ctrl[0] = force
            mujoco.mj_step(model, data)
    off = {name: np.abs(np.array(q) - truth).max() / np.ptp(truth) for name, q in positions.items()}
    assert off["bristles"] < 0.01 < 0.03 < off["rigid"], off


def test_bristles_are_bent_as_far_as_they_stay_while_sliding(build) -> None:
    model = build(SLIDE, {"stribeck_friction": {"coulomb": 1.0, "static": 1.8, "velocity": 0.05, "deflection": 0.01}})
    data = mujoco.MjData(model)
    for speed in (-0.5, -0.03, 0.04, 1.0):
        data.qvel[0] = speed
        effects.bend_bristles(model, data.qvel, data.act)
        mujoco.mj_forward(model, data)
        level = 1.0 + 0.8 * np.exp(-((speed / 0.05) ** 2))
        assert MASS * data.qacc[0] == pytest.approx(-np.sign(speed) * level, rel=1e-3) and abs(data.act_dot[0]) < 1e-4
    data.qvel[0] = 0.0
    effects.bend_bristles(model, data.qvel, data.act)
    assert data.act[0] == 0.0


def test_a_fall_too_fast_for_the_time_step_stays_finite(build, simulate) -> None:
    model = build(SLIDE, {"stribeck_friction": {"coulomb": 1.0, "static": 100.0, "velocity": 1e-6}})
    q, v = simulate(model, _sine(150.0, 1.0, 2.0))
    assert np.isfinite(q).all() and np.abs(v).max() < 150 / MASS


@pytest.mark.parametrize("coefficient", [0.5, 3.0])
def test_quadratic_drag_slows_as_its_closed_form(build, simulate, coefficient) -> None:
    model = build(SLIDE, {"quadratic_drag": {"coefficient": coefficient}})
    for start in (3.0, -3.0):
        _, v = simulate(model, np.zeros((1000, 1)), qvel=[start])
        t = STEP * np.arange(1, 1001)
        closed = start / (1 + coefficient / MASS * abs(start) * t)
        np.testing.assert_allclose(v[:, 0], closed, atol=3e-3 * abs(start))


def test_quadratic_drag_has_a_terminal_speed(build, simulate) -> None:
    _, v = simulate(build(SLIDE, {"quadratic_drag": {"coefficient": 2.0}}), np.full((5000, 1), 8.0))
    assert v[-1, 0] == pytest.approx(np.sqrt(8.0 / 2.0), rel=1e-6)


def _with_load_friction(model: mujoco.MjModel, effect: effects.Effect, ctrl: np.ndarray) -> np.ndarray:
    """Positions [T] of MuJoCo's own loop, with the level of friction renewed before each step."""
    data, positions = mujoco.MjData(model), []
    own = model.dof_frictionloss.copy()
    for signal in ctrl:
        level = effect.friction(data.qfrc_actuator[None], ["slide"])
        assert level is not None
        model.dof_frictionloss[:], data.ctrl[:] = own + level[0], signal
        mujoco.mj_step(model, data)
        positions.append(data.qpos[0])
    return np.array(positions)


@pytest.mark.parametrize("coefficient", [0.1, 0.4])
def test_load_dependent_friction_follows_its_equation(build, coefficient) -> None:
    (effect,) = effects.load({"load_dependent_friction": {"coefficient": coefficient}})
    ctrl = _sine(3.0, 0.7, 3.0)
    q = _with_load_friction(build(SLIDE, {"load_dependent_friction": {"coefficient": coefficient}}), effect, ctrl)
    truth = _with_dry_friction(
        ctrl, kinetic=lambda v, load: coefficient * abs(load), static=lambda load: coefficient * abs(load)
    )
    np.testing.assert_allclose(q, truth, atol=0.01 * np.ptp(truth))


def test_load_dependent_friction_in_the_task_s_own_simulation(make_backend) -> None:
    """A motor that lifts a hanging pendulum loses 30 % of its torque; without a torque nothing is lost."""
    gap = {"load_dependent_friction": {"coefficient": 0.3, "at": ["hinge"]}}
    speeds = {}
    for name, action in (("free", 0.0), ("driven", 1.0)):
        for gap_name, effects_ in (("without", {}), ("with", gap)):
            backend = make_backend("pendulum", 2, effects_=effects_, changes={"sim_dt": 0.001})
            backend.reset(np.arange(2))
            backend.qpos[:], backend.qvel[:] = np.pi, 0.0 if name == "driven" else 1.0
            backend.send(np.full((2, 1), action))
            speeds[name, gap_name] = backend.qvel[0, 0]
    np.testing.assert_allclose(speeds["free", "with"], speeds["free", "without"], rtol=1e-9)
    assert speeds["driven", "with"] == pytest.approx(0.7 * speeds["driven", "without"], rel=0.02)


@pytest.mark.parametrize("play", [{"backlash": {"gap": 1e-4}}, {"flexible_joint": {"compliance": 1e-6}}])
def test_the_load_of_a_joint_is_that_of_its_rotor(make_backend, play) -> None:
    added = {}
    for name, gap in (("alone", {}), ("beside", play)):
        backend = make_backend("push", 1, effects_={"load_dependent_friction": {"coefficient": 0.2}} | gap)
        backend.reset(np.arange(1))
        own = backend.dry.own.copy()
        backend.send(np.ones((1, 2)))
        added[name] = (backend.dry.level - own)[0, :7]
    np.testing.assert_allclose(added["beside"], added["alone"], rtol=0.3, atol=0.3)
    assert added["alone"].max() > 1


def test_load_dependent_friction_does_not_outlive_an_episode(make_backend) -> None:
    backend = make_backend("push", 2, effects_={"load_dependent_friction": {"coefficient": 0.2}})
    backend.reset(np.arange(2))
    own = backend.dry.own.copy()
    backend.send(np.ones((2, 2)))
    assert (backend.dry.level[:, :7] > own[:, :7]).any()
    backend.reset(np.array([1]))
    assert np.array_equal(backend.dry.level[1], own[1]) and not np.array_equal(backend.dry.level[0], own[0])
