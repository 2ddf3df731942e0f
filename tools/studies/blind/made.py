"""What a finished case is, on which ground it was made, and what the labels say of its effects."""

from typing import Any, NamedTuple

import numpy as np

from tools.studies.blind.draw import BLIND, Case, Given, Mix
from tools.studies.blind.library import EVERYTHING
from tools.studies.blind.plants import Array

TIMESTAMP_SD = 5e-6  # [s] of the clock, where there is jitter
WILD = {"slide": 1.5, "hinge": 6.0}  # [m or rad] a run that goes further is made again with smaller effects


class Ground(NamedTuple):
    """What reality is like beside the effects of a case.

    Attributes:
        mix: Groups, and sizes of what is hidden.
        border: Change of predictions that matters, as a share of a signal's standard deviation. Where it is above 0,
            every case gets flaws below it, and an effect counts as detectable only at a size that matters, too.
    """

    mix: Mix = BLIND
    border: float = 0.0


PLAIN = Ground()


class Made(NamedTuple):
    """A finished case.

    Attributes:
        case: What was asked for.
        episodes: One mapping of columns [T] for each file.
        truth: For the labels: for each effect name, joint, size, detectable size, multiple, parameters.
        floor: Noise floor of each joint [m or rad].
        more: What else the label says.
    """

    case: Case
    episodes: list[dict[str, Array]]
    truth: list[dict[str, Any]]
    floor: list[float]
    more: dict[str, Any] = {}


def label(given: Given, size: float, unit: float, scale: dict[str, float], others: list[str]) -> dict[str, Any]:
    """What the labels say of one effect.

    Args:
        given: As drawn.
        size: Its own.
        unit: Its detectable size; not finite if no size of it is.
        scale: Of its joint (see library).
        others: Names that the data cannot tell from it.
    """
    can = bool(np.isfinite(unit))
    return {
        "name": given.name,
        "joint": given.joint,
        "size": size,
        "detectable": unit if can else None,
        "multiple": size / unit if can else 0.0,
        "parameters": EVERYTHING[given.name].report(size, given.shape, scale),
        "alike": others,
    }
