"""Who watches a deployment: nobody, or a person at the keyboard (mpc_sgft/session/person.py)."""

import select
import sys
import termios
from collections.abc import Callable, Iterable
from typing import Protocol, Self

import numpy as np

from envs.backends.base import BackendError
from mpc_sgft.storage.metrics import progress
from mpc_sgft.storage.rollout import Press

MARKS = {"success": True, "failure": False}
POLL = 0.02  # [s]


class Operator(Protocol):
    """What the loop needs to know of a person; a context, within which there is one.

    Attributes:
        present: Whether there is one.
        stopping: The session is to end; the arm is stopping.
        guiding: A person has the arm in their hands.
    """

    present: bool
    stopping: bool
    guiding: bool

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def halt(self) -> str:
        """Why the arm must stop now; empty if it need not."""
        ...

    def watch(self, status: Callable[[], dict[str, str]]) -> None:
        """Show what the robot says of itself, in words, as long as the session goes."""
        ...

    def heed(self, ends: Callable[[], bool]) -> None:
        """From now on questions and pauses end, unanswered, as soon as `ends` says that the session does."""
        ...

    def place(self, position: np.ndarray) -> None:
        """Have the object put somewhere, [3] m in the base frame, and return when it is there.

        Raises:
            BackendError: If nobody can, or will.
        """
        ...

    def enter(self, phase: str, episode: int) -> None:
        """Say what happens now (resetting, running, ending, training …), and which rollout keys are about."""
        ...

    def poll(self) -> list[Press]:
        """What was pressed since the last call."""
        ...

    def rest(self) -> None:
        """Return when the session is not, or not any longer, paused."""
        ...

    def ask(self) -> bool:
        """Whether somebody said if the episode was a success, or what else to do with it; False: the session ends."""
        ...

    def track(self, steps: range) -> Iterable[int]:
        """The steps one by one, with a progress bar."""
        ...

    def tell(self, **facts: str) -> None:
        """Show something: a name and what to write beside it."""
        ...


class Nobody:
    """Never says anything.

    Args:
        quiet: No progress bar.
    """

    present = stopping = guiding = False

    def __init__(self, *, quiet: bool = True):
        self.quiet = quiet or not sys.stderr.isatty()
        self._ends: Callable[[], bool] = lambda: False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def halt(self) -> str:
        return ""

    def watch(self, status: Callable[[], dict[str, str]]) -> None:
        pass

    def heed(self, ends: Callable[[], bool]) -> None:
        self._ends = ends

    def place(self, position: np.ndarray) -> None:
        """Nobody watches, but somebody may answer: a line, and Enter."""
        if not sys.stdin.isatty():
            raise BackendError("somebody must put the object in its place, and no terminal is attached to ask them")
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # an Enter from before says nothing of now
        print(f"\n{place_text(position)} ", end="", flush=True)
        while not select.select([sys.stdin], [], [], POLL)[0]:
            if self._ends():
                raise BackendError("the session is to end")
        if not sys.stdin.readline():
            raise BackendError("nobody confirmed that the object is in its place")

    def enter(self, phase: str, episode: int) -> None:
        pass

    def poll(self) -> list[Press]:
        return []

    def rest(self) -> None:
        pass

    def ask(self) -> bool:
        return True

    def track(self, steps: range) -> Iterable[int]:
        bar = progress(len(steps), desc="training", disable=self.quiet, leave=False)
        for step in steps:
            yield step
            bar.update(1)
        bar.close()

    def tell(self, **facts: str) -> None:
        pass


def place_text(position: np.ndarray) -> str:
    """What a person is to do with the object, [3] m."""
    x, y = (round(float(v), 2) for v in position[:2])
    return f"put the object at x = {x} m, y = {y} m from the robot's base, step back, then press Enter"


def verdict(presses: Iterable[Press], episode: int) -> bool | None:
    """The last mark that an episode was given; None if there is none."""
    marks = [MARKS[press.word] for press in presses if press.episode == episode and press.word in MARKS]
    return marks[-1] if marks else None


def again(presses: Iterable[Press], episode: int) -> bool:
    """Whether an episode is to be driven again."""
    return any(press.episode == episode and press.word == "rerecord" for press in presses)
