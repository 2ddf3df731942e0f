"""What diagnose found in deployments, one CSV row each effect.

    python -m mpc_sgft.diagnose --run runs/push/A                    # writes runs/push/A/diagnosis/
    python -m tools.studies.diagnose_table results/close_the_loop/diagnose_run.csv runs/push/A runs/push/B

Gap, seed and rollouts are those of each run's summary.json.
"""

import argparse
import csv
import json
from pathlib import Path
from typing import Any

COLUMNS = "gap seed rollouts verdict effect at parameter value unit low high seconds".split()


def rows(report: dict[str, Any], summary: dict[str, Any]) -> list[dict[str, Any]]:
    """One row for each parameter of each effect; one without effect if there is none."""
    shared = {"gap": summary["gap"], "seed": summary["seed"], "rollouts": summary["real_rollouts"]}
    shared["verdict"] = report["verdict"]
    found = [
        {"effect": e["name"], "at": " ".join(e["at"]), "parameter": name, **{k: _short(v) for k, v in number.items()}}
        for e in report["effects"]
        for name, number in e["parameters"].items()
    ]
    return [shared | row | {"seconds": report["seconds"]} for row in found or [{}]]


def _short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders of deployments that were diagnosed")
    args = parser.parse_args()
    every = []
    for run in args.runs:
        report, summary = (json.loads((run / name).read_text()) for name in ("diagnosis/report.json", "summary.json"))
        every += rows(report, summary)
    with args.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(every)


if __name__ == "__main__":
    main()
