"""Keys from a real pseudo-terminal, and the terminal afterwards."""

import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from envs.backends.base import BackendError
from mpc_sgft.session.keyboard import Keyboard, ending_in_order
from mpc_sgft.session.operator import Nobody

ROOT = Path(__file__).resolve().parents[3]


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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_block_in_its_order(terminal, number):
    _, its = terminal
    before, handler = termios.tcgetattr(its), signal.getsignal(number)
    with pytest.raises(SystemExit) as ended, ending_in_order(), Keyboard(lambda _: None, its):
        os.kill(os.getpid(), number)
        time.sleep(5)
    assert ended.value.code == 128 + number and termios.tcgetattr(its) == before
    assert signal.getsignal(number) == handler


@pytest.mark.parametrize("keys", [b"\x1b[A ", b"\x1b[1;5C ", b"\x1bOP ", b" \x1b[A", b"\x1b "])
def test_a_stop_that_comes_with_an_arrow_is_heard(terminal, keys):
    ours, its = terminal
    heard: list[str] = []
    with Keyboard(heard.append, its):
        os.write(ours, keys)
        assert arrived(heard, 1) == [" "]


def test_a_line_that_asks_ends_with_the_session(terminal, monkeypatch):
    with os.fdopen(os.dup(terminal[1]), "r") as its:
        monkeypatch.setattr(sys, "stdin", its)
        nobody = Nobody()
        nobody.heed(lambda: True)
        with pytest.raises(BackendError, match="the session is to end"):
            nobody.place(np.zeros(3))


ASKED = """
import sys, time
import numpy as np
from envs.backends.base import BackendError
from mpc_sgft.session.operator import Nobody
print("ready", flush=True)
time.sleep(1)
try:
    Nobody().place(np.array([0.4, 0.1, 0.0]))
    print("placed", flush=True)
except BackendError as error:
    print("refused:", error, flush=True)
"""


@pytest.mark.parametrize(("answer", "says"), [(b"\n", "placed"), (b"\x04", "refused: nobody confirmed")])
def test_an_enter_from_before_the_question_is_no_answer(terminal, answer, says):
    ours, its = terminal
    said = b""
    with subprocess.Popen([sys.executable, "-c", ASKED], stdin=its, stdout=its, stderr=its, cwd=ROOT) as asked:
        while b"ready" not in said:
            said += os.read(ours, 1024)
        os.write(ours, b"\n")  # before the question
        while b"nter" not in said:
            said += os.read(ours, 1024)
        time.sleep(0.5)
        assert asked.poll() is None and b"placed" not in said
        os.write(ours, answer)
        assert asked.wait(20) == 0
        said += os.read(ours, 4096)
    assert says in said.decode()


def test_a_terminal_that_is_gone_is_told_once(terminal):
    ours, its = terminal
    heard: list[str] = []
    with Keyboard(heard.append, its):
        os.close(ours)
        assert arrived(heard, 1) == [""]
