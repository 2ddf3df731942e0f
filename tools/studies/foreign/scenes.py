"""The machines of the foreign engines, as numbers and as the nominal MJCF that the solver gets.

All are planar chains: a carriage on a rail or a hinge first, then rods that hang from hinges. Angles are zero where a
rod hangs straight down or lies along the one before it, and positive toward +x. Numbers: mass m [kg], distance c [m] of
its centre from the joint, length l [m], inertia i [kg m^2] about the centre, of each body; armature, damping, dry
friction, gear, kp, kv and limit of each joint.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from tools.studies.blind.plants import Array
from tools.studies.blind.truths import rows

TIMESTEP = 0.002  # [s] of the nominal MJCF
BODY = ("m", "c", "l", "i")
Range = tuple[float, float]
_FRICTION = ("viscous_friction", "coulomb_friction", "asymmetric_friction", "stribeck_friction", "quadratic_drag")
_DRIVE = ("actuator_delay", "actuator_lag", "torque_saturation", "deadband", "actuator_offset")
_GEAR = ("backlash", "flexible_joint")
_SENSOR = ("sensor_gain", "sensor_offset")


class Scene(NamedTuple):
    """One kind of machine.

    Attributes:
        name: Its name.
        kinds: "slide" or "hinge" for each joint.
        joints: Their names.
        actuators: Their names; actuator i drives joint i.
        servo: Whether they are position servos (command: target) rather than motors (command: force / gear).
        ranges: Of the numbers above, one each joint; some other numbers are 0.
        sites: Effect -> joints at which it may be hidden.
        outside: The same of what the library lacks.
        swings: Whether it may be recorded in free swings.
    """

    name: str
    kinds: tuple[str, ...]
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    servo: bool
    ranges: Mapping[str, tuple[Range, ...]]
    sites: Mapping[str, tuple[int, ...]]
    outside: Mapping[str, tuple[int, ...]]
    swings: bool

    @property
    def n(self) -> int:
        return len(self.joints)

    @property
    def tip(self) -> str:
        return f"body{self.n - 1}"


def _sites(*names: str, joints: tuple[int, ...] = (0,)) -> dict[str, tuple[int, ...]]:
    return {name: joints for name in names}


_OUTSIDE = _sites("cogging", "position_dependent_friction", "temperature_drift")
_CARRIAGE, _ROD = {"c": (0.0, 0.0), "l": (0.0, 0.0), "i": (0.01, 0.01)}, {"c": (0.15, 0.22), "l": (0.32, 0.42)}


def _bodies(*bodies: Mapping[str, Range]) -> dict[str, tuple[Range, ...]]:
    return {k: tuple(b[k] for b in bodies) for k in BODY}


SCENES: dict[str, Scene] = {
    "screw": Scene(  # a table on a ball screw: the motor's inertia is that of several tables
        "screw",
        ("slide",),
        ("table",),
        ("motor",),
        False,
        _bodies(_CARRIAGE | {"m": (5, 15)})
        | {"armature": ((10, 40),), "damping": ((10, 60),), "gear": ((200, 600),), "limit": ((2000, 2000),)},
        _sites(*_FRICTION, *_DRIVE, "load_dependent_friction", "joint_stiffness", *_GEAR, "payload", "actuator_gain"),
        _OUTSIDE,
        False,
    ),
    "slide": Scene(
        "slide",
        ("slide",),
        ("carriage",),
        ("motor",),
        False,
        _bodies(_CARRIAGE | {"m": (2, 8)})
        | {"armature": ((0.5, 2),), "damping": ((2, 8),), "gear": ((10, 30),), "limit": ((150, 150),)},
        _sites(*_FRICTION, *_DRIVE, "load_dependent_friction", "joint_stiffness", *_GEAR, "payload", "actuator_gain"),
        _OUTSIDE,
        False,
    ),
    "servo": Scene(  # a pendulum on a servo whose current is limited
        "servo",
        ("hinge",),
        ("shaft",),
        ("servo",),
        True,
        _bodies(_ROD | {"m": (0.4, 1.2), "i": (0.004, 0.01)})
        | {"armature": ((0.01, 0.04),), "damping": ((0.02, 0.1),), "kp": ((25, 60),), "kv": ((1.2, 3),)}
        | {"limit": ((20, 20),)},
        _sites(*_FRICTION, *_DRIVE, *_SENSOR, "actuator_gain", "payload", "armature", *_GEAR, "joint_stiffness"),
        _OUTSIDE,
        False,
    ),
    "pendulum": Scene(
        "pendulum",
        ("hinge",),
        ("hinge",),
        ("motor",),
        False,
        _bodies(_ROD | {"m": (0.6, 1.6), "i": (0.004, 0.012)})
        | {"armature": ((0.01, 0.03),), "damping": ((0.01, 0.06),), "gear": ((4, 8),), "limit": ((30, 30),)},
        _sites(*_FRICTION, *_DRIVE, *_SENSOR, "actuator_gain", "payload", "armature", *_GEAR, "gravity_tilt"),
        _OUTSIDE,
        True,
    ),
    "arm": Scene(
        "arm",
        ("hinge", "hinge"),
        ("shoulder", "elbow"),
        ("motor0", "motor1"),
        False,
        _bodies(_ROD | {"m": (1.5, 3), "i": (0.01, 0.03)}, _ROD | {"m": (0.8, 1.8), "i": (0.006, 0.015)})
        | {"armature": ((0.05, 0.12), (0.0, 0.0)), "damping": ((0.05, 0.2), (0.03, 0.1))}
        | {"gear": ((10, 20), (5, 10)), "limit": ((80, 80), (40, 40))},
        _sites(*_FRICTION, *_DRIVE, *_SENSOR, "actuator_gain", joints=(0, 1))
        | _sites("payload", joints=(1,))
        | _sites("gravity_tilt", "armature", *_GEAR),
        _OUTSIDE | _sites("cogging", "position_dependent_friction", joints=(0, 1)),
        True,
    ),
    "cartpole": Scene(
        "cartpole",
        ("slide", "hinge"),
        ("cart", "pole"),
        ("motor",),
        False,
        _bodies(_CARRIAGE | {"m": (1.5, 4)}, _ROD | {"m": (0.2, 0.6), "i": (0.003, 0.01)})
        | {"armature": ((0.0, 0.0),) * 2, "damping": ((1, 4), (0.001, 0.004))}
        | {"gear": ((10, 20), (0, 0)), "limit": ((100, 100), (0, 0))},
        _sites(*_FRICTION, *_DRIVE, "actuator_gain", "joint_stiffness")
        | _sites("viscous_friction", "coulomb_friction", "sensor_gain", joints=(0, 1))
        | _sites("payload", joints=(1,))
        | _sites("gravity_tilt"),
        _OUTSIDE,
        False,
    ),
    "arm3": Scene(
        "arm3",
        ("hinge",) * 3,
        ("shoulder", "elbow", "wrist"),
        ("motor0", "motor1", "motor2"),
        False,
        _bodies(
            _ROD | {"m": (2, 3), "i": (0.01, 0.03)},
            _ROD | {"m": (1, 2), "i": (0.008, 0.015)},
            _ROD | {"m": (0.5, 1), "i": (0.004, 0.01)},
        )
        | {"armature": ((0.05, 0.12), (0.0, 0.0), (0.0, 0.0)), "damping": ((0.1, 0.3), (0.05, 0.2), (0.03, 0.1))}
        | {"gear": ((15, 30), (8, 15), (4, 8)), "limit": ((120, 120), (60, 60), (30, 30))},
        _sites("viscous_friction", "coulomb_friction", "actuator_gain", "actuator_offset", joints=(0, 1, 2))
        | _sites("payload", joints=(2,)),
        _OUTSIDE | _sites("cogging", joints=(0, 1, 2)),
        False,
    ),
}


def draw_nominal(scene: Scene, rng: np.random.Generator) -> dict[str, list[float]]:
    """A machine of this kind; one in three has dry friction at its first joint that its model knows of."""
    numbers = {k: [float(np.float32(rng.uniform(*r))) for r in ranges] for k, ranges in scene.ranges.items()}
    top = 0.15 * (numbers["gear"][0] if "gear" in numbers else 1.0)
    dry = float(np.float32(rng.uniform(0.3, 1.0) * top)) if rng.uniform() < 0.33 else 0.0
    return numbers | {"dry": [dry] + [0.0] * (scene.n - 1)}


def parameters(scene: Scene, numbers: Mapping[str, Any]) -> dict[str, Array]:
    """One machine with these numbers and no effect: a row of `truths.rows`, and its bodies, [1, n] each."""
    made = rows(scene, {k: v for k, v in numbers.items() if k not in BODY})
    return made | {k: np.array([numbers[k]], float) for k in BODY}


def build(scene: Scene, p: Mapping[str, Any]) -> str:
    """The nominal MJCF of one machine."""
    text = ""
    for j in reversed(range(scene.n)):
        up = p["l"][j - 1] if j else 0.0
        axis = "1 0 0" if scene.kinds[j] == "slide" else "0 -1 0"
        dry = f' frictionloss="{p["dry"][j]:.9g}"' if p["dry"][j] else ""
        shape = '<geom type="box" size="0.1 0.05 0.05"/>'
        if scene.kinds[j] == "hinge":
            shape = f'<geom type="capsule" size="0.02" fromto="0 0 0 0 0 {-p["l"][j]:.9g}"/>'
        text = (
            f'<body name="body{j}" pos="0 0 {-up:.9g}"><joint name="{scene.joints[j]}" type="{scene.kinds[j]}" '
            f'axis="{axis}" damping="{p["damping"][j]:.9g}" armature="{p["armature"][j]:.9g}"{dry}/>'
            f'<inertial pos="0 0 {-p["c"][j]:.9g}" mass="{p["m"][j]:.9g}" diaginertia="{p["i"][j]:.9g} '
            f'{p["i"][j]:.9g} {p["i"][j]:.9g}"/>{shape}\n{text}</body>\n'
        )
    actuators = "".join(_actuator(scene, p, i) for i in range(len(scene.actuators)))
    return (
        f'<mujoco model="{scene.name}">\n<option timestep="{TIMESTEP:.9g}" integrator="RK4" gravity="0 0 -9.81"/>\n'
        '<compiler angle="radian" autolimits="true"/>\n'
        '<default><joint solimpfriction="0.99 0.9999 0.001" solreffriction="0.004 1"/>'
        '<geom contype="0" conaffinity="0"/></default>\n'
        f"<worldbody>\n{text}</worldbody>\n<actuator>{actuators}</actuator>\n</mujoco>\n"
    )


def _actuator(scene: Scene, p: Mapping[str, Any], i: int) -> str:
    name, joint, limit = scene.actuators[i], scene.joints[i], p["limit"][i]
    if scene.servo:
        gains = f'kp="{p["kp"][i]:.9g}" kv="{p["kv"][i]:.9g}" ctrlrange="-3.2 3.2"'
        return f'<position name="{name}" joint="{joint}" {gains} forcerange="{-limit:.9g} {limit:.9g}"/>'
    top = limit / p["gear"][i]
    return f'<motor name="{name}" joint="{joint}" gear="{p["gear"][i]:.9g}" ctrlrange="{-top:.9g} {top:.9g}"/>'
