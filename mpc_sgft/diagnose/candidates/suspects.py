"""What may be missing in a task's simulation: effects on the command, the machine, objects, contacts and sensors.

One row each: where it sits, its parameters with their typical size, where fits start, and how it is written in a gap.
The machine's joints are suspected together, and those that move otherwise than foretold one by one, too. A new suspect
is a new row.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from envs.effects.base import Effect, load
from envs.task import AbstractTask
from mpc_sgft.command.errors import unknown
from mpc_sgft.diagnose.candidates.effect_facts import effect_class
from mpc_sgft.diagnose.candidates.library import Term, as_gap
from mpc_sgft.diagnose.data.measured import Array

MOST_SIGNS = 8  # of a drift, that fits start with; where there are more, all up and all down


@dataclass(frozen=True)
class Suspect:
    """An effect at a place.

    Attributes:
        effect: Name in envs/effects/.
        at: Where, for people and for `label`.
        names: Free parameters.
        neutral, size, low, high: Of each, [p].
        starts: Where fits start, each [p].
        write: values [p] -> the effect's parameters, as in configs/gap/*.yaml.
    """

    effect: str
    at: tuple[str, ...]
    names: tuple[str, ...]
    neutral: tuple[float, ...]
    size: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    starts: tuple[tuple[float, ...], ...]
    write: Callable[[Array], dict[str, Any]]

    def build(self, values: Array) -> tuple[Effect, ...]:
        if np.array_equal(values, self.neutral):
            return ()
        return tuple(load({self.effect: self.write(values)}))

    def term(self) -> Term:
        units = effect_class(self.effect).units
        first = next(iter(units.values()), "1")
        return Term(
            effect=self.effect,
            at=self.at,
            names=self.names,
            units=tuple(units.get(n, units.get(n.split("_")[0], first)) for n in self.names),
            neutral=np.array(self.neutral),
            low=np.array(self.low),
            high=np.array(self.high),
            size=np.array(self.size),
            starts=tuple(np.array(s) for s in self.starts),
            build=self.build,
        )


def suspects(
    task: AbstractTask, effects: Sequence[str] | None = None, joints: Sequence[str] | None = None
) -> list[Suspect]:
    """Every suspect that can act on a task.

    Args:
        task: The nominal task.
        effects: Restrict to these names; all if None.
        joints: That are suspected one by one; all that an actuator drives if None.

    Raises:
        UserError: For a name that is no suspect here.
    """
    found = [*_commands(task), *_machine(task, joints), *_objects(task), *_sensors(task)]
    for name in effects or []:
        if name not in {s.effect for s in found}:
            raise unknown("effect", name, {s.effect for s in found}, "--effects")
    return [s for s in found if effects is None or s.effect in effects]


def gap_of(task: AbstractTask, terms: Sequence[Term], values: Sequence[Array]) -> dict[str, Any]:
    """{effect: parameters} as in configs/gap/*.yaml."""
    known = {s.term().label: s for s in suspects(task)}
    return as_gap((t.effect, known[t.label].write(v)) for t, v in zip(terms, values, strict=True))


def _one(
    effect: str,
    name: str,
    size: float,
    starts: Sequence[float],
    *,
    neutral: float = 0.0,
    low: float = 0.0,
    high: float = np.inf,
    at: str = "",
    extra: Mapping[str, Any] | None = None,
) -> Suspect:
    """An effect with one free parameter."""
    fixed = {**({"at": [at]} if at else {}), **(extra or {})}
    points = tuple((s,) for s in starts)

    def write(values: Array) -> dict[str, Any]:
        return {name: float(values[0]), **fixed}

    return Suspect(effect, (at,) if at else (), (name,), (neutral,), (size,), (low,), (high,), points, write)


def _offsets(
    effect: str, size: float, high: float, names: Sequence[str], at: tuple[str, ...], signs: Sequence[Sequence[int]]
) -> Suspect:
    """A constant on each of some axes; fits start with all at once, with these signs."""

    def write(values: Array) -> dict[str, Any]:
        return {"offset": [float(v) for v in values], **({"at": list(at)} if at else {})}

    p = len(names)
    starts = tuple(tuple(size * sign for sign in some) for some in signs)
    labels = tuple(f"offset_{n}" for n in names)
    return Suspect(effect, at, labels, (0.0,) * p, (size,) * p, (-high,) * p, (high,) * p, starts, write)


def _commands(task: AbstractTask) -> list[Suspect]:
    axes = [str(i + 1) for i in range(task.action_dim)]
    signs = list(itertools.product((1, -1), repeat=len(axes)))  # with a wrong one commands run into a limit
    signs = signs if len(signs) <= MOST_SIGNS else [signs[0], signs[-1]]
    found = [
        _one("actuator_gain", "gain", 0.2, (0.9, 0.6, 1.2), neutral=1.0, low=0.05, high=3.0),
        _offsets("actuator_offset", 0.05, 1.0, axes, (), signs),
        _one("deadband", "width", 0.1, (0.05, 0.2), high=0.9),
        _one("actuator_delay", "delay", 0.05, (0.02, 0.1, 0.3), high=0.95),
        _one("actuator_lag", "time_constant", 0.05, (0.03, 0.15), high=2.0),
    ]
    if task.moves_in_plane:
        starts = (0.1, -0.1, 0.6, -0.6)
        base = _one("frame_rotation", "angle", 0.2, starts, low=-np.pi, high=np.pi, extra={"at": "base"})
        found.append(Suspect(**{**vars(base), "at": ("base",)}))
    return found


def _machine(task: AbstractTask, joints: Sequence[str] | None) -> list[Suspect]:
    model = task.spec().compile()
    driven = [int(j) for j in dict.fromkeys(model.actuator_trnid[:, 0])]
    names = [model.joint(j).name for j in driven]
    force = np.abs(model.actuator_forcerange).max(1)
    force = np.where(force > 0, force, np.abs(model.actuator_ctrlrange).max(1))
    strength = {
        name: float(force[model.actuator_trnid[:, 0] == j].max()) for name, j in zip(names, driven, strict=True)
    }
    alone = names if joints is None else [name for name in names if name in joints]
    found = []
    for at in ["", *(alone if len(names) > 1 else [])]:
        most, speed = strength[at] if at else max(strength.values()), 1.0  # rad/s, typical
        found += [
            _one("viscous_friction", "coefficient", 0.02 * most / speed, (0.02 * most / speed,), at=at),
            _one("coulomb_friction", "torque", 0.02 * most, (0.01 * most,), at=at),
            _one("armature", "inertia", 0.1, (0.1,), at=at),
        ]
    last = model.body(int(model.jnt_bodyid[model.actuator_trnid[model.nu - 1, 0]])).name
    return [*found, _one("payload", "mass", 0.3, (0.3,), high=20.0, at=last)]


def _objects(task: AbstractTask) -> list[Suspect]:
    model, found = task.spec().compile(), []
    for j in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body = model.body(int(model.jnt_bodyid[j]))
        mass, geom = float(model.body_mass[body.id]), model.geom(int(model.body_geomadr[body.id]))
        own = float(geom.friction[0])
        starts = (0.25 * own, 0.1 * own, 2.0 * own)
        found += [
            _one("contact_friction", "coefficient", 0.5 * own, starts, neutral=own, high=4.0, at=geom.name),
            _one("payload", "mass", mass, (mass, 4 * mass), high=50 * mass, at=body.name),
            _one("contact_softness", "time_constant", 0.02, (0.02, 0.1), high=0.9, at=geom.name),
        ]
    return found


def _sensors(task: AbstractTask) -> list[Suspect]:
    names = task.observation_names
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(name.rpartition("_")[0] or name, []).append(name)
    found = [
        _one("sensor_gain", "gain", 0.05, (0.97, 1.03), neutral=1.0, low=0.2, high=3.0),
        _one("sensor_delay", "delay", 0.05, (0.02, 0.1), high=1.0),
        *(_offsets("sensor_offset", 0.01, 1.0, g, tuple(g), [[1] * len(g), [-1] * len(g)]) for g in groups.values()),
    ]
    if task.moves_in_plane and len(names) % 2 == 0:
        starts = (0.05, -0.05)
        camera = _one("frame_rotation", "angle", 0.1, starts, low=-np.pi, high=np.pi, extra={"at": "camera"})
        found.append(Suspect(**{**vars(camera), "at": ("camera",)}))
    return found
