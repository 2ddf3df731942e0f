"""A drive is elastic: gear, belt or shaft twist under load, and the joint rings after the motor."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect
from envs.effects.rotor import couplings, driven_joints


@dataclass(frozen=True)
class FlexibleJoint(Effect):
    """Put a spring between motor and joint, as M. W. Spong, J. Dyn. Sys. Meas. Control 109(4), 1987, models it.

    Rotors are those of `backlash`. With both, the spring pulls beyond the play. A spring that the physics step cannot
    follow, above one radian of its oscillation a step, is made as stiff as it can; no compliance changes nothing.
    """

    compliance: float = 0.0  # twist under 1 N m, or travel under 1 N, at the joint
    damping_ratio: float = 0.05  # of rotor and joint against each other
    inertia: float = 0.0  # of the rotor, at the joint, for joints without armature
    at: tuple[str, ...] = ()  # joints; all hinges and slides with an actuator if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {
        "compliance": "rad/(N m) or m/N",
        "damping_ratio": "1",
        "inertia": "kg m^2 or kg",
    }
    bounds: ClassVar[dict[str, tuple[float, float]]] = {
        "compliance": (0.0, 1e3),
        "damping_ratio": (0.0, 10.0),
        "inertia": (0.0, 1e4),
    }

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        joints = driven_joints(spec, self.at, "flexible_joint")
        for coupling in couplings(spec, joints, self.inertia, "flexible_joint") if self.compliance else []:
            coupling.soften(self.compliance, self.damping_ratio, spec.option)


EFFECT = FlexibleJoint
