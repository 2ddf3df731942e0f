"""Which cases there are: kinds of plant, effects, noise, data, from one seed. Sizes come later, from the noise."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from tools.studies.blind.library import LIBRARY, OUTSIDE_SITES, SITES
from tools.studies.blind.mjcf import draw_nominal
from tools.studies.blind.plants import PLANTS, Plant

SHARES = {"single": 0.45, "pair": 0.20, "none": 0.15, "outside": 0.12, "ambiguous": 0.08}
SECONDS = (2.0, 8.0, 25.0)
EPISODE = {2.0: 2.0, 8.0: 4.0, 25.0: 5.0, 0.6: 0.6}  # [s] of one file, by seconds of data
TICK = {"slide": 0.002, "pendulum": 0.002, "arm": 0.004, "cartpole": 0.004}  # [s]
MULTIPLE = (0.5, 10.0)  # of the detectable size
NOISE = {"slide": (5e-6, 5e-5, 3e-4), "hinge": (5e-5, 3e-4, 2e-3)}  # [m or rad] sd at three levels
COUNT = {"slide": (1e-5, 5e-5, 2e-4), "hinge": tuple(2 * np.pi / n for n in (65536, 16384, 4096))}  # encoder steps
WRONG = (0.05, 0.25)  # how far a wrong nominal mass or gain is off
UNCERTAIN = 0.3  # what the user then calls uncertain

# At most one effect of each family in a pair; frictions may meet as listed.
FAMILIES = (
    ("viscous_friction", "coulomb_friction", "asymmetric_friction", "stribeck_friction"),
    ("quadratic_drag", "viscous_friction", "asymmetric_friction", "stribeck_friction"),
    ("load_dependent_friction", "coulomb_friction", "stribeck_friction", "asymmetric_friction"),
    ("actuator_delay", "actuator_lag", "sensor_delay"),
    ("payload", "armature", "actuator_gain", "sensor_gain"),
    ("actuator_offset", "gravity_tilt", "sensor_offset"),
    ("torque_saturation", "deadband", "backlash", "flexible_joint", "joint_stiffness"),
)
FRICTION_PAIRS = ({"viscous_friction", "coulomb_friction"}, {"asymmetric_friction", "coulomb_friction"})
INERTIAL = {"payload", "armature", "actuator_gain", "sensor_gain", "gravity_tilt"}  # too close to a wrong mass or gain


class Mix(NamedTuple):
    """How often each group occurs, and how large what is hidden in it is [detectable sizes].

    Attributes:
        shares: Of all cases, by group; sum 1.
        single, pair, outside: Smallest and largest size.
    """

    shares: Mapping[str, float]
    single: tuple[float, float]
    pair: tuple[float, float]
    outside: tuple[float, float]


BLIND = Mix(SHARES, MULTIPLE, (1.5, MULTIPLE[1]), (3.0, MULTIPLE[1]))


class Given(NamedTuple):
    """One effect of a case: name, joint it concerns, size in detectable ones, secondary choices in 0 … 1."""

    name: str
    joint: int
    multiple: float
    shape: dict[str, float]


class Case(NamedTuple):
    """One case; what the solver may know is `nominal`, `uncertain` and the data.

    Attributes:
        name: Folder name; says nothing about what is inside.
        group: Of SHARES.
        kind: Of an ambiguous case: equivalent, one_speed, short; otherwise empty.
        plant: Of PLANTS.
        seconds: Of data in all files together.
        noise: Level 0, 1 or 2.
        jitter: Whether samples are taken off the tick.
        speed_channel: Whether velocities are recorded.
        force_channel: Whether the drive's force is recorded.
        nominal: Parameters of the model.
        wrong: {"mass": factor} or {"gain": factor} by which reality differs from the model.
        uncertain: What the user says may be wrong, and by which share.
        effects: What is hidden.
        entropy: Seeds its random numbers.
    """

    name: str
    group: str
    kind: str
    plant: str
    seconds: float
    noise: int
    jitter: bool
    speed_channel: bool
    force_channel: bool
    nominal: dict[str, Any]
    wrong: dict[str, float]
    uncertain: dict[str, float]
    effects: tuple[Given, ...]
    entropy: tuple[int, ...]


def draw(seed: int, count: int, least_none: int = 0, mix: Mix = BLIND) -> list[Case]:
    """The cases of a seed, in an order that says nothing.

    Args:
        seed: Of everything.
        count: How many.
        least_none: Cases without effect are added until there are this many, beyond `count`.
        mix: Groups and sizes.

    Raises:
        ValueError: If count is below 1.
    """
    if count < 1:
        raise ValueError(f"cases={count}: at least one is needed")
    return [_case(i, group, rank, seed, mix) for i, (group, rank) in enumerate(groups(seed, count, least_none, mix))]


def groups(seed: int, count: int, least_none: int, mix: Mix) -> list[tuple[str, int]]:
    """Group of each case in an order that says nothing, and how many of that group come before it."""
    rng = np.random.default_rng((seed, 2718))
    edges = np.round(np.cumsum(list(mix.shares.values())) * count).astype(int)
    every = [name for name, n in zip(mix.shares, np.diff(edges, prepend=0), strict=True) for _ in range(n)]
    every += ["none"] * max(0, least_none - every.count("none"))
    shuffled = [every[where] for where in rng.permutation(len(every))]
    return [(group, shuffled[:i].count(group)) for i, group in enumerate(shuffled)]


def redraw(case: Case, attempt: int, mix: Mix = BLIND) -> Case:
    """Another case of the same group in place of one whose effect cannot reach the size that was drawn."""
    seed, index, rank = case.entropy[:3]
    return _case(index, case.group, rank, seed, mix, attempt)


def _case(index: int, group: str, rank: int, seed: int, mix: Mix, attempt: int = 0) -> Case:
    entropy = (seed, index, rank, attempt)
    rng = np.random.default_rng((*entropy, 1))
    name = str(rng.choice(list(PLANTS)))
    seconds = float(rng.choice(SECONDS if group != "outside" else SECONDS[1:]))
    kind = ""
    wrong: dict[str, float] = {}
    effects: tuple[Given, ...] = ()
    force = bool(rng.uniform() < 0.3)
    if group == "single":
        options = sorted(SITES[name])
        effects = (given(options[int(rng.integers(len(options)))], SITES[name], rng, mix.single),)
        force |= effects[0].name in ("actuator_delay", "sensor_delay", "actuator_offset")
    elif group == "pair":
        first, second = pair(name, rng)
        effects = tuple(given(n, SITES[name], rng, mix.pair) for n in (first, second))
        force |= bool({"actuator_delay", "sensor_delay"} & {first, second})
    elif group == "outside":
        options = sorted(OUTSIDE_SITES[name])
        effects = (given(options[rank % len(options)], OUTSIDE_SITES[name], rng, mix.outside),)
    elif group == "ambiguous":
        kind = ("equivalent", "one_speed", "short")[rank % 3]
        name, effects, seconds = _ambiguous(kind, name, seconds, rng)
        force = False
    plant = PLANTS[name]
    names = {e.name for e in effects}
    if (group == "none" and rank % 2) or (
        group in ("single", "pair") and not names & INERTIAL and rng.uniform() < 0.25
    ):
        wrong = _wrong(plant, rng)
    nominal = draw_nominal(plant, rng)
    if "position_dependent_friction" in names and not nominal["dry"][0]:
        nominal["dry"] = [0.15 * g for g in nominal["gear"]] if not plant.servo else [0.1]
    uncertain = {k: UNCERTAIN for k in wrong}
    if not wrong and not names & INERTIAL and rng.uniform() < 0.2:
        uncertain = {"mass": UNCERTAIN}  # the user is careful, and the model is right
    return Case(
        name=f"case_{index:04d}",
        group=group,
        kind=kind,
        plant=name,
        seconds=seconds,
        noise=int(rng.integers(3)),
        jitter=bool(rng.uniform() < 0.5),
        speed_channel=bool(rng.uniform() < 0.3),
        force_channel=force,
        nominal=nominal,
        wrong=wrong,
        uncertain=uncertain,
        effects=effects,
        entropy=entropy,
    )


def given(
    name: str, sites: dict[str, tuple[int, ...]], rng: np.random.Generator, multiples: tuple[float, float]
) -> Given:
    joint = int(rng.choice(sites[name]))
    multiple = float(np.exp(rng.uniform(*np.log(multiples))))
    return Given(name, joint, multiple, {k: float(rng.uniform()) for k in ("sign", "ratio", "speed")})


def pair(plant: str, rng: np.random.Generator) -> tuple[str, str]:
    """Two effects that leave different traces."""
    options = sorted(SITES[plant])
    while True:
        pair = {str(x) for x in rng.choice(options, 2, replace=False)}
        if pair in FRICTION_PAIRS or not any(len(pair & set(f)) > 1 for f in FAMILIES):
            first, second = sorted(pair)
            return first, second


def _ambiguous(kind: str, plant: str, seconds: float, rng: np.random.Generator) -> tuple[str, tuple[Given, ...], float]:
    """Plant, effects and seconds of data of a case that nobody can tell."""
    if kind == "equivalent":
        options = [("slide", n) for n in ("payload", "armature", "gravity_tilt", "actuator_offset", "actuator_delay")]
        options += [("slide", "sensor_delay"), ("pendulum", "actuator_delay"), ("pendulum", "sensor_delay")]
        plant, effect = options[int(rng.integers(len(options)))]
        return plant, (given(effect, {effect: (0,)}, rng, (2.0, 10.0)),), seconds
    if kind == "one_speed":
        effect = str(rng.choice(["viscous_friction", "coulomb_friction", "actuator_offset", "quadratic_drag"]))
        return "slide", (given(effect, {effect: (0,)}, rng, (2.0, 10.0)),), min(seconds, 8.0)
    options = sorted(set(SITES[plant]) & set(LIBRARY))
    return plant, (given(options[int(rng.integers(len(options)))], SITES[plant], rng, (0.5, 2.0)),), 0.6


def _wrong(plant: Plant, rng: np.random.Generator) -> dict[str, float]:
    off = float(rng.uniform(*WRONG)) * (1 if rng.uniform() < 0.5 else -1)
    return {"gain" if not plant.servo and rng.uniform() < 0.3 else "mass": 1 + off}
