"""Reaching what speaks the robot's protocol: the client library, an open port, and calls that might never return."""

import socket
import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any

from envs.backends.arm_errors import explain
from envs.backends.base import BackendError

INSTALL = "pip install 'mpc_sgft[franka]'"
ANSWER = 3.0  # [s] for a port to take a connection


def load_franky() -> ModuleType:
    """The client library.

    Raises:
        BackendError: With the command that installs it.
    """
    try:
        import franky
    except ImportError as error:
        raise BackendError(f"--backend franka needs the robot's client ({error}). Install it: {INSTALL}") from error
    return franky


def knock(ip: str, port: int) -> None:
    """Take a connection to a port and let go of it: the client itself would wait for minutes.

    Raises:
        OSError: If nobody is there.
    """
    socket.create_connection((ip, port), timeout=ANSWER).close()


def within(seconds: float, make: Callable[[], Any], what: str, ip: str) -> Any:
    """Result of a call that might never return, such as connecting to something that serves somebody else.

    Args:
        seconds: How long to wait.
        make: The call.
        what: Whom it reaches, e.g. "robot".
        ip: Where that is.

    Raises:
        BackendError: If it did not return in time, or failed.
    """
    box: list[Any] = []

    def run() -> None:
        try:
            box.append(make())
        except Exception as error:  # handed to the caller below
            box.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    if not box:
        raise BackendError(
            f"the {what} at {ip} took the connection and then said nothing for {seconds:.0f} s. "
            "Another client may hold it: end that one, then try again."
        )
    if isinstance(box[0], Exception):
        raise BackendError(explain(box[0], ip, what)) from box[0]
    return box[0]
