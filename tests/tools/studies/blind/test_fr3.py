"""Reality as MuJoCo computes it otherwise is the model's where nothing is hidden, and hides what it is told to."""

import mujoco
import numpy as np
import pytest

from tools.studies.blind import fr3
from tools.studies.blind.detect import LEAD
from tools.studies.blind.draw import COUNT, NOISE
from tools.studies.blind.plants import Array

TICK = 0.004
XML = fr3.build()
PLAIN = fr3.nominal(mujoco.MjModel.from_xml_string(XML))
HOME = np.array([0.0, -0.5, 0.0, -1.6, 0.0, 2.2, 0.3])
BEST = float(np.sqrt(NOISE["hinge"][0] ** 2 + COUNT["hinge"][0] ** 2 / 12))  # [rad] floor of the best encoder


def commands(ticks: int = 150) -> Array:
    t = np.arange(ticks)[:, None] * TICK
    return HOME + 0.15 * np.sin(4 * t * np.linspace(0.7, 1.3, 7)) ** 2


def run(
    numerics: fr3.Numerics = fr3.NUMERICS[0], ctrl: Array | None = None, q: Array = HOME, **change: float
) -> fr3.Run:
    """Reality with these parameters set on joint 4 (index 3)."""
    p = {k: x.copy() for k, x in PLAIN.items()}
    for name, value in change.items():
        p[name][(0, 3) if p[name].ndim == 2 else 0] = value
    return fr3.simulate(fr3.reality(XML, p, numerics), p, q, np.zeros(7), commands() if ctrl is None else ctrl, TICK)


def replay(step: float, real: fr3.Run, ctrl: Array, first: int) -> Array:
    """Plain MuJoCo of the nominal model, with friction as dry as it can be, from a true state on, [T - first, 7]."""
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.timestep = step
    model.dof_solimp[:, :3], model.dof_solref[:] = [0.99, 0.9999, 0.001], [1e-4, 1.0]
    data = mujoco.MjData(model)
    pull = (real.v[first + 1] - real.v[first - 1]) / (2 * TICK)
    data.qpos[:], data.qvel[:] = real.q[first], real.v[first] - step / 2 * pull  # its speeds are half a step old
    out = []
    for u in ctrl[first:]:
        out.append(data.qpos.copy())
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=round(TICK / step))
    return np.array(out)


@pytest.mark.parametrize("numerics", fr3.NUMERICS)
def test_without_effect_it_is_the_model_within_what_a_solver_must_allow_for(numerics: fr3.Numerics) -> None:
    ctrl, first = commands(), round(LEAD / TICK)
    real = run(numerics)
    coarse, fine = (replay(step, real, ctrl, first) for step in (0.0005, 0.00025))
    floor = 2 * np.abs(fine - coarse).max() + BEST  # of the simulator, as diagnose has it, and of the best encoder
    assert np.abs(real.q[first:] - fine).max() < floor < 4 * BEST
    assert np.abs(run(numerics, c_pos=PLAIN["c_pos"][0, 3] + 4.0).q[first:] - fine).max() > floor


def test_numerics_differ_from_the_model_and_agree_among_themselves() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    for numerics in fr3.NUMERICS:
        real = fr3.reality(XML, PLAIN, numerics)
        assert real.opt.timestep != model.opt.timestep
        assert real.opt.integrator != model.opt.integrator and real.opt.solver != model.opt.solver
    first, *others = (run(n).q for n in fr3.NUMERICS)
    assert all(np.abs(first - other).max() < 0.3 * BEST for other in others)


def test_dry_friction_holds_exactly_and_then_breaks_loose() -> None:
    kp, held = 3500.0, 3.0
    push = np.tile(HOME, (100, 1))
    push[:, 3] += np.where(np.arange(100) < 50, 0.9, 1.2) * held / kp
    q = run(ctrl=push, c_pos=held, c_neg=held).q[:, 3]
    assert np.all(q[:51] == HOME[3])
    creep = 1 - np.exp(-0.2 / 0.1)  # in 0.2 s, with the servo's damping time kv / kp
    assert np.isclose(q[-1] - HOME[3], creep * 0.2 * held / kp, rtol=0.02)


def test_a_delay_moves_the_command_and_a_gain_and_an_offset_change_it() -> None:
    alone = np.tile(HOME, (150, 1))
    alone[:, 3] = commands()[:, 3]
    now, late = run(ctrl=alone), run(ctrl=alone, delay=0.008)
    assert np.abs(late.q[2:, 3] - now.q[:-2, 3]).max() < 1e-9 < BEST < np.abs(late.q[:, 3] - now.q[:, 3]).max()
    still = np.tile(HOME, (150, 1))
    moved = [run(ctrl=still, c_pos=0, c_neg=0, **c).q[-1, 3] - HOME[3] for c in ({"offset": 0.01}, {"gain": 1.01})]
    assert np.allclose(moved, [0.01, 0.01 * HOME[3]], rtol=0.01)


def test_spring_and_load_pull_as_hard_as_they_should() -> None:
    still = np.tile(HOME, (200, 1))
    spring = run(ctrl=still, c_pos=0, c_neg=0, spring=50.0)
    assert np.isclose(spring.force[-1, 3], 50.0 * spring.q[-1, 3], rtol=1e-3)  # its own weight is compensated
    load = run(ctrl=still, c_pos=0, c_neg=0, payload=1.5)
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(XML))
    data.qpos[:] = load.q[-1]
    mujoco.mj_forward(model, data)
    jac, at = np.zeros((3, 7)), data.body("link7").xmat.reshape(3, 3)[:, 2]
    point = data.body("link7").xpos + at * (fr3.FLANGE + fr3.TOOL["tool_length"] - fr3.TOOL["tool_radius"])
    mujoco.mj_jac(model, data, jac, None, point, model.body("link7").id)
    assert np.isclose(load.force[-1, 3], 1.5 * 9.81 * jac[2, 3], rtol=1e-3)


@pytest.mark.parametrize(
    "sensor, drive", [({"sensor_offset": 2e-3}, {"offset": 2e-3}), ({"sensor_gain": 1.002}, {"gain": 1.002})]
)
def test_a_sensor_that_reads_too_much_shows_what_a_shifted_command_does(sensor: dict, drive: dict) -> None:
    q = HOME.copy()
    q[3] = (q[3] - sensor.get("sensor_offset", 0)) / sensor.get("sensor_gain", 1)  # so that both read the same at first
    assert np.abs(run(q=q, **sensor).clean - run(**drive).clean).max() < 0.3 * BEST
    assert np.abs(run().clean - run(**drive).clean).max() > 10 * BEST


@pytest.mark.parametrize("steps", [-1, 0, 1])
def test_a_force_is_read_when_the_encoders_are(steps: int) -> None:
    ctrl = commands()
    late = np.full(len(ctrl), steps) * (np.arange(len(ctrl)) > 0)
    real = fr3.simulate(fr3.reality(XML, PLAIN, fr3.NUMERICS[0]), PLAIN, HOME, np.zeros(7), ctrl, TICK, late)
    model = mujoco.MjModel.from_xml_string(XML)
    kp, kv = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    acting = np.roll(ctrl, 1, 0) if steps < 0 else ctrl  # before its tick, a row's command is not there yet
    felt = kp * (acting - real.clean) - kv * real.clean_speed
    assert np.abs(np.diff(ctrl, axis=0) * kp).max() > 1.0
    assert np.allclose(real.force[1:], felt[1:], atol=1e-6)


def test_callbacks_are_removed_whatever_happens() -> None:
    run(ctrl=commands(3))
    assert mujoco.get_mjcb_passive() is None and mujoco.get_mjcb_control() is None
    with pytest.raises(RuntimeError, match="on purpose"), fr3.callbacks(lambda m, d: None, lambda m, d: None):
        assert mujoco.get_mjcb_passive() is not None and mujoco.get_mjcb_control() is not None
        raise RuntimeError("on purpose")
    assert mujoco.get_mjcb_passive() is None and mujoco.get_mjcb_control() is None
