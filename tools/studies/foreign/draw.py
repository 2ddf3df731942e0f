"""Which cases of a foreign engine there are: machine, effects, noise, data, from one seed."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from tools.studies.blind.draw import FAMILIES, FRICTION_PAIRS, Given, Mix, given, groups
from tools.studies.foreign.scenes import SCENES, Scene, draw_nominal

RATES = (200.0, 500.0, 1000.0)  # [Hz]
SWINGING = 0.25  # of the cases of a scene that may swing
FELT = {  # effects that free swings show
    *("viscous_friction", "coulomb_friction", "asymmetric_friction", "stribeck_friction", "quadratic_drag"),
    *("payload", "armature", "gravity_tilt", "sensor_offset", "cogging", "position_dependent_friction"),
}


class Case(NamedTuple):
    """One case.

    Attributes:
        name: Folder name; says nothing about what is inside.
        group: Of the mix.
        scene: Of SCENES.
        seconds: Length of each episode [s].
        dt: [s] between samples.
        noise: Level 0, 1 or 2.
        speed_channel, force_channel: Whether velocities, and the drives' forces, are recorded.
        swings: Whether the machine is let go and left alone, in place of following motions.
        nominal: Numbers of the model.
        effects: What is hidden.
        entropy: Seeds its random numbers.
    """

    name: str
    group: str
    scene: str
    seconds: tuple[float, ...]
    dt: float
    noise: int
    speed_channel: bool
    force_channel: bool
    swings: bool
    nominal: dict[str, Any]
    effects: tuple[Given, ...]
    entropy: tuple[int, ...]

    @property
    def uncertain(self) -> dict[str, float]:
        """Nothing: imperfections are what nobody knows of."""
        return {}


def draw(seed: int, count: int, scenes: Mapping[str, float], mix: Mix) -> list[Case]:
    """The cases of a seed.

    Args:
        seed: Of everything.
        count: How many.
        scenes: How often each occurs.
        mix: Groups and sizes.

    Raises:
        ValueError: If count is below 1.
    """
    if count < 1:
        raise ValueError(f"cases={count}: at least one is needed")
    return [redraw((seed, i, rank), group, scenes, mix) for i, (group, rank) in enumerate(groups(seed, count, 0, mix))]


def redraw(entropy: tuple[int, ...], group: str, scenes: Mapping[str, float], mix: Mix, attempt: int = 0) -> Case:
    """A case; with another attempt, another in its place."""
    entropy = (*entropy[:3], attempt)
    rng = np.random.default_rng((*entropy, 11))
    name = str(rng.choice(list(scenes), p=np.array(list(scenes.values())) / sum(scenes.values())))
    scene = SCENES[name]
    swings = bool(scene.swings and rng.uniform() < SWINGING)
    sites = {k: v for k, v in scene.sites.items() if not swings or k in FELT}
    outside = {k: v for k, v in scene.outside.items() if not swings or k in FELT}
    effects: tuple[Given, ...] = ()
    if group == "single":
        effects = (given(str(rng.choice(sorted(sites))), sites, rng, mix.single),)
    elif group == "pair":
        effects = tuple(given(n, sites, rng, mix.pair) for n in _pair(sites, rng))
    elif group == "outside":
        turn = (entropy[2] + attempt) % len(outside)  # some of a machine never matter for certain
        effects = (given(sorted(outside)[turn], outside, rng, mix.outside),)
    return Case(
        name=f"case_{entropy[1]:04d}",
        group=group,
        scene=name,
        seconds=tuple(float(x) for x in rng.uniform(4.0, 8.0, int(rng.integers(2, 5))).round(1)),
        dt=1 / float(rng.choice(RATES)),
        noise=int(rng.integers(3)),
        speed_channel=bool(rng.uniform() < 0.2),
        force_channel=bool(rng.uniform() < 0.25) and not swings,
        swings=swings,
        nominal=_nominal(scene, {e.name for e in effects}, rng),
        effects=effects,
        entropy=entropy,
    )


def _pair(sites: Mapping[str, tuple[int, ...]], rng: np.random.Generator) -> list[str]:
    """Two effects that leave different traces, by the blind benchmark's families."""
    while True:
        pair = {str(x) for x in rng.choice(sorted(sites), 2, replace=False)}
        if pair in FRICTION_PAIRS or not any(len(pair & set(f)) > 1 for f in FAMILIES):
            return sorted(pair)


def _nominal(scene: Scene, names: set[str], rng: np.random.Generator) -> dict[str, Any]:
    """Numbers of a machine on which these effects can be."""
    numbers = draw_nominal(scene, rng)
    if "position_dependent_friction" in names and not numbers["dry"][0]:
        numbers["dry"] = [0.1 * numbers["gear"][0] if "gear" in numbers else 0.1] + [0.0] * (scene.n - 1)
    if names & {"backlash", "flexible_joint"}:
        numbers["dry"] = [0.0] * scene.n
    return numbers
