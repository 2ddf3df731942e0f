"""What each number in the judgement of `diagnose` is worth: the verdicts of a benchmark's cases without it.

    python -m tools.studies.judgement CASES [--jobs 2] [--csv results/judgement/judgement.csv]

CASES is a folder that `tools.studies.blind_benchmark --only generate` made, of a seed for development. Each case is
searched once; then its sets are judged as they are, and once for each threshold with that threshold out of the way.
The search keeps its own numbers. A row says how many answers were right, and how many differ from those as it is.
"""

import argparse
import csv
import importlib
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from tools.studies.blind import cases, score


class Threshold(NamedTuple):
    """A number of the judgement, the modules of mpc_sgft.diagnose that read it, and the value at which it is idle."""

    name: str
    modules: tuple[str, ...]
    idle: float


JUDGE, NAMING = ("fitting.judge",), ("verdict.naming",)
THRESHOLDS = (
    Threshold("MIN_GAIN", JUDGE, 0.0),
    Threshold("MIN_SHARE", JUDGE, 0.0),
    Threshold("TIE_GAIN", JUDGE, 0.0),
    Threshold("TIE_ODDS", JUDGE, 1.0),
    Threshold("SURE_ODDS", JUDGE, float("inf")),
    Threshold("FEW", JUDGE, 0.0),
    Threshold("ELSEWHERE", JUDGE, -float("inf")),
    Threshold("NEAR", JUDGE, 0.0),
    Threshold("FIRST_GAIN", NAMING, 0.05),  # as other gains
    Threshold("NEXT_GAIN", NAMING, 0.05),
    Threshold("RICHER_SHARE", NAMING, 1.0),
    Threshold("WIDER", NAMING, 1.0),
    Threshold("LEFT", ("verdict.verdict",), 1.0),
    Threshold("MATTERS", ("verdict.verdict", "verdict.relevance"), 0.0),
    Threshold("SMALL", ("verdict.tolerance",), 0.0),
)


@contextmanager
def idle(threshold: Threshold | None) -> Iterator[None]:
    """The judgement without a threshold; as it is with None."""
    modules = [importlib.import_module(f"mpc_sgft.diagnose.{m}") for m in threshold.modules] if threshold else []
    before = [getattr(m, threshold.name) for m in modules] if threshold else []
    try:
        for m in modules:
            setattr(m, threshold.name, threshold.idle)  # pyright: ignore[reportOptionalMemberAccess]
        yield
    finally:
        for m, value in zip(modules, before, strict=True):
            setattr(m, threshold.name, value)  # pyright: ignore[reportOptionalMemberAccess]


@contextmanager
def search_once() -> Iterator[None]:
    """Searches of the same case are done once: the n-th of a run gives what the n-th of the first run gave."""
    from mpc_sgft.diagnose import run

    search, done = run.search, []

    def remembered(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        if calls == len(done):
            setup, hypotheses = search(*args, **kwargs)
            done.append((setup, tuple(hypotheses)))
        setup, hypotheses = done[calls]
        calls += 1
        return setup, list(hypotheses)  # judging adds to it

    def once_more(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls = 0
        return judged(*args, **kwargs)

    calls, judged = 0, run.run
    run.search = remembered
    run.run = once_more
    try:
        yield
    finally:
        run.search = search
        run.run = judged


def ablate(case: Path) -> dict[str, dict[str, Any]]:
    """Reports of one case by threshold, "" as it is."""
    from mpc_sgft.diagnose import diagnose

    known, out = json.loads((case / "known.json").read_text()), {}
    with search_once():
        for threshold in (None, *THRESHOLDS):
            with idle(threshold):
                files = sorted(case.glob("episode_*.csv"))
                report = diagnose(case / "model.xml", files, uncertain=known["uncertain"] or None, out=None)
                out[threshold.name if threshold else ""] = report.as_dict()
    return out


def rows(found: dict[str, dict[str, dict[str, Any]]], labels: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a threshold."""
    out = []
    for name in ["", *(t.name for t in THRESHOLDS)]:
        reports = {case: said[name] for case, said in found.items()}
        row: dict[str, Any] = {"without": name or "nothing"}
        for s in score.table(reports, labels):
            if s.count and s.name in COLUMNS:
                row |= {COLUMNS[s.name]: round(s.value, 3), f"{COLUMNS[s.name]}_of": s.count}
        row["verdicts_changed"] = sum(_said(reports[c]) != _said(found[c][""]) for c in reports)
        out.append(row)
    return out


COLUMNS = {
    "single, clear: top 1": "single",
    "single, clear: named, no tie": "named",
    "pairs: F1 of the set of names": "pairs_f1",
    "no effect: false alarms": "false_alarms",
    "outside the library: a wrong name": "wrong_outside",
    "90 % intervals that cover the truth": "coverage",
}


def _said(report: dict[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    return report["verdict"], score.named(report), sorted(score.ties(report))


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, help="folder of generated cases")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--csv", type=Path, default=Path("results/judgement/judgement.csv"))
    args = parser.parse_args(argv)
    try:
        labels = cases.labels(args.cases)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    kept = args.cases / "judgement.jsonl"  # a case a line, so that a stopped run goes on
    found = dict(map(json.loads, kept.read_text().splitlines())) if kept.is_file() else {}
    todo = [args.cases / "cases" / name for name in labels if name not in found]
    with ProcessPoolExecutor(args.jobs) as pool, kept.open("a") as file:
        for case, said in zip(
            todo, tqdm(pool.map(ablate, todo), total=len(todo), desc="judge", unit="case"), strict=True
        ):
            found[case.name] = said
            file.write(json.dumps([case.name, said]) + "\n")
            file.flush()
    table = rows(found, labels)
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    with args.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    for row in table:
        print("  ".join(f"{k} {v}" for k, v in row.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
