"""The front of the three commands: flags and overrides in, one checked config out, errors as one line.

Order: parse (argparse alone: --help answers at once), compose and check (Hydra), import the loop (torch, mujoco), run.
Exit codes: 0 or what the loop returns; 2: the user can mend it; 3: a number is not finite; 130: stopped by Ctrl-C.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

from mpc_sgft import __version__
from mpc_sgft.command import choices
from mpc_sgft.command.errors import AGAIN, ELSEWHERE, Stopped, UserError, disk_error

if TYPE_CHECKING:
    from omegaconf import DictConfig

# flag -> (metavar, help); `--seed 3` is `seed=3`
FLAGS = {
    "--seed": ("N", "seed of everything random in the run"),
    "--device": ("auto|cpu|cuda", "where the networks live"),
    "--checkpoint": ("PATH", "run folder or .safetensors file to start from"),
}
PATHS = ("--checkpoint", "--resume")


@dataclass(frozen=True, kw_only=True)
class Command:
    """One entry point.

    Attributes:
        name: Module in mpc_sgft/ and file in configs/, e.g. "deploy".
        loop: "module:function" imported after parsing; gets the DictConfig, returns an exit code or None.
        summary: What the command does, shown by --help.
        overrides: The overrides scripts rely on besides the groups, {name: help}.
        words: Overrides of this command that take one of a few words (`choices.WORDS`).
        flags: Flags of this command alone, {flag: (metavar, help)}.
        switches: Flags of this command alone that take no value, {flag: help}.
    """

    name: str
    loop: str
    summary: str
    overrides: Mapping[str, str] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    flags: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    switches: Mapping[str, str] = field(default_factory=dict)


COMMON = {
    "seed": "as --seed",
    "run_dir": "the run folder, exactly; default runs/<task>/<time>",
    "checkpoint": "as --checkpoint",
}


def run(command: Command, argv: Sequence[str] | None = None) -> int:
    """Parse, compose and run one command; returns its exit code.

    Args:
        command: Which.
        argv: Arguments without the program's name; sys.argv[1:] if None.
    """
    args, then = list(sys.argv[1:] if argv is None else argv), ELSEWHERE
    try:
        flags, overrides = _parse(command, args)
        then = ELSEWHERE if flags.resume is None else AGAIN
        return _run(command, flags, overrides)
    except UserError as err:
        return _fail(str(err), 2)
    except OSError as err:
        message = disk_error(err, then)
        if message is None:
            raise
        return _fail(message, 2)
    except FloatingPointError as err:
        return _fail(
            f"{err} Stopped; where a checkpoint of the run was saved it is good, and --resume goes on from there.", 3
        )
    except Stopped as stop:
        print(f"\n{stop}", file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        print("\nstopped by Ctrl-C", file=sys.stderr)
        return 130
    finally:
        gc.unfreeze()


def _run(command: Command, flags: argparse.Namespace, given: list[str]) -> int:
    from omegaconf import OmegaConf

    from mpc_sgft.command import compose, resumed

    given = compose.spread(given)
    overrides = [compose.normalise(text) for text in given]
    if flags.multirun:
        if flags.resume is not None or flags.config:
            raise UserError("-m runs several new runs; --resume and --config belong to one run. Give one or the other.")
        compose.check(command.name, overrides, sweep=True)
        return _sweep(command, overrides)
    if flags.resume is not None:
        cfg = resumed.resume(command.name, flags.resume, overrides, given)
    else:
        compose.check(command.name, overrides, sweep=False)
        cfg = compose.compose(command.name, overrides, given)
    if flags.config:
        print(OmegaConf.to_yaml(cfg), end="")
        return 0
    return _start(command, cfg)


def _start(command: Command, cfg: DictConfig) -> int:
    from mpc_sgft.command.address import check_address

    check_address(cfg)
    return int(_loop(command)(cfg) or 0)


def _sweep(command: Command, overrides: list[str]) -> int:
    """Hand a sweep to @hydra.main, so that Hydra's sweepers and launchers work. Each job makes its own run folder."""
    import hydra
    from hydra.errors import HydraException

    from mpc_sgft.command import compose

    several = any(override.is_sweep_override() for override in compose.parse(overrides))
    for text in overrides:
        if several and text.startswith("run_dir=") and "," not in text and "${" not in text:
            raise UserError(
                f"{text!r} would be shared by all runs of the sweep. Write run_dir='{text[8:]}/${{hydra:job.num}}'."
            )
    name = command.name

    def job(cfg: DictConfig) -> int:
        return _start(command, compose.complete_job(cfg, name))

    hydra_settings = ["hydra/job_logging=stdout", f"hydra.job.name={name}"]
    argv, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [f"mpc_sgft.{name}", *hydra_settings, *overrides, "--multirun"]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach run(), which words them
    try:
        hydra.main(version_base="1.3", config_path=str(choices.CONFIG_DIR), config_name=name)(job)()
    except HydraException as err:
        raise UserError(compose.first_line(err)) from err
    finally:
        sys.argv = argv
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
    return 0


def _loop(command: Command) -> Callable:
    """The command's loop, imported without collecting garbage: nearly all its objects stay."""
    name, _, function = command.loop.partition(":")
    if name in sys.modules:
        return getattr(sys.modules[name], function)
    gc.disable()
    try:
        return getattr(import_module(name), function)
    finally:
        gc.freeze()  # until the command ends, later collections leave them out
        gc.enable()


def _parse(command: Command, args: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = argparse.ArgumentParser(
        prog=f"python -m mpc_sgft.{command.name}",
        usage=f"python -m mpc_sgft.{command.name} [flags] [name=value ...]",
        description=command.summary,
        epilog=_overrides_help(command),
        formatter_class=partial(argparse.RawDescriptionHelpFormatter, max_help_position=26, width=120),
        allow_abbrev=False,
        add_help=False,
        exit_on_error=False,
    )
    flags = parser.add_argument_group("flags")
    for flag, (metavar, text) in {**command.flags, **FLAGS}.items():
        flags.add_argument(flag, metavar=metavar, help=text)
    for flag, text in command.switches.items():
        flags.add_argument(flag, action="store_true", help=text)
    flags.add_argument("--resume", metavar="DIR", help="go on with this run folder exactly where it stopped")
    flags.add_argument("--quiet", action="store_true", help="no progress bar, no table")
    flags.add_argument("--config", action="store_true", help="print the composed config and stop")
    flags.add_argument(
        "-m", "--multirun", action="store_true", help="several runs: seed=0,1,2 (Hydra's sweeps and launchers)"
    )
    flags.add_argument("--version", action="version", version=__version__)
    flags.add_argument("-h", "--help", action="help", help="show this and stop")
    try:
        known, rest = parser.parse_known_args(args)
    except argparse.ArgumentError as err:
        raise UserError(f"{err}. See python -m mpc_sgft.{command.name} --help.") from err
    for text in rest:
        if text.startswith("-"):
            names = sorted(name for action in parser._actions for name in action.option_strings)
            raise UserError(f"unknown flag {text!r}. Available: {', '.join(names)}; other settings are name=value.")
    mapped = []
    for flag in {**command.flags, **FLAGS}:
        value = getattr(known, flag[2:].replace("-", "_"))
        if value is not None:
            mapped.append(f"{flag[2:]}={_quoted(value) if flag in PATHS else value}")
    mapped += [f"{flag[2:]}=true" for flag in command.switches if getattr(known, flag[2:].replace("-", "_"))]
    if known.quiet:
        mapped.append("quiet=true")
    for text in list(rest):
        if text.startswith("resume="):
            rest.remove(text)
            known.resume = text.removeprefix("resume=")
    return known, mapped + rest


def _overrides_help(command: Command) -> str:
    rows = {group: ", ".join(options) for group, options in choices.groups_of(command.name).items() if options}
    rows |= {key: ", ".join(choices.WORDS[key]) for key in command.words} | dict(command.overrides) | COMMON
    lines = [_row(name, text) for name, text in rows.items()]
    if choices.effects():
        lines += [
            "",
            "one effect more in the gap, as gap.effects.<effect>.<parameter>=value:",
            _row("", ", ".join(choices.effects())),
        ]
    return "\n".join(
        ["overrides, as name=value (the names that exist):", *lines]
        + [
            "",
            "Any other number is set by its path in the config, e.g. planner.min_std=0.1; --config prints them all.",
        ]
    )


def _row(name: str, text: str) -> str:
    head = f"  {name + '=' if name else '':<24}"
    return textwrap.fill(
        text, width=120, initial_indent=head, subsequent_indent=" " * len(head), break_long_words=False
    )


def _quoted(value: str) -> str:
    """A path as Hydra's grammar wants it, whatever characters it holds."""
    return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _fail(message: str, code: int) -> int:
    print(f"error: {message}", file=sys.stderr)
    return code
