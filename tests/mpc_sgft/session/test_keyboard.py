"""Keys from a real pseudo-terminal, and the terminal afterwards."""

import os
import pty
import signal
import termios
import time
from collections.abc import Iterator

import pytest

from mpc_sgft.session.keyboard import Keyboard


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """(our end, the program's end)."""
    ours, its = pty.openpty()
    yield ours, its
    for fd in (ours, its):
        try:
            os.close(fd)
        except OSError:
            pass


def arrived(heard: list[str], count: int) -> list[str]:
    deadline = time.monotonic() + 5
    while len(heard) < count and time.monotonic() < deadline:
        time.sleep(0.01)
    return heard


def test_keys_arrive_without_enter_and_the_terminal_is_put_back(terminal):
    ours, its = terminal
    before, heard = termios.tcgetattr(its), []
    with Keyboard(heard.append, its):
        assert not termios.tcgetattr(its)[3] & (termios.ICANON | termios.ECHO)
        os.write(ours, b"s")
        assert arrived(heard, 1) == ["s"]
        os.write(ours, b"\x1b[A")  # an arrow is not the letter A
        time.sleep(0.1)
        os.write(ours, b"p ")
        assert arrived(heard, 3) == ["s", "p", " "]
    assert termios.tcgetattr(its) == before


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_the_terminal_is_put_back_after_any_end(terminal, error):
    _, its = terminal
    before = termios.tcgetattr(its)
    with pytest.raises(error), Keyboard(lambda _: None, its):
        raise error
    assert termios.tcgetattr(its) == before


def test_sigterm_ends_the_block_in_its_order(terminal):
    _, its = terminal
    before, handler = termios.tcgetattr(its), signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended, Keyboard(lambda _: None, its):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
    assert ended.value.code == 143 and termios.tcgetattr(its) == before
    assert signal.getsignal(signal.SIGTERM) == handler


def test_a_terminal_that_is_gone_is_told_once(terminal):
    ours, its = terminal
    heard: list[str] = []
    with Keyboard(heard.append, its):
        os.close(ours)
        assert arrived(heard, 1) == [""]
