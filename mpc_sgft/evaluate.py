"""python -m mpc_sgft.evaluate: success and return of any checkpoint, or of a fixed policy, on any task and gap."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from mpc_sgft.command import cli

COMMAND = cli.Command(
    name="evaluate",
    loop="mpc_sgft.runs.evaluate:evaluate",
    summary="Evaluate a checkpoint, or a fixed policy, on any task and gap: success with an interval, return, JSON.",
    overrides={"episodes": "how many", "horizon": "steps the planner looks ahead (planner.horizon)"},
    words=("policy",),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
