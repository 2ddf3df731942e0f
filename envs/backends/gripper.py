"""The hand that holds the tool: it grasps when a session begins, is looked at between episodes, and never lets go."""

import logging
from collections.abc import Callable
from typing import Any

from envs.backends.arm_errors import first_line
from envs.backends.base import BackendError
from envs.backends.client import knock, load_franky, within

log = logging.getLogger(__name__)
HAND_PORT = 1338
SPEED, FORCE = 0.1, 140.0  # [m/s], [N] the most that the Franka Hand can do (its datasheet)
NEAR = 0.005  # [m] from the width that was asked for; libfranka's own default
CONNECT, MOTION = 10.0, 30.0  # [s] to wait for an answer, for the fingers
TODO = "Put the tool between the fingers, then go on."


class Gripper:
    """Fingers that hold a tool of a known width; with no width there is none, and nothing is touched.

    Args:
        width: Of the tool between the fingers, [m]; None if no gripper holds it.
        speed: Of the fingers, [m/s].
        force: To hold the tool with, [N].

    Attributes:
        words: How it stands, for people; as of the last look.

    Raises:
        ValueError: If a number cannot be.
    """

    def __init__(self, width: float | None, speed: float, force: float):
        if width is not None and not width > 0:
            raise ValueError(
                f"width={width}; above 0 [m], the tool between the fingers, or null: no gripper is touched"
            )
        if not 0 < speed <= SPEED:
            raise ValueError(f"speed={speed}; above 0 and at most {SPEED} m/s")
        if not 0 < force <= FORCE:
            raise ValueError(f"force={force}; above 0 and at most {FORCE:.0f} N")
        self.width, self.speed, self.force = width, speed, force
        self.words = "-" if width is None else "not connected"
        self._hand: Any = None
        self._held = False
        self._opening = self._widest = 0.0  # [m] at the last look: now, and the most there is

    def hold(self, ip: str, *, moves: bool) -> None:
        """Connect if need be, and hold the tool; a hand that holds it already is left as it is.

        The hand is homed first if it does not know that it can open so far; then it has dropped what it held.

        Args:
            ip: Of the robot.
            moves: Whether the fingers may move; otherwise the hand is only looked at.

        Raises:
            BackendError: If there is no hand, it does not get there, or what it held is gone.
        """
        if self.width is None:
            return
        if self._hand is None:
            self._connect(ip)
        holds = self._look(ip)
        if holds or not moves:
            self._held |= holds
            return
        if self._held:
            raise BackendError(f"the gripper lost the tool ({self.words}). The arm is at rest. {TODO}")
        if self._widest < self.width - NEAR:
            self._home(ip)
        self._grasp(ip)
        self._held = True

    def close(self) -> None:
        """Disconnect; the fingers stay as they are."""
        self._hand = None

    def _connect(self, ip: str) -> None:
        try:
            knock(ip, HAND_PORT)
        except OSError as error:
            raise BackendError(
                f"no gripper answers at {ip} ({error}). Mount it and choose it in Desk as end effector, "
                "or set backend.gripper.width=null if none holds the tool."
            ) from error
        franky = load_franky()
        self._hand = within(CONNECT, lambda: franky.Gripper(ip), "gripper", ip)

    def _look(self, ip: str) -> bool:
        """Whether it holds something as wide as the tool."""
        assert self.width is not None
        state = within(CONNECT, lambda: self._hand.state, "gripper", ip)
        self._opening, self._widest = float(state.width), float(state.max_width)
        self.words = f"{'holds' if state.is_grasped else 'holds nothing'}, fingers {1e3 * state.width:.1f} mm apart"
        return bool(state.is_grasped) and abs(self._opening - self.width) <= NEAR

    def _home(self, ip: str) -> None:
        assert self.width is not None
        log.warning("the gripper is homed: nothing may be between its fingers")
        said = self._do(lambda: self._hand.homing_async())
        self._look(ip)
        if said or self._widest < self.width - NEAR:
            raise BackendError(
                f"the gripper opens to {self._widest:.3f} m, not to backend.gripper.width={self.width} m"
                f"{said and f' (homing: {said})'}. Correct the width, or home it in Desk."
            )

    def _grasp(self, ip: str) -> None:
        """Close on the tool; if the fingers got past its width, it is not between them, and they open for it."""
        assert self.width is not None
        said = self._do(lambda: self._hand.grasp_async(self.width, self.speed, self.force, NEAR, NEAR))
        self._look(ip)
        if not said:
            return
        found = self.words
        if self._opening < self.width - NEAR:
            self._do(lambda: self._hand.open_async(self.speed))
            self._look(ip)
            found += f", now {1e3 * self._opening:.1f} mm"
        raise BackendError(
            f"the gripper does not hold a tool of backend.gripper.width={self.width} m ({said}: {found}). {TODO}"
        )

    def _do(self, begin: Callable[[], Any]) -> str:
        """Have the hand do something and wait for it; why it did not, empty if it did."""
        try:
            doing = begin()
            if not doing.wait(MOTION):
                return f"no answer for {MOTION:.0f} s"
            return "" if doing.get() else "it did not succeed"
        except Exception as error:  # franky's errors have no common base; all mean that the fingers are not there
            return first_line(error)
