"""What of a deployment the model does not foretell, against the commands and the motion, where a law shows by eye."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.deployments.chain import Chain, Prediction
from mpc_sgft.diagnose.deployments.motion_link import JOINT_SAMPLES
from mpc_sgft.diagnose.page.laws import Law, Laws

T = TypeVar("T", bound=np.generic)
DRIVES, OBSERVATIONS = 3, 4  # that are drawn, at most
READING = (
    "Of a drive, what reached it in a control step beyond what was commanded: a wrong gain shows as a slope over the "
    "command, a delay or a lag over the command of the step before, a turn of commands as neither. Of an observation, "
    "how much further it went in a window than foretold: friction and scales show as a slope over how far it went."
)


def missing(chain: Chain, both: Prediction, repaired: bool) -> Laws:
    """Of the drives and the observations that are foretold worst, worst first.

    Args:
        chain: The deployment's windows.
        both: Predictions for all of them, of the nominal model and of the repaired one.
        repaired: Whether the second is another model.
    """
    told = _steps(both.drive[0])  # [W, n, nu]
    untold = chain.untold[:, JOINT_SAMPLES - 1 :: JOINT_SAMPLES]  # a step from or to a limit misses what others missed
    told_of = ~(_flat(untold) | _flat(untold, -1))
    drive = [_flat(_steps(chain.drive) - _steps(y)) * told_of for y in both.drive]
    along = [("commanded change", _flat(told)), ("commanded change, a step before", _flat(told, -1))]
    first = [chain.episodes[i].observation[s] for i, s in zip(chain.windows.episode, chain.windows.start, strict=True)]
    gone = [(chain.observed - y)[:, -1] for y in both.observation]
    went = [("change in the window", chain.observed[:, -1] - np.stack(first))]
    kinds = (
        ("drive", drive, along, told_of, chain.drive_scale, DRIVES),
        ("observation", gone, went, np.ones(gone[0].shape, bool), chain.observation_scale[:, -1], OBSERVATIONS),
    )
    laws = [
        Law(
            chain.groups[kind][i],
            "missing change",
            [(name, x[known[:, i], i]) for name, x in axes],
            lacking[0][known[:, i], i],
            lacking[1][known[:, i], i] if repaired else None,
        )
        for kind, lacking, axes, known, scale, most in kinds
        for i in _worst(lacking[0], scale)[:most]
    ]
    return Laws("What is missing", READING, laws)


def _steps(u: Array) -> Array:
    """Changes since the window's start [W, n J, nu] -> those of each control step [W, n, nu]."""
    return np.diff(u[:, JOINT_SAMPLES - 1 :: JOINT_SAMPLES], axis=1, prepend=0.0)


def _flat(steps: NDArray[T], shift: int = 0) -> NDArray[T]:
    """All steps but each window's first [W, n, nu] -> [W (n - 1), nu]; of the steps before with a shift of -1."""
    return steps[:, 1 + shift : steps.shape[1] + shift].reshape(-1, steps.shape[-1])


def _worst(lacking: Array, scale: Array | float) -> list[int]:
    """Columns of [M, k] that are foretold worse than they can be, by mean squares in units of that, worst first."""
    if not len(lacking):  # windows of a single step have none before
        return []
    error = ((lacking / scale) ** 2).mean(0)
    return [int(i) for i in np.argsort(-error) if error[i] > 1]
