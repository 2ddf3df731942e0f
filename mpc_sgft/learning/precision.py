"""In which precision the matrix products of plans and updates run."""

import warnings
from collections.abc import Callable
from functools import cache, wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

import torch

from mpc_sgft.learning.products import has_bfloat16, products_in
from planners.base import PRECISIONS

WIDE = 256  # hidden units from which bfloat16 products save more than rounding costs


def dtype_of_products(precision: str, width: int, device: torch.device) -> torch.dtype:
    """The type that `planner.precision=` or `train.agent.precision=` asks for.

    Args:
        precision: Of planners.base.PRECISIONS; auto is bfloat16 for wide models where the processor has its products.
        width: Hidden units of the heads.
        device: Where they are.

    Raises:
        ValueError: If precision is unknown.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision!r}. Available: {', '.join(PRECISIONS)}.")
    if precision == "float32" or (precision == "auto" and (width < WIDE or not has_bfloat16(device.type))):
        return torch.float32
    if not has_bfloat16(device.type):
        _warn_once()
    return torch.bfloat16


@cache
def _warn_once() -> None:
    warnings.warn(
        "precision=bfloat16: this processor has no bfloat16 products. Numbers are rounded as if it had, and take, as "
        "measured, 1.0 to 1.2 times as long as float32 with the 1M model and up to 1.7 times with the small one. Use "
        "precision=auto or float32.",
        stacklevel=3,
    )


class HasProducts(Protocol):
    """Whatever has matrix products of a type of its own."""

    products: torch.dtype


P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S", bound=HasProducts)


def in_own_precision(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Run a method with the matrix products of `Linear` in the type that `self.products` says."""

    @wraps(method)
    def within(self: S, *args: P.args, **kwargs: P.kwargs) -> R:
        with products_in(self.products):
            return method(self, *args, **kwargs)

    return within
