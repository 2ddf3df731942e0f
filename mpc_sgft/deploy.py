"""python -m mpc_sgft.deploy: adapt a pretrained agent to a system it has not seen, in tens of real rollouts."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from mpc_sgft.command import cli

COMMAND = cli.Command(
    name="deploy",
    loop="mpc_sgft.runs.deploy:deploy",
    summary="Deploy a pretrained agent: roll out with the planner, train dynamics and policy prior in between,\n"
    "keep the critic of the simulation frozen (SGFT). Starts from the shipped checkpoint unless one is given.",
    overrides={
        "rollouts": "real rollouts, every one counted",
        "horizon": "steps the planner looks ahead (planner.horizon)",
    },
    words=("success",),
    flags={
        "--backend": ("sim|franka", "where actions go: MuJoCo with a hidden gap, or the robot"),
        "--robot-ip": ("IP|stand-in", "the robot's address (--backend franka); stand-in: a simulated one"),
    },
    switches={"--dry-run": "connect, look, plan and check, but do not move (--backend franka)"},
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
