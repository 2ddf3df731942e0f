"""Single keys from a terminal, as they are pressed; the terminal is put back as it was, whatever ends the program."""

import os
import re
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Self

ESCAPES = re.compile(rb"\x1b(?:\[[0-9;?]*[@-~]|O[A-Za-z])?")  # arrows and function keys: none of ours


class Keyboard:
    """Reads keys in a thread while the block runs. Ctrl-C stays what it is.

    Args:
        heard: Called in that thread with each character, and with "" once if the terminal is gone.
        fd: Of the terminal.
    """

    def __init__(self, heard: Callable[[str], None], fd: int = 0):
        self.heard, self.fd = heard, fd

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self.fd)
        self._wake_out, self._wake_in = os.pipe()
        tty.setcbreak(self.fd, termios.TCSADRAIN)
        self._thread = threading.Thread(target=self._run, name="keyboard", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            os.write(self._wake_in, b"x")
            self._thread.join(2.0)
        finally:
            try:
                termios.tcsetattr(self.fd, termios.TCSADRAIN, self._before)
            except termios.error:
                pass  # the terminal is gone, and nobody types into it
            os.close(self._wake_in)
            os.close(self._wake_out)

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self.fd, self._wake_out], [], [])
            if self._wake_out in ready:
                return
            try:
                data = os.read(self.fd, 64)
            except OSError:
                data = b""
            for character in ESCAPES.sub(b"", data).decode(errors="ignore"):  # what came with an arrow counts
                self.heard(character)
            if not data:
                self.heard("")
                return


def has_terminal() -> bool:
    """Whether a person can be shown a page and can press keys: both ends are a terminal, and it is ours to read."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()


@contextmanager
def ending_in_order() -> Iterator[None]:
    """A block that SIGTERM, or a terminal that hangs up, ends by `SystemExit`: an arm is stopped on the way out."""
    before = {number: signal.signal(number, _leave) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)
