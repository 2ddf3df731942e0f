"""The nominal model of each plant as MJCF: what the solver gets. Parameters are plain numbers, one machine each."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tools.studies.blind.plants import Plant

TIMESTEP = 0.002  # [s] the solver's; the generator steps at a tenth of it
Numbers = Mapping[str, Any]  # a float, or a list with one each joint

# Ranges of the nominal parameters: kg, m, kg m^2; armature, damping, dry friction, gear one each joint.
RANGES: dict[str, dict[str, list[tuple[float, float]]]] = {
    "slide": {"m": [(3, 12)], "armature": [(1, 3)], "damping": [(2, 8)], "gear": [(15, 40)], "limit": [(200, 200)]},
    "pendulum": {
        "m": [(0.5, 1.5)],
        "c": [(0.15, 0.25)],
        "l": [(0.35, 0.45)],
        "i": [(0.004, 0.01)],
        "armature": [(0.01, 0.03)],
        "damping": [(0.02, 0.08)],
        "kp": [(30, 70)],
        "kv": [(1.5, 3)],
        "limit": [(25, 25)],
    },
    "arm": {
        "m1": [(1.5, 3)],
        "m2": [(0.8, 1.8)],
        "c1": [(0.15, 0.22)],
        "c2": [(0.12, 0.2)],
        "l1": [(0.35, 0.45)],
        "l2": [(0.3, 0.4)],
        "i1": [(0.01, 0.03)],
        "i2": [(0.006, 0.015)],
        "armature": [(0.05, 0.12), (0.02, 0.05)],
        "damping": [(0.05, 0.2), (0.03, 0.1)],
        "gear": [(10, 20), (5, 10)],
        "limit": [(80, 80), (40, 40)],
    },
    "cartpole": {
        "m1": [(1.5, 4)],
        "m2": [(0.2, 0.6)],
        "c2": [(0.2, 0.3)],
        "l2": [(0.45, 0.55)],
        "i2": [(0.003, 0.01)],
        "armature": [(0.3, 0.8), (0, 0)],
        "damping": [(1, 4), (0.001, 0.004)],
        "gear": [(10, 20), (0, 0)],
        "limit": [(100, 100), (0, 0)],
    },
}
PER_JOINT = ("armature", "damping", "dry", "gear", "kp", "kv", "limit")


def draw_nominal(plant: Plant, rng: np.random.Generator) -> dict[str, Any]:
    """A machine of this kind; one in four has dry friction that its model knows of (`dry`, N or N m)."""
    numbers: dict[str, Any] = {}
    for name, ranges in RANGES[plant.name].items():
        values = [float(np.float32(rng.uniform(*r))) for r in ranges]
        numbers[name] = values if name in PER_JOINT else values[0]
    some = {"slide": (2.0, 6.0), "pendulum": (0.03, 0.1), "arm": (0.1, 0.4), "cartpole": (1.0, 3.0)}[plant.name]
    dry = float(np.float32(rng.uniform(*some))) if rng.uniform() < 0.25 else 0.0
    numbers["dry"] = [dry] + [0.25 * dry if kind == plant.kinds[0] else 0.0 for kind in plant.kinds[1:]]
    return numbers


def build(plant: Plant, p: Numbers, *, timestep: float = TIMESTEP) -> str:
    """The MJCF of one machine.

    Args:
        plant: Which kind.
        p: Its parameters, as `draw_nominal` gives them.
        timestep: [s] of the model.
    """
    bodies = {"slide": _slide, "pendulum": _pendulum, "arm": _arm, "cartpole": _cartpole}[plant.name](p)
    actuators = []
    for i, name in enumerate(plant.actuators):
        limit = _at(p, "limit", i)
        if plant.servo:
            gains = f'kp="{_at(p, "kp", i):.9g}" kv="{_at(p, "kv", i):.9g}" ctrlrange="-3.2 3.2"'
            force = f'forcerange="{-limit:.9g} {limit:.9g}"'
            actuators.append(f'<position name="{name}" joint="{plant.joints[i]}" {gains} {force}/>')
        else:
            volts = limit / _at(p, "gear", i)
            gains = f'gear="{_at(p, "gear", i):.9g}" ctrlrange="{-volts:.9g} {volts:.9g}"'
            actuators.append(f'<motor name="{name}" joint="{plant.joints[i]}" {gains}/>')
    return (
        f'<mujoco model="{plant.name}">\n'
        f'  <option timestep="{timestep:.9g}" integrator="RK4" gravity="0 0 -9.81"/>\n'
        '  <compiler angle="radian" autolimits="true"/>\n'
        '  <default><joint solimpfriction="0.99 0.9999 0.001" solreffriction="0.004 1"/>'
        '<geom contype="0" conaffinity="0"/></default>\n'
        f"  <worldbody>\n{bodies}  </worldbody>\n"
        f"  <actuator>{''.join(actuators)}</actuator>\n"
        "</mujoco>\n"
    )


def _at(p: Numbers, name: str, i: int) -> float:
    return float(p[name][i])


def _joint(p: Numbers, i: int, name: str, kind: str) -> str:
    axis = "1 0 0" if kind == "slide" else "0 -1 0"
    dry = f' frictionloss="{_at(p, "dry", i):.9g}"' if _at(p, "dry", i) else ""
    return (
        f'<joint name="{name}" type="{kind}" axis="{axis}" damping="{_at(p, "damping", i):.9g}" '
        f'armature="{_at(p, "armature", i):.9g}"{dry}/>'
    )


def _rod(name: str, at: str, joint: str, mass: float, centre: float, inertia: float, end: float, inner: str) -> str:
    """A body that hangs down from its hinge: centre of mass at `centre`, end at `end`."""
    return (
        f'    <body name="{name}" pos="{at}">{joint}'
        f'<inertial pos="0 0 {-centre:.9g}" mass="{mass:.9g}" diaginertia="{inertia:.9g} {inertia:.9g} '
        f'{0.1 * inertia:.9g}"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 {-end:.9g}"/>'
        f"\n{inner}    </body>\n"
    )


def _box(name: str, joint: str, mass: float, inner: str = "") -> str:
    return (
        f'    <body name="{name}">{joint}<inertial pos="0 0 0" mass="{mass:.9g}" diaginertia="0.01 0.01 0.01"/>'
        f'<geom type="box" size="0.1 0.05 0.05"/>\n{inner}    </body>\n'
    )


def _slide(p: Numbers) -> str:
    return _box("carriage", _joint(p, 0, "slide", "slide"), p["m"])


def _pendulum(p: Numbers) -> str:
    return _rod("arm", "0 0 0", _joint(p, 0, "hinge", "hinge"), p["m"], p["c"], p["i"], p["l"], "")


def _arm(p: Numbers) -> str:
    elbow = f"0 0 {-p['l1']:.9g}"
    outer = _rod("link2", elbow, _joint(p, 1, "elbow", "hinge"), p["m2"], p["c2"], p["i2"], p["l2"], "")
    return _rod("link1", "0 0 0", _joint(p, 0, "shoulder", "hinge"), p["m1"], p["c1"], p["i1"], p["l1"], outer)


def _cartpole(p: Numbers) -> str:
    pole = _rod("pole", "0 0 0", _joint(p, 1, "pole", "hinge"), p["m2"], p["c2"], p["i2"], p["l2"], "")
    return _box("cart", _joint(p, 0, "cart", "slide"), p["m1"], pole)
