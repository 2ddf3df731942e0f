"""The page that a person at the robot looks at. It only shows; it knows neither keys nor loop."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rich.console import Group

NAMES = {" ": "space", "\n": "Enter"}
MEANS = {
    "stop": "stop",
    "pause": "pause / go on",
    "success": "success",
    "failure": "failure",
    "rerecord": "drive again",
    "takeover": "take over / hand back",
    "confirm": "confirm",
}
ROWS = ("robot", "tool", "gripper", "object", "rollout", "successes", "now", "note", "key")


class Page:
    """Redraws itself four times a second while the block runs; what is printed meanwhile appears above it.

    Args:
        title: Of the page.
        rollouts: How many there are to be.
        keys: Character -> word, for the last line.
    """

    def __init__(self, *, title: str, rollouts: int, keys: Mapping[str, str]):
        from rich.live import Live  # late, so that --help stays quick

        self.title, self.rollouts, self.keys = title, rollouts, keys
        self.status: Callable[[], dict[str, str]] = dict  # of the robot, in words
        self.progress: tuple[int, int] | None = None  # training: steps done, of how many
        self._phase, self._episode, self._facts = "connecting", 0, dict[str, str]()
        self._lock = threading.Lock()
        self._live = Live(get_renderable=self.render, refresh_per_second=4)

    def enter(self, phase: str, episode: int) -> None:
        """Show what happens now."""
        with self._lock:
            self._phase, self._episode = phase, episode
            self._facts.pop("step", None)

    def tell(self, **facts: str) -> None:
        """Show facts; an empty note leaves the last one."""
        with self._lock:
            self._facts |= {name: text for name, text in facts.items() if text}

    def lines(self) -> dict[str, str]:
        """What is shown, row by row."""
        with self._lock:
            phase, episode, facts = self._phase, self._episode, dict(self._facts)
        now = f"{phase}, step {facts.pop('step')}" if phase == "running" and "step" in facts else phase
        facts.pop("step", None)
        rows = self.status() | facts | {"rollout": f"{episode} of {self.rollouts}", "now": now}
        return {name: rows.get(name, "-") for name in ROWS}

    def render(self) -> Group:
        """The page as rich draws it."""
        from rich.columns import Columns
        from rich.console import Group
        from rich.panel import Panel
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for name, text in self.lines().items():
            table.add_row(Text(name, style="dim"), Text(text, style="bold" if name == "now" else ""))
        if self.progress is not None:
            done, total = self.progress
            table.add_row(Text(f"{done}/{total}", style="dim"), ProgressBar(total=total, completed=done, width=40))
        keys = Columns(
            [Text(f"{NAMES.get(key, key)} {MEANS[word]}") for key, word in self.keys.items()], padding=(0, 3)
        )
        return Group(Panel(table, title=self.title, title_align="left"), keys)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, traceback)
