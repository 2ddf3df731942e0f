"""Deploy into a gap, name it, repair the simulator, pretrain on in it and deploy again; one CSV row each gap and seed.

    python -m tools.studies.close_the_loop results/close_the_loop/close_the_loop.csv --gaps turned --seeds 0 1 2
    python -m tools.studies.close_the_loop small.csv --gaps dev_turned --seeds 0 --transitions 5000 --set rollouts=4

Each gap and seed has a folder under --runs; a first deployment or a comparison that is there is not made again. The gap
is known to the two deployments alone. `--curves` writes what came of it as `tools.studies.benchmark --with` takes it
in: success before, and what the agent that was trained again reaches before it learns from anything real itself. With
`--effects` only those are looked for, as where one thinks beforehand of what may differ; with `--ranges` nothing is
named, and ranges of the randomisation are found instead, which is the method `dropo`; with `--explore` besides all
real rollouts are driven so that they tell more of these ranges, which is `asid`.
"""

import argparse
import json
from pathlib import Path

import yaml

from mpc_sgft.command.compose import compose
from mpc_sgft.diagnose.__main__ import main as diagnose
from mpc_sgft.runs import build
from mpc_sgft.runs.exploration import explore
from tools import asid
from tools.studies.runner import asked_before, finished, write
from tools.studies.study import COLUMNS as CURVE

COLUMNS = [
    "gap",
    "seed",
    "verdict",
    "found",
    "diagnose_seconds",
    "transitions",
    "zero_shot_before",
    "zero_shot_after",
    "final_before",
    "final_after",
    "rollouts_to_95_before",
    "rollouts_to_95_after",
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--gaps", nargs="+", default=["turned", "sluggish", "skate"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--transitions", type=int, default=60_000)
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides of the deployments")
    parser.add_argument("--effects", metavar="A,B", help="look for these alone")
    parser.add_argument("--ranges", metavar="RANDOMIZE", help="find ranges of this randomisation, and name nothing")
    parser.add_argument("--explore", action="store_true", help="with --ranges: drive as tools.asid says")
    parser.add_argument("--curves", type=Path, metavar="CSV", help="success before and after, as a method of its own")
    parser.add_argument("--runs", type=Path, default=Path("runs/close_the_loop"))
    args = parser.parse_args()
    if args.explore and not args.ranges:
        parser.error("--explore goes with --ranges: what is to be found tells how to drive")
    how = ["--retrain", "--retrain-transitions", str(args.transitions)]
    how += ["--effects", args.effects] if args.effects else []
    how += ["--ranges", args.ranges] if args.ranges else []
    folder, variant, beginning = "diagnosis", "", "asid-" if args.explore else ""
    if args.effects:
        variant = f"effects={args.effects}"
    if args.ranges:
        folder, variant = "ranges", f"ranges={args.ranges}"
    rows, curves = [], []
    for gap in args.gaps:
        for seed in args.seeds:
            run = args.runs / f"{beginning}{gap}-{seed}"
            new = args.explore and not (run / "config.yaml").exists()
            first = exploring(seed, args.ranges, args.set) if new else []
            rows.append(one(gap, seed, run, run / folder, args.set, how, first))
            write(args.csv, COLUMNS, rows)
            if args.curves:
                curves += curve(rows[-1], run, run / folder, variant, explored=args.explore)
                write(args.curves, CURVE, curves)


def one(
    gap: str, seed: int, run: Path, found: Path, overrides: list[str], how: list[str], first: list[str]
) -> dict[str, object]:
    """One row; raises RunFailed or SystemExit if a command fails.

    Args:
        gap, seed, overrides: Of the deployments.
        run: Folder of the first.
        found: Of the diagnosis.
        how: Options of `diagnose --run`.
        first: More overrides of the first deployment, where it begins.
    """
    finished("deploy", run, [f"gap={gap}", f"seed={seed}", "log.rerun=false", *overrides], first=first)
    asked_before(found, how)
    if not ((found / "retrain.json").exists() or named_nothing(found / "report.json")):
        check(diagnose(["--run", str(run), "--out", str(found), *how]))
    row: dict[str, object] = {"gap": gap, "seed": seed} | named(found)
    if (found / "retrain.json").exists():  # a verdict without an effect leaves nothing to retrain on
        result = json.loads((found / "retrain.json").read_text())
        row["transitions"] = result["transitions"]
        for when in ("before", "after"):
            row[f"zero_shot_{when}"] = result[when]["zero_shot_success"]
            row[f"final_{when}"] = result[when]["final_success"]
            row[f"rollouts_to_95_{when}"] = result[when]["rollouts_to_95"]
    return row


def exploring(seed: int, ranges: str, overrides: list[str]) -> list[str]:
    """Overrides of a deployment all of whose rollouts are driven to tell of a randomisation's draws."""
    own = [text for text in overrides if text.startswith(("task=", "task.", "checkpoint="))]
    cfg = compose("pretrain", [*own, f"randomize={ranges}"], [])
    agent, _ = build.load_agent(cfg)
    return asid.overrides(explore(cfg, agent.model, seed=seed), "${rollouts}")


def named(found: Path) -> dict[str, object]:
    """What a diagnosis says, of effects or of ranges."""
    if (found / "ranges.yaml").exists():
        draws = yaml.safe_load((found / "ranges.yaml").read_text())["draws"]
        return {"verdict": "ranges", "found": " + ".join(f"{k} {d['low']} to {d['high']}" for k, d in draws.items())}
    report = json.loads((found / "report.json").read_text())
    effects = " + ".join(words(e) for e in report["effects"])
    return {"verdict": report["verdict"], "found": effects, "diagnose_seconds": report["seconds"]}


def named_nothing(report: Path) -> bool:
    """Whether a report is there, and holds no effect to train again with."""
    return report.exists() and not json.loads(report.read_text())["effects"]


def curve(
    row: dict[str, object], run: Path, found: Path, variant: str, explored: bool = False
) -> list[dict[str, object]]:
    """The rows of a learning curve: before, and after the real rollouts that were diagnosed.

    Where nothing was named nothing is trained again, and the agent stays as it was.
    """
    summary = json.loads((run / "summary.json").read_text())
    again = found / "deploy" / "summary.json"
    after = json.loads(again.read_text()) if "zero_shot_after" in row else summary
    method = "asid" if explored else "dropo" if row["verdict"] == "ranges" else "identify"
    known = {"gap": row["gap"], "method": method, "variant": variant}
    known |= {"seed": row["seed"], "episodes": summary["evaluation_episodes"]}
    return [
        known | {"rollouts": rollouts, "success": s["curve"]["0"], "return": s["return_curve"]["0"]}
        for rollouts, s in ((0, summary), (summary["real_rollouts"], after))
    ]


def words(effect: dict) -> str:
    """`actuator_gain gain=0.6`"""
    numbers = " ".join(f"{k}={v['value']:.3g}" for k, v in effect["parameters"].items())
    return f"{'@'.join([effect['name'], *effect['at'][:1]])} {numbers}"


def check(code: int) -> None:
    if code:
        raise SystemExit(code)


if __name__ == "__main__":
    main()
