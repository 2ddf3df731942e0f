"""The search for the best Beta distributions; apart from them, since its solver takes time to import."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from mpc_sgft.learning.beta import EDGE, MOST

Function = Callable[[Tensor], Tensor]


def climb(goal: Function, limits: Sequence[Function], start: Tensor) -> Tensor:
    """Where `goal` is highest with all `limits` at least 0, from a start that keeps them; the start if none is found.

    Args:
        goal, limits: Of logarithms of parameters [D, 2].
        start: [D, 2].
    """

    def value(f: Function, sign: float) -> Callable[[np.ndarray], float]:
        return lambda x: sign * float(f(torch.from_numpy(x).view_as(start)))

    def slope(f: Function, sign: float) -> Callable[[np.ndarray], np.ndarray]:
        def at(x: np.ndarray) -> np.ndarray:
            point = torch.from_numpy(x.copy()).requires_grad_()
            f(point.view_as(start)).backward()
            assert point.grad is not None
            return sign * point.grad.numpy()

        return at

    found = minimize(
        value(goal, -1.0),
        start.flatten().numpy(),
        jac=slope(goal, -1.0),
        bounds=[(0.0, float(np.log(MOST)))] * start.numel(),
        constraints=[{"type": "ineq", "fun": value(f, 1.0), "jac": slope(f, 1.0)} for f in limits],
        method="SLSQP",
    )
    end = torch.from_numpy(found.x).view_as(start)
    keeps = all(float(f(end)) > -EDGE for f in limits)
    return end if keeps and goal(end) > goal(start) else start
