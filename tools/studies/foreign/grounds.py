"""The grounds: where the cases of each come from.

`imperfect` is the blind benchmark's own generator with small imperfections of everything in every case, `pybullet` that
engine, `scipy` equations of motion under a stiff integrator.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from tools.studies.blind import cases as blind_cases
from tools.studies.blind import draw as blind_draw
from tools.studies.blind.made import Ground
from tools.studies.blind.make import make as make_blind
from tools.studies.blind.plants import PLANTS
from tools.studies.blind_benchmark import in_processes
from tools.studies.foreign import cases, draw, make
from tools.studies.foreign.bullet import Bullet, client
from tools.studies.foreign.stiff import Stiff

TOLERANCE = 0.01  # of each signal's standard deviation: the border between what matters and what does not
SIZES = (3.0, 20.0)  # of what is hidden [detectable sizes]
MIX = blind_draw.Mix({"single": 0.5, "pair": 0.2, "none": 0.15, "outside": 0.15}, SIZES, SIZES, SIZES)
GROUND = Ground(MIX, TOLERANCE)
SHARE = 4  # cases that a process makes at a time


def imperfect(out: Path, seed: int, count: int, jobs: int) -> str:
    """Cases and labels of the blind generator with flaws on disk; the labels' hash."""
    drawn = blind_draw.draw(seed, count, mix=MIX)
    how = partial(make_blind, ground=GROUND)
    made = in_processes([(how, [c for c in drawn if c.plant == plant]) for plant in PLANTS], count, jobs)
    return blind_cases.write(out, [made[c.name] for c in drawn], seed, TOLERANCE)


def foreign(engine: make.Engines, scenes: Mapping[str, float], out: Path, seed: int, count: int, jobs: int) -> str:
    """The same of an engine on scenes (name -> how often)."""
    drawn = draw.draw(seed, count, scenes, MIX)
    how = partial(make.make, ways=make.Ways(engine, scenes, GROUND))
    made = in_processes([(how, drawn[i : i + SHARE]) for i in range(0, count, SHARE)], count, jobs)
    return cases.write(out, [made[c.name] for c in drawn], seed, TOLERANCE)


def check(grounds: list[str]) -> None:
    """Whether all that these grounds need is there.

    Raises:
        ValueError: If it is not.
    """
    if "pybullet" in grounds:
        client()


GROUNDS: dict[str, Callable[[Path, int, int, int], str]] = {
    "imperfect": imperfect,
    "pybullet": partial(foreign, Bullet, {"slide": 1.0, "pendulum": 1.0, "arm": 1.0, "cartpole": 1.0, "arm3": 0.4}),
    "scipy": partial(foreign, Stiff, {"screw": 1.0, "servo": 1.0, "arm": 1.0}),
}
