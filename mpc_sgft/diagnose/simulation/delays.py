"""Effects with a memory, applied to the recorded commands, which reach back before each window's start.

Their MJCF form (`edit_spec`) would begin each window with an empty memory. What is built here does the same to the
recorded commands; the repaired scene gets the MJCF form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.simulation.plant import Change, Plant

Build = Callable[[Plant, tuple[str, ...], Mapping[str, float]], Change]


def _each(plant: Plant, at: tuple[str, ...], value: float) -> Array:
    """The value at some actuators, all if none is named, and 0 at the others, [nu]."""
    out = np.zeros(len(plant.actuators))
    out[[plant.actuators.index(a) for a in at or plant.actuators]] = value
    return out


def _delay(plant: Plant, at: tuple[str, ...], values: Mapping[str, float]) -> Change:
    return Change(delay=_each(plant, at, values["delay"]))


def _lag(plant: Plant, at: tuple[str, ...], values: Mapping[str, float]) -> Change:
    return Change(lag=_each(plant, at, values["time_constant"]))


def _late(plant: Plant, at: tuple[str, ...], values: Mapping[str, float]) -> Change:
    names = at or tuple(f"qpos/{j}" for j in plant.joints)
    return Change(late={name.removeprefix("qpos/"): values["delay"] for name in names})


DELAYS: dict[str, Build] = {
    "actuator_delay": _delay,
    "actuator_lag": _lag,
    "sensor_delay": _late,
}
