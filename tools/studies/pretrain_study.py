"""Pretrain several seeds and write what each came to: results/pretrain/pretrain.csv.

python -m tools.studies.pretrain_study --seeds 0 1 2

Each run is `python -m mpc_sgft.pretrain` in its own process; a run whose summary is there is not repeated.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mpc_sgft.storage.run_folder import cpu_name

COLUMNS = "task seed transitions updates episodes_evaluated success success_low success_high prior_success".split()
COLUMNS += ["wall_seconds"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, default=Path("results/pretrain/pretrain.csv"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--task", default="push")
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides of every run")
    parser.add_argument("--runs", type=Path, default=Path("runs/pretrain"))
    parser.add_argument("--jobs", type=int, default=1, help="runs side by side; more are slower each")
    args = parser.parse_args()

    def work(seed: int) -> dict:
        folder = args.runs / f"{args.task}-{seed}"
        if not (folder / "summary.json").exists():
            words = [f"task={args.task}", f"seed={seed}", f"run_dir={folder}", "--quiet", *args.set]
            words = ["--resume", str(folder)] if folder.exists() else words
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            subprocess.run([sys.executable, "-m", "mpc_sgft.pretrain", *words], check=True, env=environment)
        return json.loads((folder / "summary.json").read_text())

    with ThreadPoolExecutor(args.jobs) as pool:
        found = list(pool.map(work, args.seeds))
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    with args.csv.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, "jobs", "cpu"])
        for r in found:
            low, high = r.pop("success_interval")
            r |= {"success_low": round(low, 3), "success_high": round(high, 3)}
            writer.writerow([*(r[c] for c in COLUMNS), args.jobs, cpu_name()])


if __name__ == "__main__":
    main()
