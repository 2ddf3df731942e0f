"""How fast rounds of pretraining are collected, by collector and number of workers, while nothing is learned.

    python -m tools.benchmarks.time_collect [--rounds 5] [--kinds inline process ray] [--workers 1 2 4] [--out CSV]

A worker is one thread of physics and one of PyTorch. `bytes_per_step` is what a worker sends for one transition,
`weights_bytes` what it is sent for a round. More workers than cores share them.
"""

import argparse
import os
import pickle
import sys
import time
from pathlib import Path
from statistics import median

from mpc_sgft.command import compose
from mpc_sgft.runs import build
from mpc_sgft.runs.collectors import AbstractCollector, Inline, Process
from mpc_sgft.runs.explore import Round, policy_weights
from mpc_sgft.runs.ray_collector import Ray
from tools.benchmarks.time_planner import cpu_name
from tools.studies.runner import write

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = ["collector", "workers", "envs", "steps", "start_s", "median_s", "steps_per_s", "to_inline"]
COLUMNS += ["bytes_per_step", "weights_bytes", "cpu", "cores"]


def measure(kind: str, workers: int, rounds: int, overrides: list[str]) -> dict[str, object]:
    """Median time of a round, after one that is not counted, and of the start."""
    cfg = compose.compose("pretrain", overrides, [])
    model = build.make_agent(cfg, build.make_env(cfg, 1)).model
    began = time.monotonic()
    collector: AbstractCollector
    if kind == "inline":
        collector = Inline(cfg, model.sizes)
    else:
        collector = {"process": Process, "ray": Ray}[kind](cfg, model.sizes, workers=workers)
    order, seconds = Round(0, policy_weights(model)), []
    for number in range(rounds + 1):
        if number == 1:
            start = time.monotonic() - began
        at = time.monotonic()
        collector.start(order._replace(number=number))
        found = collector.result()
        seconds.append(time.monotonic() - at)
    collector.close()
    steps, middle = found.steps.numel(), median(seconds[1:])
    return {
        "collector": kind, "workers": workers, "envs": cfg.num_envs, "steps": steps, "start_s": round(start, 1),
        "median_s": round(middle, 2), "steps_per_s": round(steps / middle),
        "bytes_per_step": round(len(pickle.dumps(found)) / steps), "weights_bytes": len(pickle.dumps(order)),
        "cpu": cpu_name(), "cores": os.cpu_count(),
    }  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--kinds", nargs="+", default=["inline", "process", "ray"], choices=["inline", "process", "ray"]
    )
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--set", nargs="*", default=["task=push", "device=cpu"], metavar="name=value")
    parser.add_argument("--out", type=Path, default=ROOT / "results/scale/time_collect.csv")
    args = parser.parse_args(arguments)
    rows: list[dict[str, object]] = []
    for kind in args.kinds:
        for workers in [1] if kind == "inline" else args.workers:
            rows.append(measure(kind, workers, args.rounds, args.set))
            first = float(str(rows[0]["steps_per_s"]))
            rows[-1]["to_inline"] = round(float(str(rows[-1]["steps_per_s"])) / first, 2) if kind != "inline" else 1.0
            print(rows[-1], flush=True)
            write(args.out, COLUMNS, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
