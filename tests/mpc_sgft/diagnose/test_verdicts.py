"""Known truths are found, named with an interval that holds them, and nothing is found where nothing is."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import yaml

from envs.effects import load
from mpc_sgft.diagnose import diagnose

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
    assert "data:image/svg+xml" in (out / "report.html").read_text()
    assert (out / "report.rrd").stat().st_size > 1000


def test_a_right_model_has_no_effect(slide, record) -> None:
    report = diagnose(slide, [record()], effects=FEW).as_dict()
    assert report["verdict"] == "none" and report["effects"] == [], report["reason"]


def test_a_wrong_mass_is_refitted_and_not_called_an_effect(slide, record) -> None:
    report = diagnose(slide, [record(mass=5.8)], effects=FEW, uncertain={"mass": 0.3}).as_dict()
    assert report["verdict"] == "none", report["reason"]
    assert abs(report["nominal_refit"]["mass cart"]["factor"] - 5.8 / 5.0) < 0.005
