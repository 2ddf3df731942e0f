"""An update whose networks `torch.compile` compiled beside one as it is, and after how many updates that pays back.

    python -m tools.benchmarks.time_compile [--sizes small 1M] [--precisions float32 bfloat16] [--out CSV]

One thread; an update of pretraining on 256 slices of three steps, as `time_planner` measures it. Every network of the
model is compiled by itself (`nn.Module.compile`): what lies between them asks for numbers on the way. Both are timed in
turn. `compile_s` is the time of the first three updates, in which it compiles, less that of three others;
`pays_after` is how many updates make up for it, empty where none ever do.
"""

import argparse
import sys
import time
from pathlib import Path

import torch

from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import ROOT, SPACES, UPSTREAM, agent_of, cpu_name, random_batch, seconds
from tools.studies.runner import write

COLUMNS = "size precision plain_ms compiled_ms to_plain compile_s pays_after cpu torch".split()
REPEATS, STEPS, FIRST, BACKEND = 20, 3, 3, "inductor"


def measure(size: str, precision: str) -> dict[str, object]:
    plain, compiled = agent_of(size, precision), agent_of(size, precision)
    batch = random_batch(*SPACES.get(size, UPSTREAM), STEPS)
    for network in compiled.model.children():
        network.compile(backend=BACKEND)
    start = time.perf_counter()
    for _ in range(FIRST):
        compiled.update(batch)
    first, best = time.perf_counter() - start, [float("inf")] * 2
    for _ in range(REPEATS):
        for i, agent in enumerate((plain, compiled)):
            best[i] = min(best[i], *seconds(lambda agent=agent: agent.update(batch), 2)[0])
    spent, gained = max(first - FIRST * best[1], 0.0), best[0] - best[1]
    row: dict[str, object] = {"size": size, "precision": precision, "to_plain": round(best[1] / best[0], 2)}
    row |= {"plain_ms": round(1e3 * best[0], 1), "compiled_ms": round(1e3 * best[1], 1), "compile_s": round(spent, 1)}
    row["pays_after"] = round(spent / gained) if gained > 0 else None
    return row | {"cpu": cpu_name(), "torch": torch.__version__}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["small", "1M"])
    parser.add_argument("--precisions", nargs="+", default=["float32", "bfloat16"])
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/time_compile.csv")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    rows = [measure(size, precision) for size in args.sizes for precision in args.precisions]
    write(args.out, COLUMNS, rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
