"""Small imperfections of everything: no machine is its model plus one effect.

A flaw is an effect of the library, or another mass, at a size that matters to nobody. Sizes are drawn, then shrunk
until each moves predictions by at most EACH of what matters, and all of them together by at most TOGETHER of it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tools.studies.blind.draw import Given
from tools.studies.blind.library import EVERYTHING, Scales
from tools.studies.blind.plants import Array, Machine

BODY_MASSES = ("m", "m1", "m2", "i", "i1", "i2")  # what a wrong mass multiplies
EACH = 0.25  # of the border between what matters and what does not
TOGETHER = 0.5
WINDOW = 1.0  # [s] the longest that diagnose takes, where flaws show most
SMALL: dict[str, tuple[float, str]] = {  # largest size drawn, in which scale of the joint (see library)
    "mass": (0.003, ""),
    "actuator_gain": (0.003, ""),
    "actuator_offset": (0.001, "U"),
    "late": (5e-5, ""),  # [s] of timing
    "viscous_friction": (0.003, "F/V"),
    "coulomb_friction": (0.003, "F"),
    "quadratic_drag": (0.001, "F/VV"),
    "joint_stiffness": (0.001, "F/Q"),
    "gravity_tilt": (0.0005, ""),
    "sensor_gain": (0.0005, ""),
}


ADDS_TO = {  # flaw -> effects beside its own that it would only make larger or smaller
    "viscous_friction": ("asymmetric_friction",),
    "coulomb_friction": ("stribeck_friction",),
    "actuator_lag": ("actuator_delay",),
    "actuator_delay": ("actuator_lag",),
}


class Flaw(NamedTuple):
    """One imperfection: an effect's name or "mass", its joint, its size, its secondary choices (see library)."""

    name: str
    joint: int
    size: float
    shape: Mapping[str, float]


Moves = Callable[[list[list[Flaw]]], Array]


def draw_flaws(
    machine: Machine,
    scales: list[dict[str, float]],
    rng: np.random.Generator,
    *,
    late: str = "actuator_lag",
    force: bool = False,
) -> list[Flaw]:
    """A third of the largest size to all of it, of everything, everywhere.

    Args:
        machine: What there is.
        scales: Of each joint.
        rng: Where sizes and signs come from.
        late: Effect by which commands are late: a lag where delays come in whole steps.
        force: Whether the drives' forces are recorded. At the instant of a new command they still show the old one if
            commands are late at all, which is no small imperfection: then none are.
    """
    out = []
    for key, (largest, unit) in SMALL.items():
        name = late if key == "late" else key
        sits = "scene" if name == "mass" else EVERYTHING[name].sits
        count = {"scene": 1, "actuator": len(machine.actuators)}.get(sits, machine.n)
        for joint in range(count):
            size = largest * _unit(unit, scales[joint]) * float(rng.uniform(1 / 3, 1))
            size = 0.0 if key == "late" and force else size
            out.append(Flaw(name, joint, size, {"sign": float(rng.uniform()), "ratio": 0.5, "speed": 0.5}))
    return out


def _unit(unit: str, s: Scales) -> float:
    top, _, bottom = unit.partition("/")
    return (s[top] if top else 1.0) / float(np.prod([s[letter] for letter in bottom]))


def beside(flaws: list[Flaw], hidden: Sequence[Given]) -> list[Flaw]:
    """The same, but nothing of what adds to a hidden effect at its joint: the label says how large that is."""
    known = {(e.name, e.joint) for e in hidden}

    def adds(flaw: Flaw) -> bool:
        return any((name, flaw.joint) in known for name in (flaw.name, *ADDS_TO.get(flaw.name, ())))

    return [f._replace(size=0.0) if adds(f) else f for f in flaws]


def put(flaws: list[Flaw], p: dict[str, Array], rows: Any, scales: list[dict[str, float]]) -> None:
    """Write flaws into some rows of the parameters of `truths.rows`."""
    for flaw in flaws:
        if flaw.name == "mass":
            weigh(p, rows, 1 + (flaw.size if flaw.shape["sign"] >= 0.5 else -flaw.size))
        else:
            EVERYTHING[flaw.name].apply(p, rows, flaw.joint, flaw.size, flaw.shape, scales[flaw.joint])


def weigh(p: dict[str, Array], rows: Any, factor: float) -> None:
    """Make all bodies heavier, and harder to turn."""
    for name in BODY_MASSES:
        if name in p:
            p[name][rows] *= factor


def below(flaws: list[list[Flaw]], moves: Moves) -> tuple[list[list[Flaw]], Array]:
    """Flaws of several cases, as many of each, small enough; and by how much each moves predictions [borders], [C, K].

    Args:
        flaws: As drawn, by case.
        moves: Flaws of each case -> by how much these together move its predictions [borders], [C].
    """
    each = np.array([moves([[f[k]] for f in flaws]) for k in range(len(flaws[0]))]).T
    factors = np.minimum(1.0, EACH / np.maximum(each, 1e-9))
    small = [_times(f, x) for f, x in zip(flaws, factors, strict=True)]
    together = np.minimum(1.0, TOGETHER / np.maximum(moves(small), 1e-9))[:, None]
    return [_times(f, x) for f, x in zip(flaws, factors * together, strict=True)], each * factors * together


def _times(flaws: list[Flaw], factors: Array) -> list[Flaw]:
    return [f._replace(size=f.size * float(x)) for f, x in zip(flaws, factors, strict=True)]


def as_label(flaws: list[Flaw], moved: Array) -> list[dict[str, Any]]:
    """What the label says of the flaws of a case."""
    return [
        {"name": f.name, "joint": f.joint, "size": f.size, "moves": float(m)} for f, m in zip(flaws, moved, strict=True)
    ]
