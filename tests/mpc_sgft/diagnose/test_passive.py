"""Motion without any command: a swing, with the motor left alone or no motor at all, from equations of our own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.data.measured import write_csv

DRAG = 0.04  # N m s/rad, hidden
MASS, LENGTH, SPIN = 1.0, 0.5, 0.02  # kg, m, kg m^2 of the link about its centre
SCENE = f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="link">
<joint name="j" type="hinge" axis="0 1 0"/>
<inertial pos="0 0 {-LENGTH}" mass="{MASS}" diaginertia="{SPIN} {SPIN} 0.001"/></body></worldbody>{{}}</mujoco>"""
MOTOR = '<actuator><motor name="m" joint="j"/></actuator>'


@pytest.fixture
def swings(tmp_path: Path) -> Path:
    release(tmp_path, DRAG)
    return tmp_path


def release(folder: Path, drag: float) -> None:
    """Releases at rest from three angles, 3 s each."""
    rng, t = np.random.default_rng(3), np.arange(0, 3, 0.005)
    inertia, weight = SPIN + MASS * LENGTH**2, MASS * 9.81 * LENGTH
    for k, angle in enumerate((0.4, 0.8, -0.6)):
        swing = solve_ivp(
            lambda _, x: (x[1], (-weight * np.sin(x[0]) - drag * x[1]) / inertia),
            (0, 3),
            (angle, 0.0),
            t_eval=t,
            rtol=1e-10,
            atol=1e-12,
        )
        q = swing.y[0] + 1e-4 * rng.standard_normal(len(t))
        write_csv(folder / f"release{k}.csv", {"time": t, "qpos/j": q, "ctrl/m": np.zeros(len(t))})


@pytest.mark.parametrize("motor", ["", MOTOR])
def test_a_free_swing_tells_its_friction(motor: str, swings: Path) -> None:
    (swings / "scene.xml").write_text(SCENE.format(motor))
    if not motor:
        for path in swings.glob("*.csv"):
            columns = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
            write_csv(path, {n: columns[n] for n in ("time", "qpos/j")})
    few = ["viscous_friction", "coulomb_friction", "payload", "actuator_offset"]
    if motor:
        few += ["torque_saturation"]
        with pytest.raises(UserError, match="torque_saturation: it needs an actuator that does something"):
            diagnose(swings / "scene.xml", sorted(swings.glob("*.csv")), effects=few)
        few.remove("torque_saturation")
    else:
        few.remove("actuator_offset")
    report = diagnose(swings / "scene.xml", sorted(swings.glob("*.csv")), effects=few).as_dict()
    (effect,) = report["effects"]
    assert report["verdict"] == "effect" and effect["name"] == "viscous_friction", report["reason"]
    found = effect["parameters"]["coefficient"]
    assert found["value"] == pytest.approx(DRAG, rel=0.02) and found["low"] <= DRAG <= found["high"]
    assert report["held_out"]["repaired"] < 0.05 * report["held_out"]["nominal"]


def test_where_all_is_still_when_the_held_out_part_begins_the_report_says_so(tmp_path: Path, swings: Path) -> None:
    folder = tmp_path / "still"
    folder.mkdir()
    (swings / "scene.xml").write_text(SCENE.format(MOTOR))
    release(folder, 2.0)  # near critical damping: the end of each recording is at rest
    notes = []
    for recordings in (swings, folder):
        data = sorted(recordings.glob("*.csv"))
        report = diagnose(swings / "scene.xml", data, effects=["viscous_friction"]).as_dict()
        assert [e["name"] for e in report["effects"]] == ["viscous_friction"]
        notes.append([note for note in report["notes"] if "hardly shows what is missing" in note])
    assert not notes[0] and len(notes[1]) == 1 and "--held-out" in notes[1][0]


def test_without_a_restriction_a_motor_left_alone_is_no_suspect(swings: Path) -> None:
    (swings / "scene.xml").write_text(SCENE.format(MOTOR))
    report = diagnose(swings / "scene.xml", sorted(swings.glob("*.csv")), max_effects=1).as_dict()
    tried = {name.split("@")[0] for row in report["candidates"] for name in row["effects"]}
    assert [e["name"] for e in report["effects"]] == ["viscous_friction"]
    assert not tried & {"torque_saturation", "actuator_gain", "actuator_delay", "actuator_lag", "deadband"}
