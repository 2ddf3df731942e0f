"""Scenes of several files, and those that a diagnosis repaired."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from mpc_sgft.diagnose.simulation.plant import load_plant
from mpc_sgft.diagnose.verdict.repair import nominal_spec

PYRAMID = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ROBOT = """<mujoco model="robot"><compiler meshdir="assets"/><asset><mesh name="t" file="t.obj"/></asset>
<worldbody><body name="b"><joint name="x" type="slide"/><geom type="mesh" mesh="t"/></body></worldbody></mujoco>"""
ATTACHED = """<mujoco><asset><model name="r" file="robot/robot.xml"/></asset>
<worldbody><frame><attach model="r" body="b" prefix="p_"/></frame></worldbody></mujoco>"""


@pytest.mark.parametrize("kind", ["robot", "spec", "attached", "stripped"])
def test_a_scene_written_elsewhere_finds_its_meshes(kind: str, tmp_path: Path) -> None:
    (tmp_path / "robot" / "assets").mkdir(parents=True)
    (tmp_path / "robot" / "assets" / "t.obj").write_text(PYRAMID)
    robot, scene = tmp_path / "robot" / "robot.xml", tmp_path / "scene.xml"
    robot.write_text(ROBOT)
    scene.write_text(ATTACHED)
    if kind == "stripped":
        stripped = ROBOT.replace("<compiler", '<compiler strippath="true"').replace('"t.obj"', '"gone/t.obj"')
        robot.write_text(stripped)
    given = {"attached": scene, "spec": mujoco.MjSpec.from_file(str(robot))}.get(kind, robot)
    (tmp_path / "out").mkdir()
    written = tmp_path / "out" / "repaired.xml"
    written.write_text(load_plant(given).spec.to_xml())
    assert mujoco.MjModel.from_xml_path(str(written)).nmesh == 1


def test_a_command_history_that_no_delay_needs_is_in_no_state_and_in_the_repaired_scene(tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body></worldbody><actuator>'
        '<motor name="a" joint="x" nsample="200"/><motor name="b" joint="x" nsample="30" delay=".01"/></actuator>'
        "</mujoco>"
    )
    plant = load_plant(scene)
    assert plant.model.actuator_history[:, 0].tolist() == [0, 30]
    kept = nominal_spec(plant)
    assert kept.compile().actuator_history[:, 0].tolist() == [200, 30]
