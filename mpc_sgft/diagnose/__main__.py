"""`python -m mpc_sgft.diagnose --model scene.xml --data EPISODES... --out OUT`"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m mpc_sgft.diagnose",
        description="Find where simulation and measurement disagree, name the missing effect, repair the model.",
        allow_abbrev=False,
    )
    p.add_argument("--model", type=Path, metavar="XML", help="nominal MJCF scene")
    p.add_argument("--data", type=Path, nargs="+", metavar="PATH", help="episodes: CSV, Parquet or MCAP files, folders")
    p.add_argument("--out", type=Path, metavar="DIR", help="where the report goes; default diagnosis/")
    p.add_argument(
        "--run", type=Path, metavar="DIR", help="a run folder that deploy recorded, instead of --model --data"
    )
    p.add_argument("--retrain", action="store_true", help="with --run: go on pretraining in the repaired simulator")
    p.add_argument("--effects", metavar="A,B", help="consider only these effects")
    p.add_argument("--signals", metavar="A,B", help="compare only these columns, such as qpos/elbow")
    p.add_argument("--window", type=float, metavar="S", help="length of a simulated window; default from the data")
    p.add_argument("--held-out", metavar="SHARE|A,B", help="share that is never fitted, or episode names; default 0.25")
    p.add_argument("--uncertain", metavar="Q=SHARE,...", help="nominal quantities that may be wrong, mass=0.3,gain=0.2")
    p.add_argument("--seed", type=int, default=0, metavar="N")
    p.add_argument("--max-effects", type=int, default=3, metavar="N", help="largest set of effects; default 3")
    return p


def main(argv: list[str] | None = None) -> int:
    """Exit code 0 for every verdict, 2 for bad input, 130 for Ctrl-C."""
    args = parser().parse_args(argv)
    from mpc_sgft.errors import UserError, disk_error

    try:
        return _run(args)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        message = disk_error(error)
        if message is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped by Ctrl-C", file=sys.stderr)
        return 130


def _run(args: argparse.Namespace) -> int:
    from mpc_sgft.diagnose import diagnose
    from mpc_sgft.errors import UserError

    if args.run is not None:
        raise UserError("--run cannot read deployments yet; give --model and --data.")
    if args.retrain:
        raise UserError("--retrain needs --run, the deployment to learn from.")
    missing = [name for name in ("model", "data") if getattr(args, name) is None]
    if missing:
        raise UserError(f"--{missing[0]} is missing: give --model scene.xml and --data EPISODES...")
    out = args.out or Path("diagnosis")
    report = diagnose(
        args.model,
        args.data,
        out=out,
        effects=_names(args.effects),
        signals=_names(args.signals),
        window=args.window,
        held_out=_held_out(args.held_out),
        uncertain=_shares(args.uncertain),
        seed=args.seed,
        max_effects=args.max_effects,
        progress=True,
    )
    print(report.summary())
    print(f"report: {out / 'report.html'}")
    return 0


def _names(text: str | None) -> list[str] | None:
    return [name.strip() for name in text.split(",") if name.strip()] if text else None


def _held_out(text: str | None) -> float | list[str] | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return _names(text)


def _shares(text: str | None) -> dict[str, float]:
    from mpc_sgft.errors import UserError

    shares = {}
    for item in _names(text) or []:
        name, _, number = item.partition("=")
        try:
            shares[name] = float(number)
        except ValueError as error:
            raise UserError(f"--uncertain {item!r}: write quantity=share, such as mass=0.3") from error
    return shares


if __name__ == "__main__":
    sys.exit(main())
