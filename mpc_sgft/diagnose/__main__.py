"""`python -m mpc_sgft.diagnose --model scene.xml --data EPISODES... --out OUT`, or `--run RUN_FOLDER`"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpc_sgft.diagnose.data.mapping import Source


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m mpc_sgft.diagnose",
        description="Find where simulation and measurement disagree, name the missing effect, repair the model.",
        allow_abbrev=False,
    )
    p.add_argument("--model", type=Path, metavar="XML", help="nominal scene: MJCF, or URDF")
    p.add_argument(
        "--data",
        type=Path,
        nargs="+",
        metavar="PATH",
        help="episodes: CSV, Parquet or MCAP files, ROS 2 bags, LeRobotDataset folders, folders of these",
    )
    p.add_argument(
        "--out", type=Path, metavar="DIR", help="where the report goes; default diagnosis/, or RUN/diagnosis"
    )
    p.add_argument(
        "--run", type=Path, metavar="DIR", help="a run folder that deploy recorded, instead of --model --data"
    )
    p.add_argument(
        "--retrain",
        action="store_true",
        help="with --run: pretrain on in the repaired simulator, deploy again, compare",
    )
    p.add_argument(
        "--retrain-transitions", type=int, default=60_000, metavar="N", help="how long; default 60000, a few minutes"
    )
    p.add_argument(
        "--ranges",
        metavar="RANDOMIZE",
        help="with --run: do not name effects, but find how widely pretraining should vary each draw of "
        "configs/randomize/RANDOMIZE.yaml (DROPO)",
    )
    p.add_argument(
        "--map",
        metavar="FILE|A=B,...",
        help="columns of other names, units and signs: map.yaml, or 'time=t ms,qpos/elbow=-1*enc deg + 0.1'",
    )
    p.add_argument(
        "--inspect",
        type=Path,
        nargs="+",
        metavar="PATH",
        help="say what is in recordings, what maps to what (with --model), gaps, rates and excitation, and stop",
    )
    p.add_argument("--effects", metavar="A,B", help="consider only these effects")
    p.add_argument("--signals", metavar="A,B", help="compare only these columns, such as qpos/elbow")
    p.add_argument("--window", type=float, metavar="S", help="length of a simulated window; default from the data")
    p.add_argument("--held-out", metavar="SHARE|A,B", help="share that is never fitted, or episode names; default 0.25")
    p.add_argument("--uncertain", metavar="Q=SHARE,...", help="nominal quantities that may be wrong, mass=0.3,gain=0.2")
    p.add_argument("--seed", type=int, default=0, metavar="N")
    p.add_argument("--max-effects", type=int, default=3, metavar="N", help="largest set of effects; default 3")
    p.add_argument(
        "--tolerance",
        metavar="SHARE|Q=SIZE,...",
        help="prediction error that does not matter: a share of the motion, 1%%, or by signal, qpos/elbow=0.1deg",
    )
    p.add_argument("--traces", action="store_true", help="repair what is there and does not matter, too")
    return p


def main(argv: list[str] | None = None) -> int:
    """Exit code 0 for every verdict, 2 for bad input, 3 if training met a number that is not finite, 130 for Ctrl-C."""
    args = parser().parse_args(argv)
    from mpc_sgft.command.errors import UserError, disk_error

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
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    except KeyboardInterrupt as stop:
        print(f"\n{str(stop) or 'stopped by Ctrl-C'}", file=sys.stderr)
        return 130


def _run(args: argparse.Namespace) -> int:
    from mpc_sgft.command.errors import UserError
    from mpc_sgft.diagnose import diagnose

    if args.inspect is not None:
        return _inspect(args)
    if args.run is not None:
        return _run_folder(args)
    for name in ("retrain", "ranges"):
        if getattr(args, name):
            raise UserError(f"--{name} needs --run, the deployment to learn from.")
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
        tolerance=_tolerance(args.tolerance),
        traces=args.traces,
        mapping=_mapping(args.map),
        progress=True,
    )
    print(report.summary())
    print(f"report: {out / 'report.html'}")
    return 0


def _given(args: argparse.Namespace) -> set[str]:
    """Names of the options that were given, and say something else than what is taken without."""
    alone = vars(parser().parse_args([]))
    return {name for name, value in vars(args).items() if value != alone[name]}


def _inspect(args: argparse.Namespace) -> int:
    from mpc_sgft.command.errors import UserError
    from mpc_sgft.diagnose.inspect import inspect
    from mpc_sgft.diagnose.simulation.plant import load_plant

    if others := sorted(_given(args) - {"inspect", "model", "map"}):
        raise UserError(
            f"--{others[0].replace('_', '-')} does not go with --inspect, which only looks: --inspect RECORDINGS, with "
            "--model and --map if you like."
        )
    found = inspect(args.inspect, None if args.model is None else load_plant(args.model), _mapping(args.map))
    try:
        print(found, flush=True)
    except BrokenPipeError:  # `| head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still to be flushed
        return 141  # as a shell says it of a process that SIGPIPE ended
    return 0


def _run_folder(args: argparse.Namespace) -> int:
    from mpc_sgft.command.errors import UserError
    from mpc_sgft.diagnose.deployed import diagnose_run

    for name in ("model", "data", "signals", "uncertain", "map"):
        if getattr(args, name) is not None:
            raise UserError(f"--{name} does not go with --run, which brings its own scene and episodes; leave it out.")
    if args.retrain_transitions < 1:
        raise UserError(f"--retrain-transitions {args.retrain_transitions}: a whole number from 1 on.")
    args.run = args.run.resolve()  # runs/latest moves as soon as another run begins
    out = args.out or args.run / "diagnosis"
    if args.retrain:
        from mpc_sgft.diagnose.deployments.retrain import outcome, retrain, table

        outcome(args.run)  # an unfinished run stops here, not after the diagnosis
        taken = [str(out / part) for part in ("pretrain", "deploy") if (out / part).exists()]
        if taken:
            raise UserError(f"{taken[0]} is there from an earlier --retrain. Move it away, or give another --out.")
    if args.ranges is not None:
        return _ranges(args, out)
    report = diagnose_run(
        args.run,
        out=out,
        effects=_names(args.effects),
        window=args.window,
        held_out=_held_out(args.held_out),
        seed=args.seed,
        max_effects=args.max_effects,
        tolerance=_tolerance(args.tolerance),
        traces=args.traces,
        progress=True,
    )
    print(report.summary())
    print(f"report: {out / 'report.html'}")
    if args.retrain:
        import yaml

        if report.data["effects_file"] is None:
            print("nothing to retrain on: nothing was found that brings simulation nearer to the recordings")
            return 0
        if report.data["verdict"] == "unknown":
            print(
                "not retrained: what is missing is unknown, and a policy for a simulator that is wrong elsewhere can "
                "be worse than the one there is. More rollouts tell more; --ranges asks for no names"
            )
            return 0
        effects = yaml.safe_load((out / report.data["effects_file"]).read_text())["effects"]
        print(table(retrain(args.run, out, args.retrain_transitions, effects=effects)))
    return 0


def _ranges(args: argparse.Namespace, out: Path) -> int:
    from mpc_sgft.command.errors import UserError
    from mpc_sgft.diagnose.deployments.ranges import find_ranges, randomisation
    from mpc_sgft.diagnose.deployments.recordings import read_deployment
    from mpc_sgft.diagnose.deployments.retrain import retrain, table
    from mpc_sgft.storage.metrics import progress

    if others := sorted(_given(args) - {"run", "out", "ranges", "retrain", "retrain_transitions", "seed"}):
        name = others[0].replace("_", "-")
        raise UserError(f"--{name} does not go with --ranges, which names no effects; leave it out.")

    def track(rounds: range) -> Iterator[int]:
        with progress(len(rounds), desc="ranges", unit="round") as bar:
            for number in rounds:
                yield number
                bar.update()

    within = randomisation(args.run, args.ranges)
    found = find_ranges(read_deployment(args.run), within, seed=args.seed, track=track)
    out.mkdir(parents=True, exist_ok=True)
    found.write(out / "ranges.yaml")
    print(found.table())
    print(f"from {found.windows} windows: {out / 'ranges.yaml'}, which pretrain takes as randomize=FILE")
    if args.retrain:
        print(table(retrain(args.run, out, args.retrain_transitions, randomize=found.randomize)))
    return 0


def _names(text: str | None) -> list[str] | None:
    return [name.strip() for name in text.split(",") if name.strip()] if text else None


def _held_out(text: str | None) -> float | list[str] | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return _names(text)


def _mapping(text: str | None) -> dict[str, Source] | None:
    from mpc_sgft.diagnose.data.mapping import read_mapping

    return None if text is None else read_mapping(text)


def _tolerance(text: str | None) -> float | dict[str, str] | None:
    from mpc_sgft.diagnose.verdict.tolerance import parse_tolerance

    return None if text is None else parse_tolerance(text)


def _shares(text: str | None) -> dict[str, float]:
    from mpc_sgft.command.errors import UserError

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
