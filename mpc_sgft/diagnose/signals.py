"""Effects with a memory, applied to the recorded commands, which reach back before each window's start.

Their MJCF form (`edit_spec`) would begin each window with an empty memory. Each function here does the same to the
recorded commands; the repaired scene gets the MJCF form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.signal import lfilter

from mpc_sgft.diagnose.plant import Change, Plant
from mpc_sgft.diagnose.record import Array

Build = Callable[[Plant, tuple[str, ...], Mapping[str, float]], Change]
MIN_LAG = 1e-5  # [s] faster than this is no lag


def _on(plant: Plant, at: tuple[str, ...], change: Callable[[Array, float, str], Array]) -> Change:
    """A change of the commands of some actuators, each [T]."""
    names = at or tuple(plant.actuators)

    def command(ctrl: Array, dt: float) -> Array:
        out = ctrl.copy()
        for name in names:
            i = plant.actuators.index(name)
            out[:, i] = change(ctrl[:, i], dt, name)
        return out

    return Change(commands=(command,))


def _delay(plant: Plant, at: tuple[str, ...], values: Mapping[str, float]) -> Change:
    late = np.zeros(len(plant.actuators))
    late[[plant.actuators.index(a) for a in at or plant.actuators]] = values["delay"]
    return Change(delay=late)


def _lag(plant: Plant, at: tuple[str, ...], values: Mapping[str, float]) -> Change:
    def low_pass(u: Array, dt: float, name: str) -> Array:
        """Mean over each sample time of the exactly filtered, held command."""
        tau = values["time_constant"]
        if tau < MIN_LAG:
            return u
        keep = np.exp(-dt / tau)
        y, _ = lfilter([0.0, 1 - keep], [1.0, -keep], u, zi=[u[0]])
        return u + (y - u) * tau / dt * (1 - keep)

    return _on(plant, at, low_pass)


def _late(plant: Plant, at: tuple[str, ...], values: Mapping[str, float]) -> Change:
    names = at or tuple(f"qpos/{j}" for j in plant.joints)
    return Change(late={name.removeprefix("qpos/"): values["delay"] for name in names})


SIGNALS: dict[str, Build] = {
    "actuator_delay": _delay,
    "actuator_lag": _lag,
    "sensor_delay": _late,
}
