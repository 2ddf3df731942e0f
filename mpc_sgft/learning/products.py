"""Matrix products whose inputs and results are rounded to bfloat16, with float32 for everything else."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn


@cache
def has_bfloat16(device: str) -> bool:
    """Whether products of bfloat16 run in hardware on a device type."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able = torch.cpu.get_capabilities()
    return any(able.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16"))


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x W^T + b as `F.linear`, of tensors of one type; in bfloat16 sums are float32 and the result is rounded.

    Where the hardware has no products of bfloat16, the rounded numbers are multiplied in float32: the same
    but for the order of sums, and the library's own detour takes several times as long.
    """
    if x.dtype != torch.bfloat16 or has_bfloat16(x.device.type):
        return F.linear(x, weight, bias)
    return F.linear(x.float(), weight.float(), None if bias is None else bias.float()).bfloat16()


class _RoundedProduct(torch.autograd.Function):
    """x W^T + b with inputs and results of the three products in bfloat16; x, W, b and the slopes are float32."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        low = x.bfloat16(), weight.bfloat16()
        ctx.save_for_backward(*low)
        return linear(*low, bias.bfloat16()).float()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        x, weight = ctx.saved_tensors
        low, (for_x, for_weight, for_bias) = grad.bfloat16().flatten(0, -2), ctx.needs_input_grad
        return (
            linear(low, weight.T).float().view(x.shape) if for_x else None,
            linear(low.T, x.flatten(0, -2).T).float() if for_weight else None,
            grad.flatten(0, -2).sum(0) if for_bias else None,
        )


_rounded: ContextVar[bool] = ContextVar("rounded", default=False)


@contextmanager
def products_in(dtype: torch.dtype) -> Iterator[None]:
    """Within, matrix products of `Linear` run in float32 or bfloat16; parameters and all else stay float32."""
    token = _rounded.set(dtype == torch.bfloat16)
    try:
        yield
    finally:
        _rounded.reset(token)


class Linear(nn.Linear):
    """`nn.Linear` that heeds `products_in`."""

    def forward(self, input: Tensor) -> Tensor:
        return _RoundedProduct.apply(input, self.weight, self.bias) if _rounded.get() else super().forward(input)  # type: ignore[no-any-return]
