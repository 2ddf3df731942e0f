"""A gear has play: the motor turns a little before the joint follows."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect
from envs.effects.rotor import couplings, driven_joints


@dataclass(frozen=True)
class Backlash(Effect):
    """Let motor and joint move apart by `gap` to either side before one pushes the other.

    Each joint's actuators drive a rotor of their own, `rotor/<joint>`, which takes over the joint's armature; a joint
    without one gives it `inertia`, which stays part of the whole, or 5 % of its own if that is 0. Servos follow their
    motor, whose position is the actuator's length; friction stays at the joint. No play changes nothing.
    """

    gap: float = 0.0  # half of the play, at the joint
    inertia: float = 0.0  # of the rotor, at the joint, for joints without armature
    at: tuple[str, ...] = ()  # joints; all hinges and slides with an actuator if empty
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"gap": "rad or m", "inertia": "kg m^2 or kg"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"gap": (0.0, 10.0), "inertia": (0.0, 1e4)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        joints = driven_joints(spec, self.at, "backlash")
        for coupling in couplings(spec, joints, self.inertia, "backlash") if self.gap else []:
            coupling.widen(self.gap)


EFFECT = Backlash
