"""The least time that a plan and an update can take on these cores, beside the time they take.

    python -m tools.benchmarks.roofline [--sizes 1M 5M] [--precisions float32 bfloat16] [--out CSV]

One thread, TD-MPC2's search, slices of three steps. The arithmetic of the matrix products (`gflop`), and what all other
operations read and write (`gbyte`), are counted in one plan or update. `peak_gflops` is the best rate of a product of
this precision and `peak_gbyte` the best rate of a sum of two tensors, both as large as a hidden layer. One operation
runs after the other, so `floor_ms` is the sum of both at their peaks; `share` is its part of the best time. Calling an
operation, and the arithmetic of exponentials, cost nothing in the floor.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import ROOT, cpu_name, flop, jobs, seconds
from tools.studies.runner import write

COLUMNS = "what size precision gflop gbyte peak_gflops peak_gbyte floor_ms products_share best_ms share cpu".split()
PRODUCTS = {"mm", "addmm", "bmm", "baddbmm", "linear", "matmul"}
ROWS, WIDTH = 512, 384  # of a hidden layer in a plan of the 1M model


class Traffic(TorchDispatchMode):
    """Counts the bytes that operations read and write; a product's hide behind its arithmetic, a view has none."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if func.overloadpacket.__name__ not in PRODUCTS and not func.is_view:
            self.bytes += sum(x.numel() * x.element_size() for x in tree_leaves((args, kwargs, out)) if is_tensor(x))
        return out


def is_tensor(x: object) -> bool:
    return isinstance(x, Tensor)


def traffic(call: Callable[[], object]) -> int:
    """Bytes that one call moves outside its products."""
    with Traffic() as counted:
        call()
    return counted.bytes


def best(call: Callable[[], object], repeats: int = 200) -> float:
    """Shortest time of a call [s]."""
    return min(seconds(call, repeats)[0])


def peaks(precision: str) -> tuple[float, float]:
    """Best rates on a hidden layer: of a product of this precision [GFLOP/s], and of a sum of two tensors [GB/s]."""
    x, y, out = (torch.randn(ROWS, WIDTH) for _ in range(3))
    kind = torch.float32 if precision == "float32" else torch.bfloat16
    low, weight = x.to(kind), torch.randn(WIDTH, WIDTH).to(kind)
    product = 2 * ROWS * WIDTH**2 / best(lambda: torch.nn.functional.linear(low, weight))
    return product / 1e9, 3 * x.nbytes / best(lambda: torch.add(x, y, out=out)) / 1e9


def measure(size: str, precision: str) -> list[dict[str, object]]:
    """A row for a plan over four steps and one for an update."""
    rows = []
    for what, horizon, decay, _, call in jobs(size, precision, many=False):
        if decay != 1.0 or (what, horizon) not in (("plan", 4), ("update", 3)):
            continue
        call()
        gflop, gbyte, (gflops, rate), took = flop(call) / 1e9, traffic(call) / 1e9, peaks(precision), best(call, 20)
        products, floor = gflop / gflops, gflop / gflops + gbyte / rate
        row: dict[str, object] = {"what": what, "size": size, "precision": precision}
        row |= {"gflop": round(gflop, 2), "gbyte": round(gbyte, 3)}
        row |= {"peak_gflops": round(gflops), "peak_gbyte": round(rate), "floor_ms": round(1e3 * floor, 1)}
        row |= {"products_share": round(products / floor, 2), "best_ms": round(1e3 * took, 1)}
        row |= {"share": round(floor / took, 2), "cpu": cpu_name()}
        print("".join(f"{value:>15}" for value in row.values()), flush=True)
        rows.append(row)
    return rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["1M", "5M"])
    parser.add_argument("--precisions", nargs="+", default=["float32", "bfloat16"], choices=("float32", "bfloat16"))
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/roofline.csv")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    print("".join(f"{name:>15}" for name in COLUMNS))
    rows = [row for size in args.sizes for precision in args.precisions for row in measure(size, precision)]
    write(args.out, COLUMNS, rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
