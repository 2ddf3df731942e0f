"""The benchmark of methods: run tasks with gaps x methods x seeds, one row a run, and say who wins by how much.

    python -m tools.studies.benchmark results/benchmark --gaps turned skate --methods sgft sac iql --seeds 0 1 2 3 4

Runs are those of `tools.studies.study`: side by side, resumable, on other machines with --launcher. `--with` takes in
curves that were measured before, and what they hold is not run again; `--score-only` runs nothing. In FOLDER it writes

    curves.csv    success after so many real rollouts, of the runs made here
    runs.csv      one row a run and number of rollouts: success before and after, area under the curve, and once a run
                  what it cost in updates and seconds, evaluations included
    scores.csv    each gap, and all of them: median, interquartile mean, and its 95 % bootstrap interval
    better.csv    how probable it is that a run of one method ends above one of another, and its interval

Measures and bootstrap are rliable's: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice", NeurIPS 2021.
"""

import argparse
import itertools
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.studies import study
from tools.studies.runner import Runs, named, read_curves, write

RUN = ["gap", "method", "seed", "rollouts", "before", "after", "area", "rollouts_to_90", "updates", "seconds"]
SCORE = ["gap", "method", "rollouts", "runs", "median", "iqm", "low", "high"]
BETTER = ["method", "over", "rollouts", "gaps", "probability", "low", "high"]
RESAMPLES = 2000
GOOD = 0.9  # success that a run is asked for
Scores = NDArray[np.float64]  # [runs, gaps]


def summaries(runs: Runs, rollouts: int) -> list[dict[str, Any]]:
    """One row a run, up to so many rollouts; a run that was not measured then is left out."""
    found = []
    for gap, methods in runs.items():
        for method, seeds in methods.items():
            for seed, curve in sorted(seeds.items()):
                if rollouts not in curve:
                    continue
                counts = sorted(count for count in curve if count <= rollouts)
                success = [float(curve[count]["success"]) for count in counts]
                reached = [count for count, share in zip(counts, success, strict=True) if share >= GOOD]
                cost = {key: curve[rollouts].get(key) or "" for key in ("updates", "seconds")}
                found.append(
                    {"gap": gap, "method": method, "seed": seed, "rollouts": rollouts, "before": success[0]}
                    | {"after": success[-1], "area": area(success, counts)}
                    | {"rollouts_to_90": reached[0] if reached else ""}
                    | (cost if rollouts == max(curve) else {})
                )
    return found


def area(success: Sequence[float], counts: Sequence[int]) -> float:
    """Mean success on the way, of a curve that runs straight between its points."""
    width = counts[-1] - counts[0]
    return round(float(np.trapezoid(success, counts)) / width, 4) if width else success[-1]


def matrix(rows: Sequence[dict[str, Any]], method: str, gaps: Sequence[str]) -> Scores | None:
    """Success of a method's runs in each of some gaps, [runs, gaps]; None unless all gaps have as many runs."""
    columns = [[row["after"] for row in rows if row["method"] == method and row["gap"] == gap] for gap in gaps]
    whole = len({len(column) for column in columns}) == 1 and columns[0]
    return np.array(columns).T if whole else None


def estimates(scores: dict[str, Any], measure: Callable[..., Any]) -> dict[str, list[float]]:
    """A measure of each entry, and its 95 % stratified bootstrap interval: [value, low, high].

    Raises:
        ImportError: If rliable is not installed.
    """
    from rliable import library

    before = np.random.get_state()
    np.random.seed(0)  # which rliable's resampling draws from, whatever generator it is given
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the bootstrap's own arguments, which rliable passes the old way
            points, intervals = library.get_interval_estimates(scores, measure, reps=RESAMPLES)
    finally:
        np.random.set_state(before)
    return {key: [round(float(x), 4) for x in (np.ravel(points[key])[0], *intervals[key][:, 0])] for key in scores}


def scored(rows: Sequence[dict[str, Any]], rollouts: int) -> list[dict[str, Any]]:
    """Each method in each gap, and in all gaps where it has as many runs in each."""
    from rliable import metrics

    gaps = list(dict.fromkeys(row["gap"] for row in rows))
    found = []
    for name, several in [("all", gaps), *((gap, [gap]) for gap in gaps)]:
        table = {m: matrix(rows, m, several) for m in dict.fromkeys(row["method"] for row in rows)}
        whole = {method: scores for method, scores in table.items() if scores is not None}
        iqm = estimates(whole, lambda scores: np.array([metrics.aggregate_iqm(scores)])) if whole else {}
        for method, (value, low, high) in iqm.items():
            middle = round(float(np.median(whole[method])), 4)
            found.append(
                {"gap": name, "method": method, "rollouts": rollouts, "runs": whole[method].size, "median": middle}
                | {"iqm": value, "low": low, "high": high}
            )
    return found


def better(rows: Sequence[dict[str, Any]], rollouts: int) -> list[dict[str, Any]]:
    """For each two methods, over the gaps in which each has all of its runs; ties count half."""
    from rliable import metrics

    methods, found = list(dict.fromkeys(row["method"] for row in rows)), []
    counts = Counter((row["method"], row["gap"]) for row in rows)
    most = {m: max(n for (method, _), n in counts.items() if method == m) for m in methods}
    for one, other in itertools.combinations(methods, 2):
        gaps = [g for g in dict.fromkeys(r["gap"] for r in rows) if all(counts[m, g] == most[m] for m in (one, other))]
        if not gaps:
            continue
        scores = matrix(rows, one, gaps), matrix(rows, other, gaps)
        value, low, high = estimates({"pair": scores}, metrics.probability_of_improvement)["pair"]
        turned = [round(1 - x, 4) for x in (value, high, low)]  # ties count half either way
        for method, over, found_here in ((one, other, (value, low, high)), (other, one, turned)):
            numbers = dict(zip(("probability", "low", "high"), found_here, strict=True))
            found.append({"method": method, "over": over, "rollouts": rollouts, "gaps": " ".join(gaps)} | numbers)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    study.add_arguments(parser)
    parser.add_argument("--with", nargs="*", default=[], type=Path, dest="measured", help="CSVs of curves to take in")
    parser.add_argument("--score-only", action="store_true", help="run nothing, score what there is")
    parser.add_argument(
        "--at", nargs="+", type=int, default=[10, 30], help="real rollouts after which methods are compared"
    )
    args = parser.parse_args()
    try:
        import rliable  # noqa: F401
    except ImportError:
        parser.error("rliable is not installed: pip install 'mpc_sgft[benchmark]'")
    curves = args.folder / "curves.csv"
    if curves.resolve() in [path.resolve() for path in args.measured]:
        parser.error(f"--with {curves}: that is where the runs made here are written. Move it, or give another FOLDER.")
    wanted = list(itertools.product(args.gaps, args.methods, args.variants, args.seeds))
    try:
        there = read_curves(args.measured)
        if not args.score_only:
            known = {key for key in wanted if key[3] in there[key[0]][named(*key[1:3])]}
            if not {*wanted} <= known:
                study.run(curves, args, args.folder.name, known)
        runs = read_curves([*([curves] if curves.exists() else []), *args.measured])
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")
    chosen: Runs = {gap: {} for gap in args.gaps}
    for gap, method, variant, seed in wanted:
        if seed in runs[gap][named(method, variant)]:
            chosen[gap].setdefault(named(method, variant), {})[seed] = runs[gap][named(method, variant)][seed]
    rows = {count: summaries(chosen, count) for count in args.at}
    if not any(rows.values()):
        sys.exit(f"no run of {', '.join(args.methods)} in {', '.join(args.gaps)} was measured after {args.at} rollouts")
    write(args.folder / "runs.csv", RUN, itertools.chain(*rows.values()))
    write(args.folder / "scores.csv", SCORE, itertools.chain(*(scored(rows[count], count) for count in args.at)))
    write(args.folder / "better.csv", BETTER, itertools.chain(*(better(rows[count], count) for count in args.at)))


if __name__ == "__main__":
    main()
