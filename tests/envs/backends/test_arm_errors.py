"""What the client's own exceptions become: a line that says what to do."""

import pytest

from envs.backends.arm_errors import explain, not_ready

franky = pytest.importorskip("franky", reason="needs the robot's client")


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        (
            "IncompatibleVersionException",
            "libfranka: Incompatible library version (server 8, library 10)",
            "firmware 5.9",
        ),
        ("RealtimeException", "libfranka: Running kernel does not have realtime capabilities.", "realtime=ignore"),
        ("NetworkException", "libfranka: UDP receive: Timeout", "connection to the robot at 10.0.0.2 was lost"),
        (
            "CommandException",
            "libfranka: command rejected due to activated safety function!",
            "Release the stop button",
        ),
    ],
)
def test_each_error_says_what_to_do(kind: str, text: str, words: str) -> None:
    line = explain(getattr(franky, kind)(text), "10.0.0.2")
    assert words in line and "\n" not in line


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("Other", "Unlock the joints and activate FCI"),  # brakes closed, robot locked, FCI off
        ("Guiding", "Let go"),
        ("UserStopped", "stop button"),
        ("Reflex", "clear the error"),
        ("AutomaticErrorRecovery", "Look at it in Desk"),
    ],
)
def test_each_mode_that_does_not_move_says_what_to_do(mode: str, words: str) -> None:
    assert words in not_ready(mode)
