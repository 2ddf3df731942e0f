"""What reality can add to a plant. One table of neutral values; a row of arrays that differs from it has an effect.

All arrays have one row per machine, and a column per joint where the table says so. Units are SI.

Sources: LuGre friction, C. Canudas de Wit et al., IEEE TAC 40(3), 1995; Bouc-Wen hysteresis, Y. K. Wen, J. Eng. Mech.
102(2), 1976.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tools.studies.blind.plants import Array, Machine, Plant, Rows

# per joint ------------------------------------------------------------------------------------------------------------
PER_JOINT: dict[str, float] = {
    "armature": 0.0,  # rotor inertia
    "b_pos": 0.0,  # viscous friction while moving forward
    "b_neg": 0.0,  # … and backward
    "c_pos": 0.0,  # dry friction while moving forward, and the largest holding force against it
    "c_neg": 0.0,
    "quad": 0.0,  # drag, v |v|
    "load": 0.0,  # dry friction per transmitted force
    "spring": 0.0,
    "rest": 0.0,  # position at which the spring is relaxed
    "bristle": 0.0,  # LuGre stiffness; 0 turns LuGre off
    "bristle_damping": 0.0,
    "kinetic": 0.0,  # LuGre: friction at high speed …
    "static": 0.0,  # … and at the onset of motion
    "stribeck_speed": 1.0,
    "cog": 0.0,  # cogging force, and the distance between its teeth
    "cog_period": 1.0,
    "wave": 0.0,  # dry friction times (1 + wave sin(2 pi q / period))
    "wave_period": 1.0,
    "hysteresis": 0.0,  # Bouc-Wen force, and the travel over which it builds up
    "hysteresis_travel": 1.0,
    "elastic": 0.0,  # 1: a transmission between rotor (all of `armature`) and link
    "stiffness": 0.0,
    "twist_damping": 0.0,
    "gap": 0.0,  # half of the play of the transmission
    "gear": 0.0,  # motor: force per command
    "kp": 0.0,  # servo: force per position error
    "kv": 0.0,
    "limit": np.inf,  # of the drive's force
    "gain": 1.0,  # of the command
    "offset": 0.0,  # of the command
    "deadband": 0.0,  # of the command: less than this is nothing, more is reduced by this
    "delay": 0.0,  # of the command
    "lag": 0.0,  # time constant of the command
    "encoder": 0.0,  # 1: on the rotor, before the transmission; 0: on the link
    "sensor_gain": 1.0,
    "sensor_offset": 0.0,
    "sensor_delay": 0.0,
}
# per machine ----------------------------------------------------------------------------------------------------------
PER_ROW: dict[str, float] = {
    "payload": 0.0,
    "tilt": 0.0,
    "warmth": 0.0,  # the drive's force times 1 + warmth (exp(-t / warmth_time) - warmth_mean)
    "warmth_time": 1.0,
    "warmth_mean": 0.0,
    "clock": 0.0,  # time at the start of the row, for what drifts over several episodes
}


def rows(plant: Machine, numbers: Mapping[str, Any], count: int = 1) -> dict[str, Array]:
    """`count` machines with these nominal parameters (see mjcf.RANGES) and no effect."""
    made = {k: np.full((count, plant.n), v) for k, v in PER_JOINT.items()}
    made |= {k: np.full(count, v) for k, v in PER_ROW.items()}
    for name, value in numbers.items():
        if name == "damping":
            made["b_pos"][:], made["b_neg"][:] = value, value
        elif name == "dry":
            made["c_pos"][:], made["c_neg"][:] = value, value
        elif name in PER_JOINT:
            made[name][:] = value
        else:
            made[name] = np.full(count, float(value))
    return made


def take(p: Rows, index: Any) -> dict[str, Array]:
    """The same machines in another order, some, or repeated."""
    return {k: v[index] for k, v in p.items()}


def join(parts: list[Rows]) -> dict[str, Array]:
    """Machines of the same kind in one set of rows."""
    return {k: np.concatenate([part[k] for part in parts]) for k in parts[0]}


class Forces:
    """The forces of a set of machines, skipping what none of them has.

    Args:
        plant: Their kind.
        p: Their parameters, [R] or [R, n] each.
    """

    def __init__(self, plant: Plant, p: Rows) -> None:
        self.plant, self.p = plant, p
        self.used = {k for k in PER_JOINT if np.any(p[k] != PER_JOINT[k])}
        self.used |= {k for k in PER_ROW if np.any(p[k] != PER_ROW[k])}
        self.dry = (p["c_pos"] + p["c_neg"] + p["load"]) > 0  # [R, n]: sticks
        self.any_dry = bool(self.dry.any())
        self.elastic = p["elastic"] > 0
        self.any_elastic = bool(self.elastic.any())
        self.bends = bool({"bristle", "hysteresis"} & self.used)

    def drive(self, command: Array, position: Array, velocity: Array, time: float) -> Array:
        """Force of motor or servo, after its limit, [R, n]; position and velocity are the rotor's."""
        p = self.p
        if self.plant.servo:
            force = p["kp"] * (command - position) - p["kv"] * velocity
        else:
            force = p["gear"] * command
        if "warmth" in self.used:
            heat = np.exp(-(p["clock"] + time) / p["warmth_time"]) - p["warmth_mean"]
            force = force * (1 + p["warmth"] * heat)[:, None]
        return np.minimum(np.maximum(force, -p["limit"]), p["limit"])

    def transmitted(self, twist: Array, rate: Array) -> Array:
        """Force from rotor to link through spring and play, [R, n]; it never pulls back across the play."""
        p = self.p
        beyond = twist - np.clip(twist, -p["gap"], p["gap"])
        force = p["stiffness"] * beyond + p["twist_damping"] * rate * (beyond != 0)
        return np.where((p["gap"] > 0) & (force * beyond < 0), 0.0, force)

    def resistance(self, q: Array, v: Array, z: Array) -> Array:
        """All that resists smoothly, [R, n]: to be subtracted."""
        p, used = self.p, self.used
        if "b_pos" in used or "b_neg" in used:
            force = np.where(v > 0, p["b_pos"], p["b_neg"]) * v
        else:
            force = np.zeros_like(v)
        if "quad" in used:
            force += p["quad"] * v * np.abs(v)
        if "spring" in used:
            force += p["spring"] * (q - p["rest"])
        if "cog" in used:
            force += p["cog"] * np.sin(2 * np.pi * q / p["cog_period"])
        if "bristle" in used:
            force += p["bristle"] * z + p["bristle_damping"] * self.bending(v, z) * (p["bristle"] > 0)
        if "hysteresis" in used:
            force += p["hysteresis"] * z
        return force

    def bending(self, v: Array, z: Array) -> Array:
        """dz/dt of the bristles (LuGre) or of the hysteresis (Bouc-Wen), [R, n]."""
        p = self.p
        if "bristle" in self.used:
            ratio = v / p["stribeck_speed"]
            level = p["kinetic"] + (p["static"] - p["kinetic"]) * np.exp(-ratio * ratio)
            lugre = v - p["bristle"] * np.abs(v) * z / np.where(level > 0, level, 1.0)
            if "hysteresis" not in self.used:
                return lugre
        wen = (v - 0.5 * np.abs(v) * z * np.abs(z) - 0.5 * v * z * z) / p["hysteresis_travel"]
        return np.where(p["hysteresis"] != 0, wen, lugre) if "bristle" in self.used else wen

    def dry_level(self, q: Array, sign: Array, load: Array) -> Array:
        """Size of the dry friction against motion of this sign, [R, n]; `load` is the force from the drive."""
        p = self.p
        level = np.where(sign > 0, p["c_pos"], p["c_neg"])
        if "wave" in self.used:
            level = level * (1 + p["wave"] * np.sin(2 * np.pi * q / p["wave_period"]))
        if "load" in self.used:
            level = level + p["load"] * np.abs(load)
        return level
