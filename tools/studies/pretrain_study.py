"""Pretrain several seeds and write what each came to: results/pretrain/pretrain.csv.

    python -m tools.studies.pretrain_study --seeds 0 1 2

Each run is `python -m mpc_sgft.pretrain` in its own process; a run whose summary is there is not repeated.
"""

import argparse
import sys
from pathlib import Path

from mpc_sgft.storage.run_folder import cpu_name
from tools.studies.runner import each, finished, write

COLUMNS = "task seed transitions updates episodes_evaluated success success_low success_high prior_success".split()
PARTS = ("update", "wait", "evaluate", "save")  # where the seconds went: learning, waiting for episodes, and so on
PARTS += ("physics", "act")  # beside them, in the processes that collect
PROCESSES = ("learner", "collector")  # the most memory that each held; the workers of a Ray cluster are no collector
COLUMNS += ["wall_seconds", *(f"{part}_seconds" for part in PARTS), *(f"{name}_mb" for name in PROCESSES)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, default=Path("results/pretrain/pretrain.csv"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--task", default="push")
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides of every run")
    parser.add_argument("--runs", type=Path, default=Path("runs/pretrain"))
    parser.add_argument("--jobs", type=int, default=1, help="runs side by side; more are slower each")
    parser.add_argument(
        "--launcher", help="Hydra launcher of the runs, e.g. submitit_slurm; its settings go into --set"
    )
    args = parser.parse_args()

    def work(seed: int) -> dict:
        overrides = [f"task={args.task}", f"seed={seed}", *args.set]
        result = finished("pretrain", args.runs / f"{args.task}-{seed}", overrides, args.launcher)
        low, high = result["success_interval"]
        parts = {f"{part}_seconds": result["seconds"][part] for part in PARTS}
        parts |= {f"{name}_mb": result["peak_memory_mb"][name] for name in PROCESSES}
        return result | {"success_low": round(low, 3), "success_high": round(high, 3)} | parts

    found, failed = each(args.seeds, work, args.jobs)
    machine = {"jobs": args.jobs, "cpu": cpu_name()}
    write(args.csv, [*COLUMNS, *machine], [r | machine for r in found])
    if failed:
        sys.exit(f"{failed} of {len(args.seeds)} runs failed")


if __name__ == "__main__":
    main()
