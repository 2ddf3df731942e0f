"""How well the audit's share of the first rollouts tells which runs will reach a success of 90 %.

    python -m tools.studies.audit_predicts results/audit results/{transfer,outside}/sgft.csv results/tasks/push_*.csv

Reads the tables of `tools.studies.study`; runs of plain sgft count, variants do not. OUT/runs.csv has a line a run,
OUT/auc.csv the area under the curve: the chance that a run that reached it had the larger share than one that did not.
Its interval is a bootstrap over gaps, since runs of one gap are alike. Takes seconds.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import mannwhitneyu

from tools.studies.runner import write

REACHED, DRAWS = 0.9, 2000


class Run(NamedTuple):
    gap: str
    seed: str
    share: float  # of the states of the first rollouts that are improvable
    best: float  # success, at any evaluation after real rollouts

    @property
    def reached(self) -> bool:
        return self.best >= REACHED


def runs(paths: Sequence[Path]) -> list[Run]:
    """Every run of the tables that has an audit."""
    found: dict[tuple[str, str], list[dict[str, str]]] = {}
    for path in paths:
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                if row["method"] == "sgft" and not row["variant"] and row.get("audit") and int(row["rollouts"]):
                    found.setdefault((row["gap"], row["seed"]), []).append(row)
    return [Run(*key, float(rows[0]["audit"]), max(float(r["success"]) for r in rows)) for key, rows in found.items()]


def area(found: Sequence[Run]) -> float:
    """Area under the curve, 0.5 of a coin; nan where all runs end alike."""
    yes, no = ([r.share for r in found if r.reached is wanted] for wanted in (True, False))
    return float(mannwhitneyu(yes, no).statistic) / (len(yes) * len(no)) if yes and no else float("nan")


def interval(found: Sequence[Run]) -> tuple[float, float]:
    """95 % bootstrap interval of the area; gaps are drawn, and draws in which all runs end alike say nothing."""
    gaps = sorted({r.gap for r in found})
    generator = np.random.default_rng(0)
    drawn = (generator.choice(gaps, len(gaps)) for _ in range(DRAWS))
    areas = [area([r for gap in draw for r in found if r.gap == gap]) for draw in drawn]
    low, high = np.nanpercentile(areas, [2.5, 97.5])
    return float(low), float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("csv", type=Path, nargs="+")
    args = parser.parse_args()
    found = runs(args.csv)
    if np.isnan(area(found)):
        sys.exit(
            f"error: all {len(found)} runs with an audit end alike; there is nothing to predict. Give more tables."
        )
    rows = [{**r._asdict(), "reached": int(r.reached)} for r in sorted(found, key=lambda r: -r.share)]
    write(args.out / "runs.csv", list(rows[0]), rows)
    low, high = interval(found)
    numbers = {"auc": area(found), "low": low, "high": high}
    counts = {"runs": len(found), "reached": sum(r.reached for r in found), "gaps": len({r.gap for r in found})}
    write(args.out / "auc.csv", [*numbers, *counts], [{k: f"{v:.3f}" for k, v in numbers.items()} | counts])
    print(", ".join(f"{k} {v:.2f}" for k, v in numbers.items()), *(f"{k} {v}" for k, v in counts.items()))


if __name__ == "__main__":
    main()
