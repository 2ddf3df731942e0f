"""The blind benchmark of `diagnose`: make cases from a seed, hide the labels, run, score, draw.

    python -m tools.studies.blind_benchmark --seed 20261 --cases 300 --out runs/blind [--jobs 2] [--csv CSV]
                                    [--only generate|run|score|pack] [--least-none 100] [--fr3 30] [--no-oracle]
                                    [--no-baselines] [--pack results/blind/blind_reports.jsonl.gz]

The labels' SHA-256 is printed before the solver starts, and checked before scoring. A seed that was used to tune the
solver must not be reported: 11, 901 to 905 and 20261121 to 20261128 so far.
Everything is resumable: what is on disk is not done again, nor what --pack holds, a file of all reports that is read
before the solver starts and written when it ends, or at once with --only pack, also while it runs. The CSV has one
row a score; beside it go <csv>_cases.csv with one row a case, <csv>_confusion.png and <csv>_power.png.
"""

import argparse
import csv
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import Manager
from pathlib import Path
from queue import Empty
from typing import Any

from tqdm import tqdm

from tools.studies.blind import baselines, cases, fr3_draw, fr3_make, score
from tools.studies.blind.draw import draw
from tools.studies.blind.make import make
from tools.studies.blind.pack import pack, unpack
from tools.studies.blind.plants import PLANTS
from tools.studies.blind.plots import draw as draw_plots
from tools.studies.blind.solve import reports, solve_all

STEPS = ("generate", "run", "score")


def generate(out: Path, seed: int, count: int, least_none: int, arms: int = 0, jobs: int = 1) -> str:
    """Cases and labels on disk, `arms` of the FR3 last; the labels' hash. Nothing is made anew if they are there.

    The cases do not depend on the number of jobs.

    Raises:
        ValueError: If the folder holds cases of another seed or another number of them.
    """
    drawn = draw(seed, count, least_none)
    extra = fr3_draw.draw(seed, arms, len(drawn))
    total = len(drawn) + len(extra)
    if (out / "labels.sha256").is_file():
        there = cases.labels(out)
        if cases.seed_of(out) != seed or len(there) != total:
            raise ValueError(
                f"{out} holds {len(there)} cases of seed {cases.seed_of(out)}, not {total} of seed {seed}. "
                "Give another --out, or delete that folder."
            )
        return (out / "labels.sha256").read_text().strip()
    parts = [(make, [c for c in drawn if c.plant == plant]) for plant in PLANTS] + [(fr3_make.make, [c]) for c in extra]
    made = in_processes(parts, total, jobs)
    return cases.write(out, [made[c.name] for c in drawn + extra], seed)


def in_processes(parts: Sequence[tuple[Callable[..., list[Any]], list[Any]]], total: int, jobs: int) -> dict[str, Any]:
    """Finished cases by name.

    Args:
        parts: How to make cases, and which: how(cases, progress) -> finished cases.
        total: Cases in all parts.
        jobs: Processes.
    """
    with tqdm(total=total, desc="generate", unit="case") as bar, Manager() as manager:
        done = manager.Queue()  # cases, and shares of them, that a process has finished
        with ProcessPoolExecutor(jobs) as pool:
            futures = [pool.submit(how, few, done.put) for how, few in parts if few]
            while not all(f.done() for f in futures) or not done.empty():
                with suppress(Empty):
                    bar.update(min(done.get(timeout=0.5), total - bar.n))  # shares may add up to a little more
        return {one.case.name: one for f in futures for one in f.result()}


def run(out: Path, jobs: int) -> None:
    """The solver on every case."""
    folders = sorted((out / "cases").iterdir())
    with tqdm(total=len(folders), desc="diagnose", unit="case") as bar:
        solve_all([(f, out / "reports" / f.name, None) for f in folders], jobs, bar.update)


def run_oracle(out: Path, jobs: int) -> None:
    """The solver, told the true names, on single-effect cases; only after all blind runs are done.

    Raises:
        ValueError: If blind runs are missing.
    """
    hidden = cases.labels(out)
    if missing := sorted(set(hidden) - set(reports(out))):
        raise ValueError(
            f"{len(missing)} cases have no report yet ({missing[0]} …): the oracle comes after the blind runs"
        )
    single = {n: [e["name"] for e in y["effects"]] for n, y in hidden.items() if y["group"] == "single"}
    with tqdm(total=len(single), desc="oracle", unit="case") as bar:
        solve_all([(out / "cases" / n, out / "oracle" / n, names) for n, names in single.items()], jobs, bar.update)


def run_baselines(out: Path, jobs: int) -> dict[str, dict[str, dict[str, Any]]]:
    """Reports by baseline and case; kept in baselines.json."""
    path = out / "baselines.json"
    if path.is_file():
        return json.loads(path.read_text())
    folders = sorted((out / "cases").iterdir())
    with ProcessPoolExecutor(jobs) as pool:
        every = list(tqdm(pool.map(baselines.run, folders), total=len(folders), desc="baselines", unit="case"))
    found = {b: {f.name: r[b] for f, r in zip(folders, every, strict=True)} for b in baselines.NAMES}
    path.write_text(json.dumps(found))
    return found


def write_scores(out: Path, target: Path, compared: dict[str, dict[str, dict[str, Any]]], seed: int) -> None:
    """Score everything, print the table, and write CSV files and pictures."""
    hidden, ours = cases.labels(out), reports(out)
    oracles = reports(out, "oracle")
    rows = []
    for method, said in {"diagnose": ours, **compared}.items():
        for s in score.table(said, hidden, oracles if method == "diagnose" else None):
            if s.count:
                rows.append({"method": method, "score": s.name, "value": round(s.value, 4), "low": round(s.low, 4)})
                rows[-1] |= {"high": round(s.high, 4), "hits": round(s.hits, 2), "of": s.count, "goal": s.goal}
    write_rows(target, [row | origin(out, seed) for row in rows])
    per_case = [_case_row(n, y, ours[n]) for n, y in hidden.items() if n in ours]
    write_rows(target.with_name(target.stem + "_cases.csv"), per_case)
    pictures = draw_plots(ours, hidden, target.parent, target.stem) if ours else []
    for row in rows:
        interval = f"[{row['low']:.3f}, {row['high']:.3f}]"
        print(f"{row['method']:15s} {row['score']:45s} {row['value']:.3f} {interval} of {row['of']:3d}  {row['goal']}")
    print("written:", target, *pictures)


def _case_row(name: str, label: dict[str, Any], report: dict[str, Any]) -> dict[str, Any]:
    keys = ("group", "kind", "plant", "seconds", "noise_level", "force_channel")
    held = report.get("held_out", {})
    return {
        "case": name,
        **{k: label[k] for k in keys},
        "truth": " ".join(f"{e['name']}@{','.join(e['at'])}x{e['multiple']:.2f}" for e in label["effects"]),
        "verdict": report["verdict"],
        "said": " ".join(score.named(report)),
        "right": score.top1(report, label) if label["group"] in ("single", "pair") else "",
        "nominal": held.get("nominal", ""),
        "repaired": held.get("repaired", ""),
        "seconds_spent": round(report.get("wall_seconds", float("nan")), 2),
    }


def origin(out: Path, seed: int) -> dict[str, Any]:
    """Where scores come from: columns of every row."""
    labels = {"seed": seed, "labels_sha256": (out / "labels.sha256").read_text().strip()[:16]}
    return labels | {"cores": os.cpu_count(), "python": platform.python_version(), "system": platform.platform()}


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """A CSV of rows with the same columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else ["method"])
        writer.writeheader()
        writer.writerows(rows)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True, help="of the cases; a fresh one for what is reported")
    parser.add_argument("--cases", type=int, default=300, help="how many (default 300)")
    parser.add_argument("--least-none", type=int, default=0, help="add cases without effect until there are so many")
    parser.add_argument("--fr3", type=int, default=0, help="so many cases of the FR3 beside the others (default 0)")
    parser.add_argument("--out", type=Path, required=True, help="folder for cases, labels and reports")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--only", choices=(*STEPS, "pack"), help="one step (default: all)")
    parser.add_argument("--csv", type=Path, help="scores (default OUT/scores.csv)")
    parser.add_argument("--pack", type=Path, help="file of all reports, to go on with them elsewhere")
    parser.add_argument("--no-oracle", action="store_true", help="leave out the runs that know the true names")
    parser.add_argument("--no-baselines", action="store_true", help="leave out the simpler ways to name")
    args = parser.parse_args(argv)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # for the processes that are started
    steps = (args.only,) if args.only else STEPS
    try:
        if "generate" in steps:
            generate(args.out, args.seed, args.cases, args.least_none, args.fr3, args.jobs)
        print("labels SHA-256", cases.sealed(args.out, args.seed), flush=True)
        if args.only == "pack" and not args.pack:
            raise ValueError("--only pack needs the file: --pack results/blind/blind_reports.jsonl.gz")
        if args.pack and args.pack.is_file():
            new, other = unpack(args.pack, args.out)
            print(f"{new} reports taken over from {args.pack}", flush=True)
            if other:
                print(f"{other} left out: this processor rounds their cases to other labels", flush=True)
        if "run" in steps:
            run(args.out, args.jobs)
            if not args.no_oracle:
                run_oracle(args.out, args.jobs)
        if args.pack and {"run", "pack"} & {*steps}:
            print(f"{pack(args.out, args.pack)} reports in {args.pack}", flush=True)
        if "score" in steps:
            compared = {} if args.no_baselines else run_baselines(args.out, args.jobs)
            write_scores(args.out, args.csv or args.out / "scores.csv", compared, args.seed)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
