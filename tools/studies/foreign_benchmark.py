"""`diagnose` on foreign grounds: make cases from a seed, hide the labels, run, score.

    python -m tools.studies.foreign_benchmark --seed 31 --cases 100 --out runs/foreign [--ground NAME] [--jobs 2]
                                              [--only generate|run|score] [--csv results/foreign/foreign.csv]

`--cases` are those of each ground. Every case has small imperfections of everything; its label holds the effects that
move predictions by more than a tolerance which the solver is told. The labels' SHA-256 is printed before the solver
starts, and checked before scoring. What is on disk is not done again. A seed that was used to tune the solver must not
be reported: 1 to 7, 1031, 2077, 3163, 4219, 5261 and 6367. The CSV has one row a score; beside it goes <csv>_cases.csv
with one row a case.
"""

import argparse
import os
import sys
from pathlib import Path

from tools.studies.blind import cases
from tools.studies.blind.solve import reports
from tools.studies.blind_benchmark import origin, run, write_rows
from tools.studies.foreign import score
from tools.studies.foreign.grounds import GROUNDS, check

STEPS = ("generate", "run", "score")


def generate(out: Path, ground: str, seed: int, count: int, jobs: int) -> None:
    """Cases and labels of a ground, unless they are there.

    Raises:
        ValueError: If the folder holds cases of another seed or another number of them.
    """
    if not (out / "labels.sha256").is_file():
        GROUNDS[ground](out, seed, count, jobs)
    there, of = len(cases.labels(out)), cases.seed_of(out)
    if (of, there) != (seed, count):
        raise ValueError(
            f"{out} holds {there} cases of seed {of}, not {count} of seed {seed}. Give another --out, or delete it."
        )


def write_scores(out: Path, grounds: list[str], target: Path, seed: int) -> None:
    """Score every ground, print the table, and write both CSV files."""
    rows, per_case = [], []
    for ground in grounds:
        hidden, said = cases.labels(out / ground), reports(out / ground)
        for line in score.table(said, hidden):
            if line.of:
                numbers = {k: round(x, 4) if isinstance(x, float) else x for k, x in line._asdict().items()}
                rows.append({"ground": ground, **numbers, **origin(out / ground, seed)})
                interval = f"[{line.low:.3f}, {line.high:.3f}]"
                print(f"{ground:10s} {line.score:42s} {line.value:7.3f} {interval} of {line.of:3d}  {line.goal}")
        per_case += [{"ground": ground, **score.row(n, y, said[n])} for n, y in hidden.items() if n in said]
    write_rows(target, rows)
    write_rows(target.with_name(target.stem + "_cases.csv"), per_case)
    print("written:", target)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True, help="of the cases; a fresh one for what is reported")
    parser.add_argument("--cases", type=int, default=100, help="how many on each ground (default 100)")
    parser.add_argument("--ground", action="append", choices=GROUNDS, help="one ground, repeatable (default: all)")
    parser.add_argument("--out", type=Path, required=True, help="folder for cases, labels and reports")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--only", choices=STEPS, help="one step (default: all)")
    parser.add_argument("--csv", type=Path, help="scores (default OUT/scores.csv)")
    args = parser.parse_args(argv)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # for the processes that are started
    steps, grounds = (args.only,) if args.only else STEPS, args.ground or list(GROUNDS)
    try:
        if "generate" in steps:
            check(grounds)
        for ground in grounds:
            folder = args.out / ground
            if "generate" in steps:
                generate(folder, ground, args.seed, args.cases, args.jobs)
            print(ground, "labels SHA-256", cases.sealed(folder, args.seed), flush=True)
        if "run" in steps:
            for ground in grounds:
                run(args.out / ground, args.jobs)
        if "score" in steps:
            write_scores(args.out, grounds, args.csv or args.out / "scores.csv", args.seed)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
