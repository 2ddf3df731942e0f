"""What diagnose must know of an effect: its row in TABLE, or one that is worked out from what the effect's file says.

So a new file in envs/effects/ is looked for at once; a row says more, such as where fits should start.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from importlib import import_module

from envs.effects.base import Effect, available
from mpc_sgft.diagnose.candidates.effect_table import TABLE, EffectFacts, Parameter, TypicalSizes

HOOKS = ("edit_spec", "ctrl", "friction", "measured")  # what can be done to a recording
START = 0.1  # typical sizes from no effect


def effect_class(name: str) -> type[Effect]:
    return import_module(f"envs.effects.{name}").EFFECT


def possible() -> list[str]:
    """Effects that a recording may show."""
    return [*(n for n in TABLE if n in available()), *(n for n in available() if n not in TABLE and facts_of(n))]


def facts_of(name: str) -> EffectFacts | None:
    """What to know of an effect; None if a recording cannot show it, or its units are no mechanical ones."""
    return TABLE[name] if name in TABLE else _facts_from_units(effect_class(name))


@cache
def _facts_from_units(kind: type[Effect]) -> EffectFacts | None:
    """One parameter for each field, neutral at its default, as large as force, speed and travel make its unit."""
    if kind.place == "tendon" or all(getattr(kind, hook) is getattr(Effect, hook) for hook in HOOKS):
        return None  # recordings do not name tendons
    parameters = {}
    for f in fields(kind):
        size, neutral = size_from_unit(kind.units.get(f.name, "")), f.default
        if f.name == "at":
            continue
        if size is None or not isinstance(neutral, int | float):
            return None
        one_sided = kind.bounds.get(f.name, (-math.inf, math.inf))[0] >= neutral
        parameters[f.name] = Parameter(float(neutral), size, (START,) if one_sided else (START, -START))
    return EffectFacts(parameters)


def size_from_unit(unit: str) -> Callable[[TypicalSizes], float] | None:
    """Typical size of a quantity from its unit; None if that is not made of N, m, s and kg.

    Args:
        unit: Such as "N m s^2/rad^2 or N s^2/m^2"; the last one counts, and of angles alone, rad for m.
    """
    above, _, below = unit.split(" or ")[-1].partition("/")
    power: dict[str, int] = dict.fromkeys(("N", "m", "s", "kg"), 0)
    for part, sign in ((above, 1), (below, -1)):
        for factor in part.split():
            token = re.fullmatch(r"(N|m|rad|s|kg|1)(?:\^(\d))?", factor)
            if token is None:
                return None
            if token[1] != "1":
                power["m" if token[1] == "rad" else token[1]] += sign * int(token[2] or 1)
    if not unit:
        return None

    def size(s: TypicalSizes) -> float:
        way, time = s.travel ** (power["m"] + power["s"]), s.speed ** -power["s"]
        return s.force ** power["N"] * s.inertia ** power["kg"] * way * time

    return size
