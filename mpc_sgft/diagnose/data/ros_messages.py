"""From ROS 2 messages to streams: numbers of joints by name, with the clock that each came on.

- `sensor_msgs/JointState`: `TOPIC/JOINT.position`, `.velocity`, `.effort`; the state, or a command if the topic has a
  word for that (`cmd`, `desired`, …).
- `std_msgs/Float64MultiArray` and the like: `TOPIC/0`, `TOPIC/1`, …; a command.
- `trajectory_msgs/JointTrajectory`: `TOPIC/JOINT.position`; a command, straight lines between its points.
- `trajectory_msgs/JointTrajectoryPoint`: `TOPIC/0.position`, …; a command.
- `control_msgs/JointTrajectoryControllerState`: `TOPIC/JOINT.position`, …; a command, what the controller asks for.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Array

STATE = "sensor_msgs/msg/JointState"
LINES = "trajectory_msgs/msg/JointTrajectory"
COMMANDING = {"command", "commands", "commanded", "cmd", "desired", "target", "targets", "goal", "goals"}
COMMANDING |= {"reference", "references", "setpoint", "setpoints"}
SAYS = {"effort": "effort", "efforts": "effort", "torque": "effort", "torques": "effort"}
SAYS |= {"position": "position", "positions": "position", "velocity": "velocity", "velocities": "velocity"}
Values = dict[tuple[str, str], Any]  # (joint, quantity) -> number, or of a trajectory [(seconds, number), …]


@dataclass
class Stream:
    """Messages of one topic that speak of the same joints.

    Attributes:
        topic: Its name.
        kind: Type of its messages.
        keys: (joint, quantity) of each number in a message; the joint is a number where messages name none.
        stamps: When each was made, by its header [ns]; 0: it does not say.
        logs: When each was recorded [ns].
        rows: The numbers, a row a message.
    """

    topic: str
    kind: str
    keys: tuple[tuple[str, str], ...]
    stamps: list[int] = field(default_factory=list)
    logs: list[int] = field(default_factory=list)
    rows: list[list[Any]] = field(default_factory=list)

    @property
    def commands(self) -> bool:
        return self.kind != STATE or says_command(self.topic)

    @property
    def stamped(self) -> bool:
        return all(self.stamps)

    def column(self, key: tuple[str, str]) -> str:
        joint, quantity = key
        return f"{self.topic}/{joint}.{quantity}" if quantity else f"{self.topic}/{joint}"

    def columns(self) -> dict[str, tuple[str, str]]:
        return {self.column(key): key for key in self.keys}

    def quantity(self, key: tuple[str, str]) -> str:
        """What a command asks for; empty if neither the message nor the topic says."""
        found = {SAYS[word] for word in _words(self.topic) if word in SAYS}
        return key[1] or (found.pop() if len(found) == 1 else "")

    def clock(self, by_log: bool) -> np.ndarray:
        """When each message was made, or recorded [ns], [T]."""
        return np.array(self.logs if by_log or not self.stamped else self.stamps, np.int64)

    def held(self, at: np.ndarray, by_log: bool) -> dict[str, Array]:
        """What was last commanded at these times [ns], never what is still to come; nan before the first message."""
        time = self.clock(by_log)
        order = np.argsort(time, kind="stable")
        if self.kind == LINES:
            return self._along(at, time, order)
        last = np.searchsorted(time[order], at, side="right") - 1
        rows = np.array([self.rows[k] for k in order], float)
        values = np.where((last >= 0)[:, None], rows[np.maximum(last, 0)], np.nan)
        return {name: values[:, i] for i, name in enumerate(self.columns())}

    def between(self, at: np.ndarray, by_log: bool) -> dict[str, Array]:
        """Measured numbers at these times [ns], on straight lines between the messages; nan outside them."""
        time = self.clock(by_log)
        order = np.argsort(time, kind="stable")
        rows, since = np.array([self.rows[k] for k in order], float), time[order] - at[0]
        lines = [np.interp(at - at[0], since, rows[:, i], np.nan, np.nan) for i in range(len(self.keys))]
        return dict(zip(self.columns(), lines, strict=True))

    def _along(self, at: np.ndarray, time: np.ndarray, order: np.ndarray) -> dict[str, Array]:
        """Trajectories: from what was commanded when one came, over its points; a later one replaces what is left."""
        out = {}
        for i, name in enumerate(self.columns()):
            knots: list[tuple[float, float]] = []
            for k in order:
                start, points = float(time[k] - at[0]), self.rows[k][i]
                if knots:
                    here = float(np.interp(start, *np.array(knots).T))
                    while knots and knots[-1][0] >= start:
                        knots.pop()
                    knots.append((start, here))
                knots += [(start + 1e9 * seconds, number) for seconds, number in points]
            out[name] = np.interp((at - at[0]).astype(float), *np.array(knots).T, left=np.nan)
        return out


def says_command(topic: str) -> bool:
    return not COMMANDING.isdisjoint(_words(topic))


def _words(topic: str) -> list[str]:
    return [word for word in re.split(r"[^a-z]+", topic.lower()) if word]


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec


def _named(names: list[str], **quantities: Any) -> Values:
    """Numbers by joint; a quantity that a message leaves out is empty."""
    out: Values = {}
    for quantity, numbers in quantities.items():
        if len(numbers) not in (0, len(names)):
            raise ValueError(f"{len(names)} joints and {len(numbers)} numbers of {quantity}")
        out |= {(name, quantity): float(x) for name, x in zip(names, numbers, strict=False)}
    return out


def _state(m: Any) -> tuple[int, Values]:
    return _stamp(m), _named(list(m.name), position=m.position, velocity=m.velocity, effort=m.effort)


def _array(m: Any) -> tuple[int, Values]:
    return 0, {(str(i), ""): float(x) for i, x in enumerate(np.atleast_1d(m.data))}


def _point(m: Any) -> tuple[int, Values]:
    names = [str(i) for i in range(max(len(m.positions), len(m.velocities), len(m.effort)))]
    return 0, _named(names, position=m.positions, velocity=m.velocities, effort=m.effort)


def _trajectory(m: Any) -> tuple[int, Values]:
    out: Values = {}
    for point in m.points:
        seconds = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        for key, number in _named(list(m.joint_names), position=point.positions).items():
            out.setdefault(key, []).append((seconds, number))
    return _stamp(m), out


def _controller(m: Any) -> tuple[int, Values]:
    asked = m.reference if hasattr(m, "reference") else m.desired
    quantities = {"position": asked.positions, "velocity": asked.velocities, "effort": asked.effort}
    return _stamp(m), _named(list(m.joint_names), **quantities)


READ: dict[str, Callable[[Any], tuple[int, Values]]] = {
    STATE: _state,
    LINES: _trajectory,
    "trajectory_msgs/msg/JointTrajectoryPoint": _point,
    "control_msgs/msg/JointTrajectoryControllerState": _controller,
    **{f"std_msgs/msg/{kind}": _array for kind in ("Float64MultiArray", "Float32MultiArray", "Float64", "Float32")},
}


def take(streams: dict[tuple[str, tuple], Stream], topic: str, kind: str, message: Any, log: int) -> None:
    """Put a message into its stream; one that speaks of nothing is left out.

    Raises:
        UserError: If it contradicts itself.
    """
    try:
        stamp, values = READ[kind](message)
    except ValueError as error:
        raise UserError(f"{topic}: a message of {error}, at {log} ns.") from error
    if not values:
        return
    keys = tuple(sorted(values))
    stream = streams.setdefault((topic, keys), Stream(topic, kind, keys))
    stream.stamps.append(stamp)
    stream.logs.append(log)
    stream.rows.append([values[key] for key in keys])
