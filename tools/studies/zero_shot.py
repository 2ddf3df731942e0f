"""How far policies come in reality that only simulation has trained: one row a method, gap and seed.

    python -m tools.studies.zero_shot results/benchmark/zero_shot.csv --gaps turned sluggish skate mild --seeds 0 1 2

    dr              the shipped checkpoint's policy prior alone; it has no seed
    dr_planned      the same checkpoint through the planner
    doraemon        randomisation that widens as far as the policy succeeds (`curriculum=doraemon`)
    asymmetric_ac   critics that know the draws, a policy without a memory (`train=asymmetric_ac`)
    recurrent_dr    such critics, a policy with a memory (`train=recurrent_dr`)

Each is trained first, in a folder of --runs; one that is there is not trained again. All are measured in the same
episodes, those of a deployment's evaluations.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.studies.runner import RunFailed, finished, measured

COLUMNS = ["method", "task", "gap", "seed", "transitions", "sim_success", "success", "low", "high", "return"]
COLUMNS += ["episodes"]
TRAINED = {  # what training is told; None: the shipped checkpoint
    "dr": None,
    "dr_planned": None,
    "doraemon": ["curriculum=doraemon", "randomize=push_wide"],
    "asymmetric_ac": ["train=asymmetric_ac"],
    "recurrent_dr": ["train=recurrent_dr"],
}
EPISODES = 100


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--task", default="push", help="where it is measured; a variant of push takes its policies")
    parser.add_argument("--gaps", nargs="+", required=True)
    parser.add_argument("--methods", nargs="+", default=[*TRAINED], choices=[*TRAINED])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/zero_shot"))
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides of every training")
    args = parser.parse_args(arguments)

    def work(method: str, task: str, gap: str, seed: int | str) -> dict[str, Any]:
        words, trained = TRAINED[method], {}
        there = [f"planner={'mppi' if method == 'dr_planned' else 'policy'}", f"episodes={EPISODES}"]
        if words is not None:
            folder = args.runs / f"{method}-{seed}"
            trained = finished("pretrain", folder, ["task=push", f"seed={seed}", *words, *args.set])
            there.append(f"checkpoint={folder}")
        folder = args.runs / "-".join(filter(None, (method, str(seed), task, gap)))
        found = finished("evaluate", folder, [f"task={task}", f"gap={gap}", *there])
        low, high = found["success_interval"]
        row = {"transitions": trained.get("transitions"), "sim_success": trained.get("prior_success")}
        row |= {"success": found["success"], "low": round(low, 3), "high": round(high, 3)}
        row |= {"return": round(found["return"], 3), "episodes": found["episodes"]}
        return {"method": method, "task": task, "gap": gap, "seed": seed, **row}

    keys = [
        {"method": method, "task": args.task, "gap": gap, "seed": seed}
        for method in args.methods
        for seed in (args.seeds if TRAINED[method] is not None else [""])
        for gap in args.gaps
    ]
    try:
        measured(args.csv, COLUMNS, keys, work)
    except (RunFailed, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
