"""What a user can cause, said in one line. The command-line front turns these into exit codes, without a traceback."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches

DISK_ERRORS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "files may not grow any larger here (ulimit -f)",
    errno.EACCES: "no permission",
    errno.EPERM: "no permission",
    errno.EROFS: "the file system is read-only",
}
ELSEWHERE = "Earlier results are untouched; choose another place with run_dir=..."
AGAIN = "Earlier results are untouched; once that is mended the same --resume goes on."


class UserError(Exception):
    """The user can mend it. The message says what came, what is allowed and what to do. Exit code 2."""


class Stopped(KeyboardInterrupt):
    """Ctrl-C after the work was saved. The message says where it is and how to go on. Exit code 130."""


def unknown(kind: str, name: str, valid: Iterable[str], where: str = "") -> UserError:
    """The error for a name that does not exist: what came, the nearest name, all names.

    Args:
        kind: What the name should have been, e.g. "task".
        name: What came.
        valid: The names that exist.
        where: Where they live, e.g. "configs/task/"; left out if empty.
    """
    names = sorted(valid)
    near = get_close_matches(name, names, n=1, cutoff=0.6)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    place = f" in {where}" if where else ""
    return UserError(f"unknown {kind} {name!r}.{hint} Available{place}: {', '.join(names) or '(none)'}.")


@contextmanager
def from_config(what: str) -> Iterator[None]:
    """Report wrong values found while building objects from the config as the user's error.

    Wrap construction only, never a loop: inside, ValueError, TypeError and KeyError become UserError; other errors of
    the objects themselves come out as they are.

    Args:
        what: What is being built, e.g. "gap" or "planner".

    Raises:
        UserError: With the innermost message, Hydra's own wrapping removed.
    """
    try:
        yield
    except (ValueError, TypeError, KeyError) as err:
        raise UserError(f"{what}: {err}") from err
    except Exception as err:
        cause = err.__cause__
        if type(err).__name__ != "InstantiationException" or cause is None:
            raise
        if isinstance(cause, ValueError | TypeError | KeyError):
            raise UserError(f"{what}: {cause}") from err
        raise cause from err


def disk_error(err: OSError, then: str = ELSEWHERE) -> str | None:
    """One line for a full disk or a missing permission; None for any other OSError.

    Args:
        err: What came.
        then: What is safe, and what to do.
    """
    if err.errno not in DISK_ERRORS:
        return None
    place = err.filename or "the run folder"
    return f"{place}: {DISK_ERRORS[err.errno]}. {then}"


@contextmanager
def disk_errors(then: Callable[[], str]) -> Iterator[None]:
    """Report a full disk or a missing permission as the user's error; every other error comes out as it is.

    Args:
        then: Says what is safe, and what to do, as it is by then.

    Raises:
        UserError: With the file, why, and `then`.
    """
    try:
        yield
    except OSError as err:
        message = disk_error(err, then())
        if message is None:
            raise
        raise UserError(message) from err
