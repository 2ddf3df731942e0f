"""Run many deployments, side by side and resumable, and collect their learning curves into one CSV.

    python -m tools.studies.study results/transfer/sgft.csv --gaps turned sluggish skate --seeds 0 1 2 3 4
    python -m tools.studies.study out.csv --gaps sluggish --variants horizon=1 "horizon=2 method.anchor=0"

Each run is `python -m mpc_sgft.deploy` in a process of its own with one thread; its folder is kept under --runs, and a
run whose summary is there is not repeated; --launcher starts the runs on other machines. With several --checkpoints,
seed s uses number s modulo their count.
"""

import argparse
import itertools
import sys
from collections.abc import Collection
from pathlib import Path

from tools.studies.runner import each, finished, first_mean, write

COLUMNS = ["gap", "method", "variant", "seed", "rollouts", "success", "return", "episodes", "audit", "frozen_sha256"]
COLUMNS += ["updates", "seconds"]
AUDITED = 5  # rollouts, the first, whose mean improvability share stands in each row as `audit`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is run, and how; the CSV is not among them."""
    parser.add_argument("--gaps", nargs="+", required=True)
    parser.add_argument("--methods", nargs="+", default=["sgft"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument(
        "--checkpoints", nargs="+", default=[None], help="run folders or files; default: the shipped one"
    )
    parser.add_argument(
        "--variants", nargs="+", default=[""], metavar="'name=value ...'", help="a run for each; '' as it is"
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides of every run")
    parser.add_argument("--runs", type=Path, default=Path("runs/study"))
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument(
        "--launcher", help="Hydra launcher of the runs, e.g. submitit_slurm; its settings go into --set"
    )


def run(path: Path, args: argparse.Namespace, name: str, known: Collection[tuple[str, str, str, int]] = ()) -> None:
    """Run what is not there yet, and write the learning curves of all to a CSV; exits if some failed.

    Args:
        path: The CSV.
        args: Of `add_arguments`.
        name: That the run folders begin with: other settings want another one.
        known: Runs that were measured elsewhere, (gap, method, variant, seed).
    """
    every = itertools.product(args.seeds, args.gaps, args.methods, args.variants)
    jobs = [
        (seed, gap, method, variant)
        for seed, gap, method, variant in every
        if (gap, method, variant, seed) not in known
    ]

    def work(job: tuple[int, str, str, str]) -> dict:
        seed, gap, method, variant = job
        checkpoint = args.checkpoints[seed % len(args.checkpoints)]
        label = "-".join(
            str(x).translate(str.maketrans("/= ", "__+")) for x in (name, gap, method, variant, seed) if x != ""
        )
        words = [f"gap={gap}", f"method={method}", f"seed={seed}", "log.rerun=false"]
        words += variant.split()
        words += [f"checkpoint={checkpoint}"] if checkpoint else []
        result = finished("deploy", args.runs / label, [*words, *args.set], args.launcher)
        curve = ", ".join(f"{k}: {v:.0%}" for k, v in result["curve"].items())
        print(f"{label}: {curve} ({result['wall_seconds']:.0f} s)", flush=True)
        audit = first_mean(args.runs / label, "audit_share", AUDITED)
        return result | {"variant": variant, "audit": None if audit is None else round(audit, 4)}

    results, failed = each(jobs, work, args.jobs)
    rows = [
        {
            **r,
            "rollouts": k,
            "success": s,
            "return": r.get("return_curve", {}).get(k),  # runs of earlier versions did not say it
            "episodes": r["evaluation_episodes"],
            "frozen_sha256": r["frozen_sha256"][:12],
            "seconds": r["wall_seconds"],
        }
        for r in results
        for k, s in r["curve"].items()
    ]
    write(path, COLUMNS, rows)
    if failed:
        sys.exit(f"{failed} of {len(jobs)} runs failed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    add_arguments(parser)
    args = parser.parse_args()
    run(args.csv, args, args.csv.stem)


if __name__ == "__main__":
    main()
