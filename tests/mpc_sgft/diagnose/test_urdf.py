"""URDF as the nominal model: what it means, what it lacks, and a hidden friction found with it."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.matching import matched
from mpc_sgft.diagnose.data.measured import Offer, Table, write_csv
from mpc_sgft.diagnose.simulation.plant import driven, load_plant

TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def link(name: str, mass: float = 0.0, more: str = "") -> str:
    inertia = f'<inertia ixx="{0.02 * mass}" iyy="{0.02 * mass}" izz="{0.002 * mass}" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="0 0 -0.2"/><mass value="{mass}"/>{inertia}</inertial>' if mass else ""
    return f'<link name="{name}">{inertial}{more}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", z: float = -0.4, more: str = "") -> str:
    limit = '<limit lower="-3" upper="3" effort="40" velocity="9"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 {z}"/><axis xyz="0 1 0"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit if kind == "revolute" else ""}{more}</joint>'


BOX = '<collision><geometry><box size="0.1 0.1 0.4"/></geometry></collision>'
MESH = '<{0}><geometry><mesh filename="{1}"/></geometry></{0}>'
PENDULUM = [link("base", 1.0, BOX), link("arm", 1.0, BOX), joint("swing", "base", "arm", z=0)]
TWO = [*PENDULUM, link("fore", 0.5), joint("elbow", "arm", "fore")]


def write_urdf(path: Path, *parts: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<?xml version="1.0"?><robot name="r">{"".join(parts)}</robot>')
    return path


def test_it_becomes_mjcf_without_actuators(tmp_path: Path) -> None:
    plant = load_plant(write_urdf(tmp_path / "r.urdf", *TWO))
    assert (plant.joints, plant.actuators, plant.bare, plant.notes) == (["swing", "elbow"], [], True, ())
    assert plant.axes()["elbow"].high == 3.0
    again = mujoco.MjModel.from_xml_string(plant.spec.to_xml())
    np.testing.assert_allclose(again.body_mass, [0, 1, 0.5])
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "r.urdf")).nq == again.nq


def test_neighbours_do_not_collide_the_base_included(tmp_path: Path) -> None:
    path = write_urdf(tmp_path / "r.urdf", *PENDULUM)
    for model, touches in ((mujoco.MjModel.from_xml_path(str(path)), True), (load_plant(path).model, False)):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert (data.ncon > 0) == touches


def test_links_without_inertial_have_no_mass(tmp_path: Path) -> None:
    tool = [link("tool", 0.0, BOX), joint("fix", "arm", "tool", "fixed")]
    assert load_plant(write_urdf(tmp_path / "r.urdf", *PENDULUM, *tool)).model.body_mass[1] == pytest.approx(1.0)
    loose = [link("tool", 0.0, BOX), joint("loose", "arm", "tool")]
    with pytest.raises(UserError, match="joint 'loose' moves the link 'tool', which has no <inertial>"):
        load_plant(write_urdf(tmp_path / "r.urdf", *PENDULUM, *loose))
    held = [*loose, link("tip", 0.3), joint("fix", "tool", "tip", "fixed")]
    assert load_plant(write_urdf(tmp_path / "r.urdf", *PENDULUM, *held)).model.body_mass[2] == pytest.approx(0.3)


def test_meshes_are_found_in_their_package_or_left_out(tmp_path: Path) -> None:
    package = tmp_path / "my_robot"
    (package / "meshes").mkdir(parents=True)
    (package / "meshes" / "arm.obj").write_text(TETRAHEDRON)
    (package / "meshes" / "arm.dae").write_text("<COLLADA/>")
    shapes = [MESH.format("visual", "package://elsewhere/skin.dae"), MESH.format("collision", "package://gone/arm.stl")]
    shapes += [MESH.format("collision", f"package://my_robot/meshes/arm.{kind}") for kind in ("obj", "dae")]
    parts = [link("base", 1.0), link("arm", 1.0, "".join(shapes)), joint("swing", "base", "arm")]
    asked = '<mujoco><compiler discardvisual="false"/></mujoco>'
    plant = load_plant(write_urdf(package / "urdf" / "r.urdf", asked, *parts))
    assert plant.model.nmesh == plant.model.ngeom == 1
    (note,) = plant.notes
    assert "package://gone/arm.stl, package://my_robot/meshes/arm.dae" in note and "skin" not in note
    (package / "meshes").rename(tmp_path / "shapes")
    parts[1] = link("arm", 1.0, MESH.format("collision", "package://shapes/arm.obj"))  # a package beside its own
    assert load_plant(write_urdf(package / "urdf" / "r.urdf", *parts)).model.nmesh == 1
    parts[1] = link("arm", 1.0, MESH.format("collision", "../../shapes/arm.obj"))
    assert load_plant(write_urdf(package / "urdf" / "r.urdf", *parts)).model.nmesh == 1


def test_urdfs_that_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text('<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>')
    with pytest.raises(UserError, match="a xacro, not a URDF yet. Expand it first: xacro r.urdf"):
        load_plant(path)
    path.write_text("<robot><link name='a'>")
    with pytest.raises(UserError, match="MuJoCo cannot load this scene"):
        load_plant(path)
    with pytest.raises(UserError, match="MuJoCo cannot load this scene"):
        load_plant(write_urdf(path, link("a", 1.0), joint("j", "a", "nobody")))
    with pytest.raises(UserError, match="the model has no joint"):
        load_plant(write_urdf(path, link("a", 1.0), link("b", 1.0), joint("j", "a", "b", "fixed")))


def test_recorded_efforts_get_motors(tmp_path: Path) -> None:
    transmission = '<transmission name="t"><joint name="swing"/></transmission>'
    takes = '<joint name="elbow"><command_interface name="effort"/></joint>'
    control = f'<ros2_control name="c" type="system">{takes}</ros2_control>'
    plant = load_plant(write_urdf(tmp_path / "r.urdf", *TWO, transmission, control))
    alone = {"time": np.zeros(3), "qpos/swing": np.zeros(3), "qpos/elbow": np.zeros(3)}
    passive = driven(plant, [Table("run", alone)])
    assert passive.actuators == [] and "swing, elbow are driven, and no command was recorded" in passive.notes[0]
    moved = driven(plant, [Table("run", alone | {"ctrl/elbow": np.zeros(3)})])
    assert moved.actuators == ["elbow"] and "motors at elbow" in moved.notes[0]
    data = mujoco.MjData(moved.model)
    data.ctrl[0] = 2.5
    mujoco.mj_forward(moved.model, data)
    np.testing.assert_allclose(data.qfrc_actuator, [0, 2.5])  # N m, as commanded
    mjcf = load_plant(mujoco.MjSpec.from_string(plant.spec.to_xml()))
    assert driven(mjcf, [Table("run", alone | {"ctrl/elbow": np.zeros(3)})]) is mjcf


def test_commands_by_name_are_efforts_or_asked_about(tmp_path: Path) -> None:
    machine = load_plant(write_urdf(tmp_path / "r.urdf", *PENDULUM)).machine()
    columns = {"time": np.zeros(3), "q": np.zeros(3), "u": np.ones(3)}
    where = Offer("q", "qpos", "swing", "position")

    def found(*commands: Offer) -> Table:
        return matched(Table("run", columns, offers=(where, *commands)), machine)

    assert "ctrl/swing" in found(Offer("u", "ctrl", "swing", "effort")).columns
    assert "ctrl/swing" in found(Offer("u", "ctrl", "", "effort")).columns
    assert set(found().columns) == {"time", "u", "qpos/swing"}
    for command in (
        Offer("u", "ctrl", "swing", "position"),
        Offer("u", "ctrl", "", ""),
        Offer("u", "ctrl", "wrist", "effort"),
    ):
        with pytest.raises(UserError, match=r"a URDF knows no servos.*--map 'ctrl/swing=u'"):
            found(command)


@pytest.mark.parametrize("motor", [False, True])
def test_a_hidden_friction_is_found(motor: bool, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A pendulum of 1 kg, 0.2 m below its joint, I = 0.02 + 0.04 kg m^2, by equations of our own."""
    path, rng, drag = write_urdf(tmp_path / "r.urdf", *PENDULUM), np.random.default_rng(0), 0.03
    for k, angle in enumerate((0.9, -0.7)):
        q, v, h, rows = angle, 0.0, 1e-4, []
        command = 0.0
        for step in range(30_000):
            if motor and step % 3000 == 0:
                command = rng.uniform(-1, 1)
            if step % 50 == 0:
                rows.append((step * h, q + 1e-5 * rng.standard_normal(), command))
            v += h * (command - 9.81 * 0.2 * np.sin(q) - drag * v) / 0.06
            q += h * v
        time, seen, told = np.array(rows).T
        columns = {"time": time, "qpos/swing": seen} | ({"ctrl/swing": told} if motor else {})
        (tmp_path / "data").mkdir(exist_ok=True)
        write_csv(tmp_path / "data" / f"{k}.csv", columns)
    out, few = tmp_path / "out", "viscous_friction,coulomb_friction,payload"
    assert main(["--inspect", str(tmp_path / "data"), "--model", str(path)]) == 0
    assert "diagnose can use it" in capsys.readouterr().out
    given = ["--model", str(path), "--data", str(tmp_path / "data"), "--out", str(out), "--effects", few]
    assert main(given) == 0
    report = json.loads((out / "report.json").read_text())
    (effect,) = report["effects"]
    assert effect["name"] == "viscous_friction" and report["verdict"] == "effect"
    assert effect["parameters"]["coefficient"]["value"] == pytest.approx(drag, rel=0.03)
    assert any("motors at swing" in note for note in report["notes"]) == motor
    repaired = mujoco.MjModel.from_xml_path(str(out / "repaired.xml"))
    assert repaired.dof_damping[0] == pytest.approx(drag, rel=0.03) and repaired.nu == motor
