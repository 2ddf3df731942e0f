"""Which other names would do as well for a hidden effect, by what both do to the data.

An effect's trace (see detect) is what it changes in what is measured within windows. A rival is *alike* if some size of
it leaves the same trace but for less than half a noise floor, root mean square, in every channel: half of what makes an
effect detectable. What else may move goes along: the other hidden effect, and a mass that the user calls uncertain.
A solver that calls such names tied is right, and so is one that names the hidden effect; the rival alone is wrong.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from scipy.optimize import lsq_linear

from tools.studies.blind.draw import Given
from tools.studies.blind.library import EVERYTHING
from tools.studies.blind.plants import Array, Machine

ALIKE = (
    {"actuator_gain", "sensor_gain", "payload", "armature"},
    {"actuator_gain", "deadband"},
    {"actuator_offset", "sensor_offset", "gravity_tilt"},
    {"actuator_delay", "actuator_lag", "sensor_delay"},
    {"viscous_friction", "asymmetric_friction", "quadratic_drag", "load_dependent_friction"},
    {"coulomb_friction", "stribeck_friction", "load_dependent_friction"},
)
SIGNED = {"actuator_gain", "sensor_gain", "actuator_offset", "sensor_offset", "gravity_tilt"}
SAME = 0.5  # noise floors: the smallest effect that is hidden changes as much
HEAVIER = 0.01  # share by which an uncertain mass is changed for its trace
Job = tuple[int, Given | None, float]
Traces = Callable[[list[Job]], list[Array]]


class Hiding(Protocol):
    """What a case hides, and what its user calls uncertain."""

    @property
    def effects(self) -> tuple[Given, ...]: ...
    @property
    def uncertain(self) -> Mapping[str, float]: ...


def rivals(plant: Machine, given: Given) -> list[Given]:
    """Names that may look like an effect, where they would: at its joint, or anywhere for one of the whole scene."""
    names = sorted(set().union(*(g for g in ALIKE if given.name in g)) - {given.name})
    everywhere = EVERYTHING[given.name].sits == "scene"
    out = []
    for name in names:
        sits = EVERYTHING[name].sits
        joints = range(plant.n) if everywhere else [given.joint]
        if sits in ("scene", "body"):
            joints = [0 if sits == "scene" else plant.n - 1]
        out += [given._replace(name=name, joint=j) for j in joints if sits != "actuator" or j < len(plant.actuators)]
    return out


def alike(*args: Any) -> list[list[list[str]]]:
    """Names alike each effect of each case, of what `rivals_leave` is asked."""
    return [[[n for n, left in one.items() if left < SAME] for one in case] for case in rivals_leave(*args)]


def rivals_leave(
    plant: Machine,
    cases: Sequence[Hiding],
    sizes: Sequence[Sequence[float]],
    scales: Sequence[Sequence[dict[str, float]]],
    traces: Traces,
) -> list[list[dict[str, float]]]:
    """What the best size of each rival leaves of the trace of each effect of each case [noise floors], by name.

    Args:
        plant: The kind of machine.
        cases: All of this plant.
        sizes: Of each effect of each case.
        scales: Of each joint of each case (see library).
        traces: (case, effect or None for a heavier machine, size) -> trace [W, T, channels], for many at once.
    """
    hidden = [(i, k) for i, case in enumerate(cases) for k in range(len(case.effects))]
    own = dict(zip(hidden, traces([(i, cases[i].effects[k], sizes[i][k]) for i, k in hidden]), strict=True))
    unsure = [i for i, case in enumerate(cases) if case.effects and case.uncertain]
    heavier = dict(zip(unsure, traces([(i, None, HEAVIER) for i in unsure]), strict=True))
    tried = [(i, k, r) for i, k in hidden for r in rivals(plant, cases[i].effects[k])]
    guesses = [EVERYTHING[r.name].guess(scales[i][r.joint]) for i, _, r in tried]
    for _ in range(2):  # to traces as large as the effect's: not all grow with their size
        found = traces([(i, r, g) for (i, _, r), g in zip(tried, guesses, strict=True)])
        entries = [(EVERYTHING[r.name], scales[i][r.joint]) for i, _, r in tried]
        ratios = [rms(own[i, k]) / max(rms(t), 1e-9) for (i, k, _), t in zip(tried, found, strict=True)]
        wanted = [g * min(max(x, 1e-3), 1e3) for g, x in zip(guesses, ratios, strict=True)]
        guesses = [min(max(g, e.smallest, 1e-9), e.largest(s)) for g, (e, s) in zip(wanted, entries, strict=True)]
    found = traces([(i, r, g) for (i, _, r), g in zip(tried, guesses, strict=True)])
    out: list[list[dict[str, float]]] = [[{} for _ in case.effects] for case in cases]
    for (i, k, rival), t in zip(tried, found, strict=True):
        others = [own[i, m] for m in range(len(cases[i].effects)) if m != k] + ([heavier[i]] if i in heavier else [])
        left = separation(own[i, k], t, others, rival.name in SIGNED)
        out[i][k][rival.name] = min(left, out[i][k].get(rival.name, np.inf))
    return out


def separation(own: Array, rival: Array, others: Sequence[Array], signed: bool) -> float:
    """What is left of a trace at the best size of a rival, in the channel where most is left [noise floors].

    Args:
        own, rival: Traces, [W, T, channels].
        others: Traces that go along, likewise.
        signed: Whether the rival may be negative.
    """
    return left_of(own, [rival, *others], 0.0 if not signed else -np.inf)


def left_of(own: Array, others: Sequence[Array], least: float = -np.inf) -> float:
    """What no sum of other traces makes up for, as `separation` says it; the first counts at least `least` times."""
    if not others:
        return float(np.sqrt(np.mean(own**2, (0, 1))).max())
    columns = np.stack([x.ravel() for x in others], 1)
    norms = np.linalg.norm(columns, axis=0) + 1e-12
    low = np.full(len(norms), -np.inf)
    low[0] = least
    best = lsq_linear(columns / norms, own.ravel(), (low, np.full(len(norms), np.inf))).x
    left = own - ((columns / norms) @ best).reshape(own.shape)
    return float(np.sqrt(np.mean(left**2, (0, 1))).max())


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
