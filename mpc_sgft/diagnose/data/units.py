"""Do columns mean what they say? Units against the model's ranges, speeds against positions, cause before effect.

Each check refuses only what a sound recording cannot show, effects that a simulator lacks included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Array, Table

BEYOND = 3.0  # times the model's range: no joint, stop or offset gets a reading there
INSIDE = 1.1  # times the range, of readings in the right unit
FACTORS = {"hinge": {"degrees": 180 / np.pi}, "slide": {"centimetres": 100.0, "millimetres": 1000.0}}
SPAN = 10  # samples over which a speed is compared with the way that was made
MOVES = 50.0  # times a position's scatter: less motion says nothing of its speed
ALIKE, UNLIKE = 0.95, 0.3  # correlations, of speeds about zero
TWICE = 2.0  # a speed that is off by more is in another unit
LEAD = 3  # samples by which a joint may not be ahead of its command
REACH = 25  # samples


class Axis(NamedTuple):
    """What a joint's readings can be: its limits [rad or m], infinite where the model has none, and its kind."""

    low: float = -np.inf
    high: float = np.inf
    slide: bool = False


def check_units(table: Table, joints: Mapping[str, Axis]) -> None:
    """Positions lie within the model's ranges, or near them.

    Raises:
        UserError: If they are far outside, with the unit that they may be in.
    """
    for joint, axis in joints.items():
        limit = max(abs(axis.low), abs(axis.high))
        seen = float(np.abs(table.columns[f"qpos/{joint}"]).max())
        if not np.isfinite(limit) or seen <= BEYOND * limit:
            continue
        fits = [unit for unit, size in FACTORS[_kind(axis)].items() if seen / size <= INSIDE * limit]
        guess = f"{' or '.join(fits)}? They are needed in {_unit(axis)}" if fits else "another unit, or another joint?"
        raise UserError(f"{table.name}: qpos/{joint} reaches {seen:g}, the model's range is {limit:g}: {guess}.")


def check_speeds(table: Table, joints: Mapping[str, Axis]) -> None:
    """A measured speed is the derivative of its position, where the joint moves enough to tell.

    Raises:
        UserError: If it is in another unit, or of something else.
    """
    time = table.columns["time"]
    for joint, axis in joints.items():
        speed, q = table.columns.get(f"qvel/{joint}"), table.columns[f"qpos/{joint}"]
        if speed is None or np.ptp(q) < MOVES * _scatter(q):
            continue
        way = q[SPAN:] - q[:-SPAN]
        total = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(time))])
        said = total[SPAN:] - total[:-SPAN]
        size = float(np.linalg.norm(said)), max(float(np.linalg.norm(way)), 1e-300)
        like, times = float(said @ way) / max(size[0] * size[1], 1e-300), size[0] / size[1]  # an even speed counts
        if abs(like) < UNLIKE:
            raise UserError(
                f"{table.name}: qvel/{joint} is not the derivative of qpos/{joint} (likeness {like:.2f} of 1). Is it "
                "of another joint? Mend it, or leave it out: speeds are worked out from positions where there are none."
            )
        if like < -ALIKE:
            raise UserError(f"{table.name}: qvel/{joint} has the sign opposite to the derivative of qpos/{joint}.")
        if like > ALIKE and not 1 / TWICE < times < TWICE:
            raise UserError(
                f"{table.name}: qvel/{joint} is {times:.3g} times the derivative of qpos/{joint}. Positions are needed "
                f"in {_unit(axis)}, speeds in {_unit(axis)}/s."
            )


def check_order(table: Table, servos: Mapping[str, str]) -> None:
    """A position servo moves after it was told to, not before.

    Raises:
        UserError: If its joint does what the command does, but earlier.
    """
    for actuator, joint in servos.items():
        told, did = np.diff(table.columns[f"ctrl/{actuator}"]), np.diff(table.columns[f"qpos/{joint}"])
        if len(told) < 4 * REACH or np.ptp(table.columns[f"qpos/{joint}"]) < MOVES * _scatter(did.cumsum()):
            continue
        core = did[REACH:-REACH]
        shifts = np.arange(-REACH, REACH + 1)  # how much later the command
        likes = [_correlation(told[REACH + s : len(told) - REACH + s], core) for s in shifts]
        ahead = int(shifts[int(np.argmax(likes))])
        if ahead >= LEAD and max(likes) > ALIKE and max(likes) - max(likes[: REACH + 1]) > 0.02:
            raise UserError(
                f"{table.name}: qpos/{joint} does what ctrl/{actuator} does, {ahead} samples earlier. Are commanded "
                "and measured positions swapped?"
            )


def _kind(axis: Axis) -> str:
    return "slide" if axis.slide else "hinge"


def _unit(axis: Axis) -> str:
    return "m" if axis.slide else "rad"


def _scatter(q: Array) -> float:
    """Noise of a position: what a straight line through the neighbours misses."""
    return float(np.median(np.abs(q[1:-1] - (q[2:] + q[:-2]) / 2))) + 1e-12


def _correlation(a: Array, b: Array) -> float:
    spread = float(np.std(a) * np.std(b))
    return float(np.mean((a - a.mean()) * (b - b.mean()))) / spread if spread > 0 else 0.0
