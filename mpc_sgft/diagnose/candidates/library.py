"""Candidates: effects at places, how large they may be, and where a fit should start.

The physics is in envs/effects/<name>.py, and what to know of it in effect_facts.py. Commands are changed before the
windows are cut, so that delays and lags reach back before a window's start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import mujoco
import numpy as np

from envs.effects.base import Effect, load
from mpc_sgft.command.errors import UserError, unknown
from mpc_sgft.diagnose.candidates.effect_facts import effect_class, facts_of, possible
from mpc_sgft.diagnose.candidates.effect_table import INCLUDES, TABLE, EffectFacts, TypicalSizes
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.simulation.delays import DELAYS
from mpc_sgft.diagnose.simulation.plant import Change, Plant, joint_of

IDLE_WHILE_NEUTRAL = (
    "velocity",
    "rest",
    "deflection",
    "damping_ratio",
)  # parameters that mean nothing while the effect is neutral
RICHER = 0.5  # of the simpler effect's size: where a fit of what the richer one does beyond it begins
LONG = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))


@dataclass(frozen=True)
class Term:
    """An effect at a place, with free parameters.

    Attributes:
        effect: Name in envs/effects/, or "nominal" for a nominal quantity that is refitted.
        at: Joints, actuators or bodies.
        names, units: Of the parameters.
        neutral, low, high, size: Arrays [p]: without effect, bounds, typical size.
        starts: Where fits start, each [p].
        build: values [p] -> what they change: a Change, or a tuple of effects where a task's simulation applies them.
        fixed: Parameters that are set and not fitted.
        hops: Distance between values that fit about as well, [p]; 0 where there is no such thing, empty for none.
    """

    effect: str
    at: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    neutral: Array
    low: Array
    high: Array
    size: Array
    starts: tuple[Array, ...]
    build: Callable[[Array], Any]
    fixed: Mapping[str, Any] = field(default_factory=dict)
    hops: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        return f"{self.effect}@{','.join(self.at)}" if self.at else self.effect


def candidates(
    plant: Plant, scales: Mapping[tuple[str, str], TypicalSizes], effects: Sequence[str] | None
) -> list[Term]:
    """Every effect that the data may show, at every place it may sit.

    Args:
        plant: The nominal scene.
        scales: (kind, name) of a joint, actuator, signal, body or touching geom -> typical sizes there.
        effects: Restrict to these; None for the whole table.

    Raises:
        UserError: For an effect that does not exist or that this kind of data cannot show.
    """
    known = possible()
    for name in effects or []:
        if name not in known:
            raise unknown("effect", name, known, "--effects")
    places = {
        "joint": plant.joints,
        "actuator": plant.actuators,
        "body": plant.bodies,
        "signal": [f"qpos/{j}" for j in plant.joints],
        "geom": [name for kind, name in scales if kind == "geom"],
        "": [""],
    }
    driven = [j for a in plant.actuators if (j := joint_of(plant, a))]
    built: list[Term] = []
    for name in (n for n in known if effects is None or n in effects):
        kind, facts = effect_class(name).place, _facts_of(name)
        for place in driven if facts.driven else places[kind]:
            if facts.commanded and scales.get((kind, place), TypicalSizes()).idle:
                continue
            variants = load_positions(plant, place) if name == "payload" else facts.variants
            built += [
                make_term(plant, name, place, scales.get((kind, place), TypicalSizes()), fixed) for fixed in variants
            ]
    for name in effects or []:
        if not any(t.effect == name for t in built):
            what = (
                "geoms that touch while the machine moves" if effect_class(name).place == "geom" else "a driven joint"
            )
            if _facts_of(name).commanded:
                what = "an actuator that does something in these data"
            raise UserError(f"--effects {name}: it needs {what}, and here there are none; leave it out.")
    return built


def load_positions(plant: Plant, body: str) -> list[dict[str, Any]]:
    """Where a load may sit on a body: its centre of mass, and its far end where that is elsewhere."""
    m = plant.model
    i = m.body(body).id
    centre = np.array(m.body_ipos[i])
    ends = [centre]
    for g in range(m.body_geomadr[i], m.body_geomadr[i] + m.body_geomnum[i]):
        axis = np.zeros(9)
        mujoco.mju_quat2Mat(axis, m.geom_quat[g])
        long = m.geom_size[g, 1] if m.geom_type[g] in LONG else 0.0
        ends += [m.geom_pos[g] + sign * long * axis[2::3] for sign in (-1, 1)]
    far = max(ends, key=lambda p: float(np.linalg.norm(p)))
    points = [centre, far] if np.linalg.norm(far - centre) > 0.05 * np.linalg.norm(far) + 1e-9 else [centre]
    joint = m.body_jntadr[i]
    if joint >= 0 and m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        points = points[:1]  # where on a carriage does not matter
    return [{"position": [round(float(x), 6) for x in p]} for p in points]


def _facts_of(name: str) -> EffectFacts:
    facts = facts_of(name)
    assert facts is not None, name
    return facts


def make_term(
    plant: Plant, name: str, place: str, scales: TypicalSizes, fixed: Mapping[str, Any] | None = None
) -> Term:
    """One effect at one place ("" for the whole scene)."""
    kind = effect_class(name)
    parameters = {p: par for p, par in _facts_of(name).parameters.items() if p not in (fixed or {})}
    pars = list(parameters.values())
    hard = np.array([kind.bounds.get(p, (-np.inf, np.inf)) for p in parameters]).reshape(-1, 2)
    sizes = np.minimum([par.size(scales) for par in pars], hard[:, 1] - hard[:, 0])  # at rest, sizes may be anything
    neutral = np.array([par.neutral(scales) if callable(par.neutral) else par.neutral for par in pars])
    soft = np.array([(neutral[i] + par.low * sizes[i], neutral[i] + par.high * sizes[i]) for i, par in enumerate(pars)])
    low, high = np.maximum(hard[:, 0], soft[:, 0]), np.minimum(hard[:, 1], soft[:, 1])
    begins = [[s(scales) if callable(s) else s for s in par.starts] for par in pars]
    starts = [np.array([b[k % len(b)] for b in begins]) for k in range(max(map(len, begins)))]
    at = (place,) if place else ()
    return Term(
        effect=name,
        at=at,
        names=tuple(parameters),
        units=tuple(kind.units.get(p, kind.units.get(next(iter(parameters)), "1")) for p in parameters),
        neutral=neutral,
        low=low,
        high=high,
        size=sizes,
        starts=tuple(np.clip(neutral + s * sizes, low, high) for s in starts),
        build=partial(_change, plant, name, at, tuple(parameters), fixed or {}),
        fixed=fixed or {},
        hops=tuple(par.hop(scales) for par in pars),
    )


def settings(term: Term, value: Array) -> dict[str, Any]:
    """What effects.yaml says of one effect."""
    return {
        **effect_parameters(term.effect, term.names, value),
        **term.fixed,
        **({"at": list(term.at)} if term.at else {}),
    }


def as_gap(found: Iterable[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    """{effect: parameters} as in configs/gap/*.yaml; a list of parameters where an effect acts at several places.

    Args:
        found: Name and parameters of each effect.
    """
    every: dict[str, list[dict[str, Any]]] = {}
    for name, parameters in found:
        every.setdefault(name, []).append(parameters)
    return {name: places[0] if len(places) == 1 else places for name, places in every.items()}


def effect_parameters(effect: str, names: Sequence[str], x: Array) -> dict[str, float]:
    """The effect's own parameters from the fitted ones."""
    fitted = dict(zip(names, map(float, x), strict=True))
    sums = sums_of(effect)
    inner = (
        {part for parts in sums.values() for part in parts} - set(f.name for f in fields(effect_class(effect)))
        if sums
        else set()
    )
    bounds = effect_class(effect).bounds if sums else {}
    return {k: v for k, v in fitted.items() if k not in inner} | {
        k: float(np.clip(fitted[a] + fitted[b], *bounds.get(k, (-np.inf, np.inf)))) for k, (a, b) in sums.items()
    }


def sums_of(effect: str) -> Mapping[str, tuple[str, str]]:
    """Parameters of an effect, or of a nominal quantity, that are sums of two fitted ones."""
    return TABLE[effect].sums if effect in TABLE else {}


def _change(
    plant: Plant, name: str, at: tuple[str, ...], names: tuple[str, ...], fixed: Mapping[str, Any], x: Array
) -> Change:
    values = effect_parameters(name, names, x)
    if name in DELAYS:
        return DELAYS[name](plant, at, values)
    effect = load({name: {**values, **fixed, **({"at": list(at)} if at else {})}})[0]
    kind = type(effect)
    joints, actuators = plant.joints, plant.actuators
    return Change(
        edits=(effect.edit_spec,) if kind.edit_spec is not Effect.edit_spec else (),
        commands=(lambda ctrl, dt: effect.ctrl(ctrl, actuators),) if kind.ctrl is not Effect.ctrl else (),
        frictions=(lambda load: _level(effect, load, joints),) if kind.friction is not Effect.friction else (),
        reads=(lambda x, name: effect.measured(x, name, np.zeros(len(x))),)
        if kind.measured is not Effect.measured
        else (),
    )


def _level(effect: Effect, force: Array, joints: list[str]) -> Array:
    level = effect.friction(force, joints)
    assert level is not None, type(effect).__name__
    return level


def includes(rich: Term, simple: Term) -> bool:
    """Whether one effect can do all that another does at the same place, be it itself with more of it fixed."""
    if rich.effect == simple.effect and rich.at == simple.at:
        return len(rich.fixed) < len(simple.fixed) and all(simple.fixed.get(k) == v for k, v in rich.fixed.items())
    return simple.effect in INCLUDES.get(rich.effect, {}) and simple.at == rich.at


def _shared(rich: Term, simple: Term) -> dict[str, str]:
    """Parameters of the richer effect -> of the simpler one, which give the same physics."""
    return {n: n for n in simple.names} if rich.effect == simple.effect else INCLUDES[rich.effect][simple.effect]


def simplify(rich: Term, value: Array, simple: Term) -> Array:
    """Parameters with which the simpler effect comes nearest to what the richer one does."""
    mapping = _shared(rich, simple)
    shares = [[value[i] for i, name in enumerate(rich.names) if mapping.get(name) == p] for p in simple.names]
    return np.clip([float(np.mean(x)) for x in shares], simple.low, simple.high)


def enrich(rich: Term, simple: Term, value: Array) -> list[Array]:
    """Parameters with which the richer effect does what the simpler one does, for each start of those that idle.

    Then the same with what only the richer effect has at a share of the simpler one's size: where it does nothing, the
    parameters that idle cannot be told from one another.
    """
    mapping = _shared(rich, simple)
    own = [n not in mapping and n not in IDLE_WHILE_NEUTRAL for n in rich.names]
    same = []
    for start in rich.starts:
        x = np.array(
            [s if n in IDLE_WHILE_NEUTRAL else z for n, s, z in zip(rich.names, start, rich.neutral, strict=True)]
        )
        for i, name in enumerate(rich.names):
            if name in mapping:
                x[i] = value[simple.names.index(mapping[name])]
        same.append(x)
    more = [np.where(own, rich.neutral + RICHER * value[0], x) for x in same] if any(own) else []
    out = [np.clip(x, rich.low, rich.high) for x in (*same, *more)]
    return [x for i, x in enumerate(out) if not any(np.array_equal(x, y) for y in out[:i])]
