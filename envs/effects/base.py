"""What every effect can change: the scene, the command, a force, what a sensor reads.

An effect is physics that reality has and the nominal simulator lacks: one file each, a frozen dataclass whose fields
are its parameters. `load` builds a list of them from a mapping, as in configs/gap/*.yaml.

Two users apply them. A task's simulation calls `edit_spec`, `command`, `force`, `friction`, `sense`, and `ctrl` of
effects that sit `at` named actuators. A solver that has a bare MJCF and recorded signals calls `edit_spec`, then `ctrl`
on the recorded controls and `measured` on the simulated signals; what `friction` gives it applies along the recorded
motion. An effect never does the same thing in two of these places.
"""

import importlib
import pkgutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import cache
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.task import AbstractTask

Array = NDArray[np.float64]
ROTOR = "rotor/"  # names of the joints and tendons that backlash and flexible_joint add begin so
SPRING = "joint_stiffness/"  # names of the tendons that joint_stiffness adds begin so
ADDED = (ROTOR, SPRING)  # elements with such names are not the machine's own


@dataclass(frozen=True)
class Effect:
    """Base of all effects: hooks that do nothing.

    Attributes:
        native: True if an MJCF after `edit_spec` carries the whole effect, so that plain MuJoCo shows it.
        place: Kind of the elements that `at` names: joint, actuator, body, geom, tendon, signal; "": the whole scene.
        units: Unit of each numeric parameter.
        bounds: Physically sensible range of each numeric parameter; values outside are refused.
    """

    native: ClassVar[bool] = True
    place: ClassVar[str] = ""
    units: ClassVar[dict[str, str]] = {}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {}

    def __post_init__(self) -> None:
        for name, (low, high) in self.bounds.items():
            for value in np.atleast_1d(getattr(self, name)):
                if not low <= value <= high:
                    unit = self.units.get(name, "")
                    raise ValueError(f"{type(self).__name__}.{name}={value} {unit}: allowed are {low} to {high} {unit}")

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Change the scene before it is compiled."""

    def command(self, action: Array, task: AbstractTask, truth: Array) -> Array:
        """Change an action between the interface and the machine, [N, A].

        Args:
            action: In [-1, 1], what effects before made of it, [N, A].
            task: Whose action.
            truth: What its sensors should read when the action begins, [N, O].
        """
        return action

    def ctrl(self, ctrl: Array, actuators: list[str]) -> Array:
        """Change control signals [T, nu] on their way to the actuators; what `edit_spec` carries is not repeated here.

        Args:
            ctrl: What was sent, in units of each actuator's control, one row each moment.
            actuators: Name of each column.

        Raises:
            ValueError: For an actuator in `at` that is not among them.
        """
        return ctrl

    def force(self, qpos: Array, qvel: Array) -> Array | None:
        """Generalised force [N, nv] to add, N or N m; None if there is none."""
        return None

    def friction(self, load: Array, joints: list[str]) -> Array | None:
        """Dry friction [N, nv] to add, N or N m; None if there is none. It acts like MuJoCo's `dof_frictionloss`.

        Args:
            load: Generalised force of all actuators, `qfrc_actuator`, [N, nv].
            joints: Name of each column's joint.
        """
        return None

    def sense(
        self, observation: Array, past: Callable[[float], Array], noise: Callable[[int], Array], task: AbstractTask
    ) -> Array:
        """Change what is observed, [n, O].

        Args:
            observation: As read so far, [n, O].
            past: past(s) is the true observation s seconds ago, [n, O].
            noise: noise(k) draws standard normal numbers, [n, k], each row with its environment's own generator.
            task: What is observed.
        """
        return observation

    def measured(self, values: Array, name: str, time: Array) -> Array:
        """What a sensor reads of one true signal, [T]; noise is left out.

        Args:
            values: The true signal, [T].
            name: Its name, as `at` would call it: an observation of a task, or `qpos/<joint>` of recorded data.
            time: When each value holds, [T] in s.
        """
        return values


@cache
def available() -> tuple[str, ...]:
    """Names of the effects, which are the names of the files in this folder."""
    here = sys.modules["envs.effects"].__path__
    return tuple(sorted(m.name for m in pkgutil.iter_modules(here) if m.name not in ("base", "passive", "rotor")))


Parameters = Mapping[str, Any] | None


def load(effects: Mapping[str, Parameters | list[Parameters]]) -> list[Effect]:
    """Build effects from {name: {parameter: value}}, or {name: [{…}, {…}]} where one acts at several places.

    Raises:
        ValueError: For an unknown effect or parameter, or a value out of bounds; the message lists what is allowed.
    """
    built = []
    for name, given in effects.items():
        if name not in available():
            near = get_close_matches(name, available(), 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ValueError(f"No effect {name!r} in envs/effects/. Available: {', '.join(available())}.{hint}")
        built += [_one(name, parameters or {}) for parameters in (given if isinstance(given, list) else [given])]
    return built


def _one(name: str, parameters: Mapping[str, Any]) -> Effect:
    kind = importlib.import_module(f"envs.effects.{name}").EFFECT
    allowed = [f.name for f in fields(kind)]
    unknown = sorted(set(parameters) - set(allowed))
    if unknown:
        raise ValueError(f"Effect {name} has no parameter {unknown[0]!r}. It has: {', '.join(allowed)}.")
    try:
        return kind(**{k: _as_field(kind, k, v) for k, v in parameters.items()})
    except TypeError as error:
        raise ValueError(f"Effect {name}: {error}. Its parameters: {', '.join(allowed)}.") from error


def _as_field(kind: type[Effect], name: str, value: Any) -> Any:
    """A parameter from yaml as the dataclass holds it: lists become tuples, a single name a tuple of one."""
    if isinstance(value, str) and isinstance(getattr(kind, name), tuple):
        return (value,)
    return tuple(value) if isinstance(value, list) else value


def per_axis(value: float | tuple[float, ...], size: int, what: str) -> Array:
    """One number for all axes, or one each, [1] or [size].

    Raises:
        ValueError: If there are neither one nor `size` numbers.
    """
    values = np.atleast_1d(np.asarray(value, float))
    if len(values) not in (1, size):
        raise ValueError(f"{what}={value}: {len(values)} numbers; give one, or {size}")
    return values


def pick(elements: list[Any], at: tuple[str, ...], kind: str) -> list[Any]:
    """The scene's elements with the names in `at`, or all of them if `at` is empty.

    "All" are those of the machine itself: no rotors or tendons that another effect added, and never an actuator
    without an input, which is how other effects enter a scene.

    Raises:
        ValueError: For a name that the scene lacks.
    """
    if kind == "actuator":
        elements = [e for e in elements if e.ctrlspec != int(mujoco.mjtCtrlInput.mjINPUT_NONE)]
    if kind in ("joint", "tendon") and not at:
        elements = [e for e in elements if not e.name.startswith(ADDED)]
    names = [e.name for e in elements]
    indices(names, at, kind)
    return [e for e in elements if not at or e.name in at]


def indices(names: list[str], at: tuple[str, ...], kind: str) -> list[int]:
    """Where the names in `at` stand among `names`, in the order of `at`; everywhere if it is empty.

    Raises:
        ValueError: For a name that is not there.
    """
    for name in at:
        if name not in names:
            raise ValueError(f"No {kind} {name!r} in this scene. Available: {', '.join(n for n in names if n)}.")
    return [names.index(name) for name in at] if at else list(range(len(names)))


def decide(spec: mujoco.MjSpec, named: list[Any]) -> None:
    """Let geoms and flexes decide in each of their contacts with others: the higher `priority` does."""
    others = [e.priority for e in [*spec.geoms, *spec.flexes] if all(e is not n for n in named)]
    for element in named:
        element.priority = max(element.priority, 1 + max(others, default=0))


def per_name(value: float | tuple[float, ...], names: tuple[str, ...], what: str) -> dict[str, float]:
    """One number for all names, or one each, by name.

    Raises:
        ValueError: If there are neither one nor as many numbers as names.
    """
    return dict(zip(names, np.broadcast_to(per_axis(value, len(names), what), len(names)).tolist(), strict=True))
