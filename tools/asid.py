"""How to drive a machine so that a few rollouts tell most about what randomisation draws (ASID): words for `deploy`.

    python -m tools.asid --task push
    python -m tools.asid --task push --randomize push_wide --checkpoint runs/push/latest --rounds 20

It prints what to add to `python -m mpc_sgft.deploy method=zero_shot`: its warm-up is driven so. Then `python -m
mpc_sgft.diagnose --run RUN --ranges push --retrain` finds the ranges that explain these rollouts, and trains in them.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build
from mpc_sgft.runs.exploration import Exploration, explore
from mpc_sgft.storage.metrics import progress


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="push")
    parser.add_argument("--randomize", metavar="NAME", help="what is drawn; that of the task if left out")
    parser.add_argument("--checkpoint", type=Path, help="whose policy drives; the shipped one if left out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=10, help="of proposals")
    parser.add_argument("--rollouts", type=int, default=2, help="that are to be driven so")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    args = parser.parse_args(arguments)
    if args.rounds < 1 or args.rollouts < 1:
        parser.error("--rounds and --rollouts: 1 or more")
    words = [f"task={args.task}", *([f"randomize={args.randomize}"] if args.randomize else [])]
    words += [f"checkpoint={args.checkpoint}"] if args.checkpoint else []
    try:
        cfg = compose("pretrain", words, [])
        build.prepare_process(cfg)
        agent, _ = build.load_agent(cfg)
        with progress(args.rounds, desc="explore", unit="round", disable=args.quiet) as bar:

            def track(rounds: range):
                for number in rounds:
                    yield number
                    bar.update()

            found = explore(cfg, agent.model, seed=args.seed, rounds=args.rounds, track=track)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for name, plain, left in zip(build.draws_of(cfg), found.plain.tolist(), found.left.tolist(), strict=True):
        print(f"# {name}: sd {left:.3f} of its range expected after one rollout; of the policy alone {plain:.3f}")
    print(" ".join(overrides(found, args.rollouts)))
    return 0


def overrides(found: Exploration, rollouts: int | str) -> list[str]:
    """Of a deployment whose first rollouts are driven so, a number or `${rollouts}`: all."""
    knots = ",".join(f"[{','.join(f'{x:.2f}' for x in knot)}]" for knot in found.offsets.tolist())
    return [f"warmup={rollouts}", f"exploration.weight={found.weight:.2f}", f"exploration.offsets=[{knots}]"]


if __name__ == "__main__":
    sys.exit(main())
