"""Known truths are found, named with an interval that holds them, and nothing is found where nothing is."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import yaml

from envs.effects import load
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.data.measured import write_csv

SANDER = """<mujoco><option timestep="0.002"/><worldbody><geom name="table" type="plane" size="2 2 0.1" friction="0.6"/>
<body name="block" pos="0 0 0.05"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<geom name="foot" type="box" size="0.05 0.05 0.05" mass="2" friction="0.6"/></body></worldbody>
<actuator><motor name="pull" joint="x" gear="10"/><motor name="press" joint="z" gear="10"/></actuator></mujoco>"""
SERVO = """<mujoco><option timestep="0.002"/><worldbody><body name="arm"><joint name="hinge" axis="0 -1 0"/>
<inertial pos="0 0 -0.2" mass="1" diaginertia="0.02 0.02 0.001"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="47" kv="2.9" {}/></actuator></mujoco>"""
GEARED = """<mujoco><option timestep="0.002"/><worldbody><body name="table"><joint name="x" type="slide" axis="1 0 0"
damping="4" armature="2"/><geom size="0.1" mass="3"/></body></worldbody>
<actuator><motor name="motor" joint="x" gear="10"/></actuator></mujoco>"""
FEW = ["viscous_friction", "coulomb_friction", "quadratic_drag", "actuator_delay", "actuator_offset"]


def test_coulomb_friction_is_named_and_repaired(slide, record, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = diagnose(slide, [record(coulomb=2.0)], out=out, effects=FEW).as_dict()
    assert report["verdict"] == "effect", report["reason"]
    (effect,) = report["effects"]
    torque = effect["parameters"]["torque"]
    assert effect["name"] == "coulomb_friction" and effect["at"] == ["x"]
    assert torque["low"] <= 2.0 <= torque["high"] and torque["high"] - torque["low"] < 0.4
    assert report["held_out"]["low"] > 0.8
    mapping = yaml.safe_load((out / "effects.yaml").read_text())["effects"]
    assert [type(e).__name__ for e in load(mapping)] == ["CoulombFriction"]
    loss = mujoco.MjModel.from_xml_path(str(out / "repaired.xml")).dof_frictionloss[0]
    assert abs(loss - torque["value"]) < 1e-5  # MJCF text has six digits
    assert json.loads((out / "report.json").read_text()) == json.loads(json.dumps(report))
    assert "<svg viewBox=" in (out / "report.html").read_text()
    assert (out / "report.rrd").stat().st_size > 1000


def test_a_right_model_has_no_effect(slide, record) -> None:
    report = diagnose(slide, [record()], effects=FEW).as_dict()
    assert report["verdict"] == "none" and report["effects"] == [], report["reason"]


def test_a_wrong_mass_is_refitted_and_not_called_an_effect(slide, record) -> None:
    report = diagnose(slide, [record(mass=5.8)], effects=FEW, uncertain={"mass": 0.3}).as_dict()
    assert report["verdict"] == "none", report["reason"]
    assert abs(report["nominal_refit"]["mass cart"]["factor"] - 5.8 / 5.0) < 0.005


def test_a_surface_that_is_slipperier_is_told_from_a_dry_joint_by_pressing(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(SANDER)
    model.opt.timestep, model.geom_friction[:, 0] = 2e-4, 0.3
    data, dt, rng = mujoco.MjData(model), 0.004, np.random.default_rng(0)
    t = np.arange(1000) * dt
    pull = sum(2.4 / k * np.cos(2 * np.pi * k * 0.6 * t + k) for k in (1, 2, 3))
    ctrl, read = np.stack([pull, -1 - np.sin(2 * np.pi * 0.37 * t)], 1), []
    mujoco.mj_step(model, data, 2000)  # until it has settled
    for command in ctrl:
        read.append(data.qpos + 2e-5 * rng.standard_normal(2))
        data.ctrl[:] = command
        mujoco.mj_step(model, data, round(dt / model.opt.timestep))
    columns = {
        "time": t,
        "ctrl/pull": ctrl[:, 0],
        "ctrl/press": ctrl[:, 1],
        "qpos/x": np.array(read)[:, 0],
        "qpos/z": np.array(read)[:, 1],
    }
    (tmp_path / "sander.xml").write_text(SANDER)
    write_csv(tmp_path / "sander.csv", columns)
    few = ["contact_friction", "coulomb_friction"]
    report = diagnose(tmp_path / "sander.xml", [tmp_path / "sander.csv"], effects=few).as_dict()
    assert [e["name"] for e in report["effects"]] == ["contact_friction"] and report["effects"][0]["at"] == ["foot"]
    assert abs(report["effects"][0]["parameters"]["coefficient"]["value"] - 0.3) < 0.003
    assert report["held_out"]["low"] > 0.9


def test_a_servo_that_saturates_once_is_found(tmp_path: Path) -> None:
    """One window of eight shows it, where a saturated servo keeps an error of the start that a stiff one forgets."""
    model = mujoco.MjModel.from_xml_string(SERVO.format('forcerange="-0.5 0.5"'))
    model.opt.timestep, model.opt.integrator = 2e-4, int(mujoco.mjtIntegrator.mjINT_RK4)
    data, dt, rng = mujoco.MjData(model), 0.002, np.random.default_rng(0)
    t = np.arange(4000) * dt
    u = 0.08 * np.sin(2 * t) + 0.45 * np.exp(-(((t - 3.35) / 0.2) ** 2))
    q = []
    for command in u:
        q.append(data.qpos[0] + 2e-5 * rng.standard_normal())
        data.ctrl[:] = command
        mujoco.mj_step(model, data, round(dt / model.opt.timestep))
    (tmp_path / "servo.xml").write_text(SERVO.format(""))
    write_csv(tmp_path / "servo.csv", {"time": t, "ctrl/servo": u, "qpos/hinge": np.array(q)})
    few = ["torque_saturation", "viscous_friction"]
    report = diagnose(tmp_path / "servo.xml", [tmp_path / "servo.csv"], effects=few).as_dict()
    assert [e["name"] for e in report["effects"]] == ["torque_saturation"], report["reason"]
    assert abs(report["effects"][0]["parameters"]["limit"]["value"] - 0.5) < 0.005


def test_an_elastic_drive_is_told_from_a_load_and_a_gain(tmp_path: Path) -> None:
    """Rotor and table of a spindle that twists, by an integrator of its own; eight hertz against each other."""
    stiffness, dt, table, rotor = 3000.0, 0.004, 3.0, 2.0
    damping = 2 * 0.02 * np.sqrt(stiffness * table * rotor / (table + rotor))
    t, rng, h, read = np.arange(1500) * dt, np.random.default_rng(0), dt / 40, []
    u = sum(1.5 / np.sqrt(k) * np.cos(2 * np.pi * k * 0.37 * t + k * k) for k in (1, 2, 3, 5, 8, 13))
    q = v = turn = speed = 0.0
    for command in u.tolist():
        read.append(q)
        for _ in range(40):
            pull = stiffness * (turn - q) + damping * (speed - v)
            v, speed = v + h * (pull - 4 * v) / table, speed + h * (10 * command - pull) / rotor
            q, turn = q + h * v, turn + h * speed
    read = np.array(read) + 2e-5 * rng.standard_normal(len(t))
    (tmp_path / "spindle.xml").write_text(GEARED)
    write_csv(tmp_path / "spindle.csv", {"time": t, "ctrl/motor": u, "qpos/x": read})
    few = ["payload", "actuator_gain", "flexible_joint"]
    report = diagnose(tmp_path / "spindle.xml", [tmp_path / "spindle.csv"], effects=few).as_dict()
    assert [e["name"] for e in report["effects"]] == ["flexible_joint"], report["reason"]
    compliance = report["effects"][0]["parameters"]["compliance"]
    assert abs(compliance["value"] * stiffness - 1) < 0.02 and compliance["low"] * stiffness < 1.01
    assert report["held_out"]["reduction"] > 0.8
