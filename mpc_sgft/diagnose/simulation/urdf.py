"""URDF as a scene of plain MJCF: what ROS means by it, without the pictures.

A URDF names no actuators that MuJoCo knows. Joints whose efforts were recorded get motors (`driven` in plant.py); the
others are passive. Links without `<inertial>` have no mass. Neighbours do not collide, the fixed base included.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import mujoco

from mpc_sgft.command.errors import UserError

MESHES = (".stl", ".obj", ".msh")


class Urdf(NamedTuple):
    """The scene, what was left out of it, in words, and the joints that it says are driven."""

    spec: mujoco.MjSpec
    notes: tuple[str, ...]
    driven: tuple[str, ...]


def is_urdf(path: Path) -> bool:
    """Whether a model file is a URDF: its root is `robot`.

    Raises:
        UserError: If it is a xacro, which ROS must expand.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError):
        return False  # MuJoCo says better what is wrong
    if root.tag == "robot" and any("ros.org/wiki/xacro" in element.tag for element in root.iter()):
        raise UserError(f"{path}: a xacro, not a URDF yet. Expand it first: xacro {path.name} > robot.urdf")
    return root.tag == "robot"


def read_urdf(path: Path) -> Urdf:
    """A URDF as MJCF.

    Raises:
        UserError: If a link moves and has no mass.
        ValueError: If MuJoCo cannot load it.
    """
    root = ElementTree.parse(path).getroot()
    notes = []
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    if lost := _resolve_meshes(root, path):
        notes.append(f"shapes without a file that MuJoCo can load do not collide: {', '.join(lost)}")
    massless = {str(link.get("name")) for link in root.iter("link") if link.find("inertial") is None}
    _check_masses(path, root, massless)
    compiler = _child(_child(root, "mujoco"), "compiler")
    compiler.attrib.pop("meshdir", None)
    compiler.set("strippath", "false")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    for body in spec.bodies:
        if body.name in massless:
            for geom in body.geoms:
                geom.mass = 0.0
    spec.compile()
    plain = mujoco.MjSpec.from_string(spec.to_xml())
    for body in plain.worldbody.bodies:  # MuJoCo lets neighbours touch where one of them is the world
        plain.add_exclude(bodyname1="world", bodyname2=body.name)
    return Urdf(plain, tuple(notes), _driven(root))


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if found is None else found


def _resolve_meshes(root: ElementTree.Element, path: Path) -> list[str]:
    """Give meshes their files; shapes whose mesh has none are taken out.

    Returns:
        The meshes that were taken out.
    """
    compiler = root.find("mujoco/compiler")
    folder = "" if compiler is None else compiler.get("meshdir", "")
    lost = []
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            file = _file(name, path.resolve().parent, folder)
            if file is None or file.suffix.lower() not in MESHES:
                lost.append(name)
                link.remove(collision)
            else:
                mesh.set("filename", str(file))
    return lost


def _file(name: str, here: Path, folder: str) -> Path | None:
    """Where a mesh is: beside the URDF, in its meshdir, or in the package that it names, above or beside the URDF."""
    if name.startswith("package://"):
        package, _, rest = name.removeprefix("package://").partition("/")
        places = [parent / package / rest for parent in (here, *here.parents)]
    else:
        places = [here / name.removeprefix("file://")]
    places.append(here / folder / Path(name).name)
    return next((p.resolve() for p in places if p.is_file()), None)


def _check_masses(path: Path, root: ElementTree.Element, massless: set[str]) -> None:
    """Every joint that moves must move a mass, its own link's or that of one fixed to it."""
    joints = [(j.get("type"), _link(j, "parent"), _link(j, "child"), j.get("name")) for j in root.findall("joint")]
    for kind, _, child, name in joints:
        rigid, more = {child}, {child}
        while kind != "fixed" and more:
            more = {c for k, p, c, _ in joints if k == "fixed" and p in rigid} - rigid
            rigid |= more
        if kind != "fixed" and rigid <= massless:
            raise UserError(
                f"{path}: joint {name!r} moves the link {child!r}, which has no <inertial>. Give it a mass."
            )


def _link(joint: ElementTree.Element, role: str) -> str:
    found = joint.find(role)
    return "" if found is None else str(found.get("link"))


def _driven(root: ElementTree.Element) -> tuple[str, ...]:
    """Joints with a transmission or a command interface of ros2_control."""
    names = [str(j.get("name")) for j in root.findall("transmission/joint")]
    for joint in root.findall("ros2_control/joint"):
        if joint.find("command_interface") is not None:
            names.append(str(joint.get("name")))
    return tuple(dict.fromkeys(names))
