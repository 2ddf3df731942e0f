"""Where the time of an update goes, by operation.

    python -m tools.benchmarks.profile_update [--sizes small 1M 5M] [--precisions float32 bfloat16] [--out CSV]

One thread, slices of three steps. `share` is of the time that all operations take themselves; `products` is matrix
products. What the profiler adds to each operation is in its time.
"""

import argparse
import sys
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import ROOT, cpu_name, jobs
from tools.studies.runner import write

COLUMNS = ["size", "precision", "operation", "ms", "share", "calls", "cpu"]
UPDATES, LARGEST = 5, 12
PRODUCTS = ("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm")


def measure(size: str, precision: str) -> list[dict[str, object]]:
    """The largest operations of an update, matrix products and the rest as one row each."""
    call = next(
        call for what, horizon, *_, call in jobs(size, precision, many=False) if (what, horizon) == ("update", 3)
    )
    call()
    with profile(activities=[ProfilerActivity.CPU]) as found:
        for _ in range(UPDATES):
            call()
    spent: dict[str, list[float]] = {}
    for event in found.key_averages():
        name = "products" if event.key in PRODUCTS else event.key
        row = spent.setdefault(name, [0.0, 0.0])
        row[0] += event.self_cpu_time_total / 1e3 / UPDATES
        row[1] += event.count / UPDATES
    ordered = sorted(spent.items(), key=lambda item: -item[1][0])
    rest = [sum(row[i] for _, row in ordered[LARGEST:]) for i in range(2)]
    total = sum(ms for ms, _ in spent.values())
    return [
        {"size": size, "precision": precision, "operation": name, "ms": round(ms, 2), "share": round(ms / total, 3),
         "calls": round(calls), "cpu": cpu_name()}
        for name, (ms, calls) in [*ordered[:LARGEST], ("everything else", rest)]
    ]  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["small", "1M", "5M"])
    parser.add_argument("--precisions", nargs="+", default=["float32", "bfloat16"])
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/profile_update.csv")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    rows = [row for size in args.sizes for precision in args.precisions for row in measure(size, precision)]
    write(args.out, COLUMNS, rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
