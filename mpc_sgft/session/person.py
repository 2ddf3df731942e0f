"""A person at the keyboard: what their keys mean, when. The page shows it, the keyboard brings it, the loop asks."""

import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Self

import numpy as np
from omegaconf import DictConfig

from envs.backends.base import BackendError
from mpc_sgft.command.errors import UserError
from mpc_sgft.session.keyboard import Keyboard, has_terminal
from mpc_sgft.session.operator import MARKS, POLL, Nobody, Operator, place_text
from mpc_sgft.session.page import Page
from mpc_sgft.storage.rollout import Press

KEYS = {" ": "stop", "p": "pause", "s": "success", "f": "failure", "r": "rerecord", "t": "takeover", "\n": "confirm"}
TOGGLES = ("pause", "takeover")
REPEATED = 1.0  # [s] within which the same key again is one that is held down: it would undo what it did


class Person:
    """An Operator. `heard` runs in the keyboard's thread, `halt` in the stream's, everything else in the loop's.

    Args:
        page: Where things are shown.
        fd: Of the terminal.
        repeated: Seconds since it was heard last within which a key that goes to and fro is not heard again.
    """

    present = True

    def __init__(self, page: Page, fd: int = 0, *, repeated: float = REPEATED):
        self.page, self._keyboard = page, Keyboard(self.heard, fd)
        self.stopping = self.guiding = self.paused = False
        self._phase, self._episode = "connecting", 0
        self._lock = threading.Lock()
        self._presses: list[Press] = []
        self._answered = threading.Event()  # the question that stands was answered
        self._ends: Callable[[], bool] = lambda: False
        self._repeated, self._heard_at = repeated, dict[str, float]()

    def __enter__(self) -> Self:
        self._keyboard.__enter__()
        self.page.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self.page.__exit__(None, None, None)
        finally:
            self._keyboard.__exit__(None, None, None)

    def watch(self, status: Callable[[], dict[str, str]]) -> None:
        self.page.status = status

    def heed(self, ends: Callable[[], bool]) -> None:
        self._ends = ends

    def heard(self, character: str) -> None:
        """Take in a key; "" is a terminal that is gone, which stops the session."""
        word = KEYS.get(character.lower(), "") if character else "stop"
        now = time.monotonic()
        with self._lock:
            held = word in TOGGLES and now - self._heard_at.get(word, float("-inf")) < self._repeated
            self._heard_at[word] = now
            if held:
                return
            said = self._take(word)
            if said:
                self._presses.append(Press(word, time.time(), self._episode))
        if word:
            self.page.tell(key=said or f"{word}: nothing to do now")

    def halt(self) -> str:
        """Why the arm must stop now; empty if it need not. The stream asks before each target."""
        if self.stopping:
            return "the operator pressed stop"
        return "taken over by a person" if self.guiding else ""

    def enter(self, phase: str, episode: int) -> None:
        with self._lock:
            self._phase, self._episode = phase, episode
            if phase != "running":
                self.guiding = False
        self.page.enter(phase, episode)

    def poll(self) -> list[Press]:
        with self._lock:
            taken, self._presses = self._presses, []
        return taken

    def rest(self) -> None:
        if self.paused and not self.stopping:
            self.enter("paused: p goes on", self._episode)
        while self.paused and not (self.stopping or self._ends()):
            time.sleep(POLL)

    def ask(self) -> bool:
        return self._wait("success? s yes, f no, r drive it again")

    def place(self, position: np.ndarray) -> None:
        if not self._wait(place_text(position)):
            raise BackendError("the operator pressed stop" if self.stopping else "the session is to end")

    def track(self, steps: range) -> Iterable[int]:
        for step in steps:
            self.page.progress = (step, len(steps))
            yield step
        self.page.progress = None

    def tell(self, **facts: str) -> None:
        self.page.tell(**facts)

    def _wait(self, question: str) -> bool:
        """Whether a question was answered; else the session ends."""
        before = self._phase
        self._answered.clear()
        self.enter(question, self._episode)
        while not (self.stopping or self._ends() or self._answered.wait(POLL)):
            pass
        self.enter(before, self._episode)
        return self._answered.is_set() and not self.stopping

    def _take(self, word: str) -> str:
        """Do what a word asks; what to show, empty if it asks for nothing that can be done now."""
        if word == "stop":
            self.stopping, self.guiding = True, False
            return "stop: the arm is stopped, the session ends"
        if word == "pause":
            self.paused = not self.paused
            return "pause before the next episode" if self.paused else "going on"
        if word == "takeover" and (self.guiding or self._phase == "running"):
            self.guiding = not self.guiding
            if self.guiding:
                return "the arm is yours: t hands it back"
            self.paused = True  # whoever hands it back still stands beside it
            return "handed back: step away, then p lets it move"
        if word == "confirm" and self._phase.startswith("put the object"):
            self._answered.set()
            return "the object is in its place"
        if (word in MARKS or word == "rerecord") and self._episode:
            if self._phase.startswith("success?"):
                self._answered.set()
            return f"rollout {self._episode}: " + ("to be driven again" if word == "rerecord" else f"a {word}")
        return ""


def make_operator(cfg: DictConfig) -> Operator:
    """Whoever watches: on the robot, with a terminal and without --quiet, a person and their page; else nobody.

    Raises:
        UserError: If a person is needed and there is none.
    """
    moves = cfg.backend.name == "franka" and not cfg.backend.dry_run
    if not (moves and not cfg.quiet and has_terminal()):
        if asks(cfg):
            raise UserError("success=ask needs a person: --backend franka in a terminal, without --quiet or --dry-run.")
        return Nobody(quiet=cfg.quiet)
    page = Page(title=f"{cfg.chosen.task} {cfg.chosen.method}", rollouts=cfg.rollouts, keys=KEYS)
    return Person(page, sys.stdin.fileno())


def asks(cfg: DictConfig) -> bool:
    """Whether a person says what a success is; runs from before there was the setting leave it to the task."""
    return cfg.get("success", "task") == "ask"
