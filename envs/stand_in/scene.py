"""What the task has around the arm, its object and its tool, in the scene of franky-sim: its arm, our things."""

from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

ALL, SCENE_BIT = 1, 8  # contact bits: what franky-sim's own geoms answer to, and one that only the tool shares


def furnish(worldbody: Element, model: mujoco.MjModel) -> str:
    """Put a task's fixed geoms, its loose object and its tool into franky-sim's world, where one robot stands already.

    The arm stays franky-sim's own. Its hand stays too; the task's tool reaches past the fingers.

    Args:
        worldbody: Of franky-sim's scene, after `add_robot`.
        model: The task's nominal scene: an FR3 of envs/fr3.py and one free body.

    Returns:
        Name of the loose object's joint.

    Raises:
        ValueError: If the task has not exactly one loose object, or franky-sim's arm is not built as expected.
    """
    loose = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    if len(loose) != 1:
        raise ValueError(f"the stand-in needs a task with one loose object; this one has {len(loose)}")
    for geom in [g for g in worldbody if g.get("name") == "ground"]:
        worldbody.remove(geom)
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] == 0:
            contact = int(model.geom_contype[geom]) and ALL | SCENE_BIT
            _geom(worldbody, model, geom, contype=contact, conaffinity=contact)
    body = int(model.jnt_bodyid[loose[0]])
    name = model.joint(loose[0]).name
    element = SubElement(worldbody, "body", name=model.body(body).name, pos=_text(model.qpos0[7:10]))
    SubElement(element, "freejoint", name=name)
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        _geom(element, model, geom, contype=ALL | SCENE_BIT, conaffinity=ALL | SCENE_BIT, priority=1)
    wrist = next((e for e in worldbody.iter("body") if (e.get("name") or "").endswith("fr3_link7")), None)
    if wrist is None:
        raise ValueError("franky-sim's arm has no fr3_link7: this version of franky-sim is built differently")
    _geom(wrist, model, model.geom("tool").id, contype=SCENE_BIT, conaffinity=SCENE_BIT)
    return name


def _geom(parent: Element, model: mujoco.MjModel, geom: int, **bits: int) -> None:
    attributes = {
        "name": f"task_{model.geom(geom).name}",
        "type": mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower(),
        "size": _text(model.geom_size[geom]),
        "pos": _text(model.geom_pos[geom]),
        "quat": _text(model.geom_quat[geom]),
        "rgba": _text(model.geom_rgba[geom]),
        "friction": _text(model.geom_friction[geom]),
        **{key: str(value) for key, value in bits.items()},
    }
    body = int(model.geom_bodyid[geom])
    if model.geom(geom).name == "tool":
        attributes["mass"] = "0.1"  # as the tool of envs/fr3.py
    elif body:
        attributes["mass"] = repr(float(model.body_mass[body]) / int(model.body_geomnum[body]))
    SubElement(parent, "geom", attributes)


def _text(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)
