"""A spring at a joint that nobody modelled: a cable, a hose, a counterbalance."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import SPRING, Effect
from envs.effects.passive import plain, scalar_joints, unused_name


@dataclass(frozen=True)
class JointStiffness(Effect):
    """Pull joints towards `rest` with -stiffness (q - rest).

    `jnt_stiffness` carries it; a joint that has a spring already gets a second one along a tendon.
    """

    stiffness: float = 0.0
    rest: float = 0.0
    at: tuple[str, ...] = ()  # joints; all hinges and slides if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"stiffness": "N m/rad or N/m", "rest": "rad or m"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"stiffness": (0.0, 1e6), "rest": (-100.0, 100.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in scalar_joints(spec, self.at):
            if not np.any(joint.stiffness):
                in_degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
                joint.stiffness[0] = self.stiffness
                joint.springref = np.rad2deg(self.rest) if in_degrees else self.rest
            else:
                tendon = plain(spec.add_tendon(name=unused_name(spec.tendons, f"{SPRING}{joint.name}")), "tendon")
                tendon.wrap_joint(joint.name, 1.0)
                tendon.stiffness[0], tendon.springlength = self.stiffness, [self.rest, self.rest]


EFFECT = JointStiffness
