"""What a run of the tests left out, in one closing line, with the command that would bring it.

Every skip gives a reason that begins with `needs` and one of NEEDS. With MPC_SGFT_MAY_SKIP="a GPU, ..." in the
environment only these may be missing: anything else that is left out fails the run: a skip cannot hide a missing part.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Generator

import pytest

NEEDS = {  # what a test may need, and what brings it
    "a GPU": "a machine with CUDA",
    "a renderer": "make system",
    "a browser": "make system",
    "the robot's client": "make robot",
    "the camera's packages": "make system setup",
    "wandb": "make setup",
    "Ray's launcher": "make launcher",
    "Ray": "make setup",
    "MuJoCo Warp": "make setup",
    "submitit": "make setup",
    "rosbags": "make setup",
    "rliable": "make setup",
    "PyBullet": "pip install -e '.[foreign]'",
    "Linux": "a Linux machine",
    "measured data": "MPC_SGFT_DATA=FOLDER",
    "lerobot's environment": "python -m tools.export_lerobot",
}


def need_of(reason: str) -> str | None:
    """Which of NEEDS a skip names; None for any other reason."""
    text = reason.removeprefix("Skipped: ").removeprefix("needs ")
    return next((need for need in NEEDS if text.startswith(need)), None)


def left_out(reasons: list[str]) -> tuple[str, list[str]]:
    """One line about what was left out (empty if nothing was), and what was left out for no known need."""
    counts = Counter(need_of(reason) for reason in reasons)
    parts = [f"{n} that need {need} ({NEEDS[need]})" for need, n in counts.items() if need is not None]
    unknown = sorted({reason for reason in reasons if need_of(reason) is None})
    return "left out: " + ", ".join([*parts, *unknown]) if reasons else "", unknown


def _reasons(config: pytest.Config) -> list[str]:
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter else []
    return [str(report.longrepr[2]) for report in skipped if isinstance(report.longrepr, tuple)]


def _forbidden(config: pytest.Config) -> list[str]:
    allowed = os.environ.get("MPC_SGFT_MAY_SKIP")
    if allowed is None:
        return []
    words = {word.strip() for word in allowed.split(",")}
    return sorted({reason for reason in _reasons(config) if need_of(reason) not in words})


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> Generator[None, None, None]:
    if not hasattr(session.config, "workerinput") and exitstatus == 0 and _forbidden(session.config):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
    return (yield)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    line, _ = left_out(_reasons(config))
    if line:
        terminalreporter.write_line(line)
    if forbidden := _forbidden(config):
        allowed = os.environ["MPC_SGFT_MAY_SKIP"]
        terminalreporter.write_line(f"error: only {allowed} may be missing here: {'; '.join(forbidden)}", red=True)
