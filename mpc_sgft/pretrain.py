"""python -m mpc_sgft.pretrain: learn a world model, a policy prior and a critic in randomised simulation."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from mpc_sgft.command import cli

COMMAND = cli.Command(
    name="pretrain",
    loop="mpc_sgft.runs.pretrain:pretrain",
    summary="Pretrain a latent world model, a policy prior and a critic in randomised MuJoCo simulation.\n"
    "Ctrl-C saves; --resume goes on exactly where it stopped.",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
