"""What each number in the judgement of `diagnose` is worth: the verdicts of a benchmark's cases without it.

    python -m tools.studies.judgement CASES [CASES ...] [--without A B+C ...] [--jobs 2] [--csv FILE]

CASES are folders that `tools.studies.blind_benchmark` or `tools.studies.foreign_benchmark` made with --only generate,
of seeds for development. Each case is searched once; then its sets are judged as they are, and once for each threshold
with that threshold out of the way, or with those that --without joins by a plus. The search keeps its own numbers. A
row says how many answers were right, and how many differ from those as it is, in one folder.
"""

import argparse
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from tools.studies.blind import cases, score
from tools.studies.blind.solve import known
from tools.studies.blind_benchmark import write_rows
from tools.studies.foreign.score import fair


class Threshold(NamedTuple):
    """A number of the judgement, the modules of mpc_sgft.diagnose that read it, and the value at which it is idle."""

    name: str
    modules: tuple[str, ...]
    idle: float


JUDGE = ("fitting.judge",)
THRESHOLDS = (
    Threshold("MIN_SHARE", JUDGE, 0.0),
    Threshold("TIE_ODDS", JUDGE, 1.0),
    Threshold("SURE_ODDS", JUDGE, float("inf")),
    Threshold("FEW", JUDGE, 0.0),
    Threshold("ELSEWHERE", JUDGE, -float("inf")),
    Threshold("NEAR", JUDGE, 0.0),
    Threshold("WIDER", ("verdict.uncertainty",), 1.0),
    Threshold("LEFT", ("verdict.verdict",), 1.0),
    Threshold("MATTERS", ("verdict.verdict", "verdict.relevance"), 0.0),
    Threshold("SMALL", ("verdict.tolerance",), 0.0),
)


@contextmanager
def idle(names: str) -> Iterator[None]:
    """The judgement without thresholds, whose names a plus joins; as it is with none."""
    chosen = [t for t in THRESHOLDS if t.name in names.split("+")]
    places = [(importlib.import_module(f"mpc_sgft.diagnose.{m}"), t) for t in chosen for m in t.modules]
    before = [getattr(module, t.name) for module, t in places]
    try:
        for module, t in places:
            setattr(module, t.name, t.idle)
        yield
    finally:
        for (module, t), value in zip(places, before, strict=True):
            setattr(module, t.name, value)


@contextmanager
def search_once() -> Iterator[None]:
    """Searches of the same case are done once: the n-th of a run gives what the n-th of the first run gave.

    So are the other fits that take long, of the same set.
    """
    from mpc_sgft.diagnose import run

    before = {name: getattr(run, name) for name in ("search", "run", "near_fit", "refit", "fit_residual_model")}
    searched: list[tuple[Any, tuple[Any, ...]]] = []  # None for a problem that the search left as it was
    fitted: dict[tuple[Any, ...], Any] = {}
    calls = 0

    def search(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        if calls == len(searched):
            setup, hypotheses = before["search"](*args, **kwargs)
            searched.append((None if setup is args[0] else setup, tuple(hypotheses)))
        setup, hypotheses = searched[calls]
        calls += 1
        return args[0] if setup is None else setup, list(hypotheses)  # judging adds to it

    def again(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls = 0
        return before["run"](*args, **kwargs)

    def near_fit(setup: Any, f: Any, plant: Any) -> Any:
        return fitted_once((plant.model.opt.timestep, *_values(f)), lambda: before["near_fit"](setup, f, plant))

    def refit(setup: Any, hypotheses: list[Any], near: Any) -> Any:
        key = "refit", *(h.key for h in hypotheses), *_values(near.fit)
        return list(fitted_once(key, lambda: before["refit"](setup, hypotheses, near)))

    def fit_residual_model(setup: Any, best: Any, *args: Any) -> Any:
        return fitted_once(("flexible", *_values(best.fit)), lambda: before["fit_residual_model"](setup, best, *args))

    def fitted_once(key: tuple[Any, ...], fit: Callable[[], Any]) -> Any:
        if key not in fitted:
            fitted[key] = fit()
        return fitted[key]

    for f in (search, near_fit, refit, fit_residual_model):
        setattr(run, f.__name__, f)
    run.run = again
    try:
        yield
    finally:
        for name, f in before.items():
            setattr(run, name, f)


def _values(f: Any) -> tuple[Any, ...]:
    """What tells one fit from another, to the last digit."""
    return *(t.label for t in f.terms), *(v.tobytes() for v in f.values)


def ablate(case: Path, without: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Reports of one case by what is out of the way."""
    from mpc_sgft.diagnose import diagnose

    files, out = sorted(case.glob("episode_*.csv")), {}
    with search_once():
        for names in without:
            with idle(names):
                out[names] = diagnose(case / "model.xml", files, out=None, **known(case)).as_dict()
    return out


def rows(found: dict[str, dict[str, dict[str, Any]]], labels: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for what is out of the way: shares of right and of wrong answers, and of how many."""
    out, fairly = [], {case: fair(labels[case]) for case in found}
    for name in next(iter(found.values())):
        row: dict[str, Any] = {"without": name or "nothing"}
        for column, groups, count in COLUMNS:
            counted = [count(found[c][name], y) for c, y in fairly.items() if y["group"] in groups]
            values = np.hstack([np.empty(0), *counted])
            row |= {column: round(float(values.mean()), 3) if len(values) else "", f"{column}_of": len(values)}
        row["changed"] = sum(_said(said[name]) != _said(said[""]) for said in found.values())
        out.append(row)
    return out


COLUMNS: tuple[tuple[str, tuple[str, ...], Callable[..., Any]], ...] = (
    ("single_exact", ("single",), score.top1),
    ("pair_exact", ("pair",), score.top1),
    ("f1", ("single", "pair"), score.f1),
    ("false_alarms", ("none",), lambda said, label: bool(score.asserted(said))),
    ("wrong_outside", ("outside",), lambda said, label: bool(score.asserted(said))),
    ("coverage", ("single", "pair"), score.covered),
)


def _said(report: dict[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    return report["verdict"], score.named(report), sorted(score.ties(report))


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="+", help="folders of generated cases")
    parser.add_argument("--without", nargs="+", metavar="A+B", default=[t.name for t in THRESHOLDS], type=_known)
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--csv", type=Path, default=Path("results/judgement/judgement.csv"))
    args = parser.parse_args(argv)
    table, without = [], ["", *args.without]
    try:
        hidden = {folder: cases.labels(folder) for folder in args.cases}
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for folder, labels in hidden.items():
        found = judged(folder, list(labels), without, args.jobs)
        table += [{"cases": folder.name, **row} for row in rows(found, labels)]
        write_rows(args.csv, table)  # after each folder: they take long
    for row in table:
        print("  ".join(f"{k} {v}" for k, v in row.items()))
    return 0


def _known(names: str) -> str:
    """Names of thresholds, joined by a plus.

    Raises:
        argparse.ArgumentTypeError: If there is no such threshold.
    """
    allowed = [t.name for t in THRESHOLDS]
    for name in names.split("+"):
        if name not in allowed:
            raise argparse.ArgumentTypeError(f"{name} is no threshold; there are {', '.join(allowed)}")
    return names


def judged(folder: Path, names: list[str], without: list[str], jobs: int) -> dict[str, dict[str, dict[str, Any]]]:
    """Reports of a folder's cases by what is out of the way; cases on disk that have all of them are not done again."""
    kept = folder / "judgement.jsonl"  # a case a line, so that a stopped run goes on
    text = kept.read_text() if kept.is_file() else ""
    whole = text[: text.rfind("\n") + 1]  # a process that was killed leaves half a line
    if whole != text:
        kept.write_text(whole)
    found = dict(map(json.loads, whole.splitlines()))
    todo = [name for name in names if not {*without} <= {*found.get(name, ())}]
    with ProcessPoolExecutor(jobs) as pool, kept.open("a") as file:
        futures = {pool.submit(ablate, folder / "cases" / name, without): name for name in todo}
        for future in tqdm(as_completed(futures), total=len(todo), desc=f"judge {folder.name}", unit="case"):
            found[futures[future]] = future.result()
            file.write(json.dumps([futures[future], found[futures[future]]]) + "\n")
            file.flush()
    return {name: {w: found[name][w] for w in without} for name in names}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
