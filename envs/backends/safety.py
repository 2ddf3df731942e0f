"""What may be sent to a robot, and when to stop. Pure arithmetic: no clock, no socket, no robot in here.

Everything that moves the arm goes through `Gate`: it cuts moves, and the stream asks it again about each path it plays.
`doubt` says whether what is known now allows going on; the backend holds on the first doubt and stops after it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.backends.limits import Limits
from envs.fr3 import DQ_MAX, Q_MAX, Q_MIN
from envs.kinematics import chain

Array = NDArray[np.float64]
BODY_JOINTS = slice(2, 7)  # joints 3 to 7: elbow and wrist, the ones that can reach the table
TRACKING = 0.35  # [rad] a joint this far from where it was told to be is doubtful
OUTSIDE = 0.03  # [m] the measured tip may be this far outside the box, since compliance lets it be pushed
BOW = 1e-3  # [m] that the tip leaves the straight line between two postures


class NotSafe(Exception):
    """A motion that is refused as a whole. The message says why."""


class Unseen(NotSafe):
    """The object is lost; the arm itself is as it should be."""


class Step(NamedTuple):
    """What became of requested moves, a row each.

    Attributes:
        path: Targets to stream, one a sample, [N, S, 7] rad; each of them within the limits.
        share: How much of the move was granted, [N] 0…1.
        note: Why it was not all of it, N texts; empty where it was.
    """

    path: Array
    share: Array
    note: list[str]


class Gate:
    """Cuts moves so that no target leaves the limits.

    Args:
        limits: What is allowed.
        tool_length: From the flange to the tip, [m].
        sample_dt: Time between the targets of a path, [s].
    """

    def __init__(self, limits: Limits, *, tool_length: float, sample_dt: float):
        self.limits, self.tool_length, self.sample_dt = limits, tool_length, sample_dt
        self.q_low, self.q_high = Q_MIN + limits.joint_margin, Q_MAX - limits.joint_margin

    def step(self, start: Array, goal: Array, samples: int) -> Step:
        """Straight moves in joint space within one control period, each cut before its first forbidden target.

        Args:
            start: Targets in force now, [N, 7] rad.
            goal: Targets asked for, [N, 7] rad.
            samples: Targets to spread the move over.

        Raises:
            NotSafe: If a number is not finite, or a start is itself outside the limits: then nothing may be sent.
        """
        self._check_start(start)
        bad = np.flatnonzero(~np.isfinite(goal).all(1))
        if len(bad):
            raise NotSafe(f"a target is not finite: {goal[bad[0]]}")
        goal = np.clip(goal, -10.0, 10.0)  # no joint turns that far; larger numbers would overflow below
        allowed = self.limits.speed * DQ_MAX * self.sample_dt * samples
        share = np.minimum(1.0, (allowed / np.maximum(np.abs(goal - start), 1e-12)).min(1))
        note = ["joint speed" if s < 1 else "" for s in share]
        ramp = np.linspace(0, 1, samples + 1)[1:, None]
        path = start[:, None] + ramp * (share[:, None] * (goal - start))[:, None]  # [N, S, 7]
        reasons = self._forbidden(path, start)
        for n in range(len(path)):
            broken = np.stack([reasons[key][n] for key in reasons])  # [reasons, S]
            if broken.any():
                first = int(broken.any(0).argmax())
                path[n, first:] = path[n, first - 1] if first else start[n]
                share[n] *= first / samples
                note[n] = list(reasons)[int(broken[:, first].argmax())]
        return Step(path, share, note)

    def route(self, path: Array) -> Array:
        """A longer path as it is, [S, 7], if every target and every pace in it is allowed.

        An arm at rest sags, so the path may begin up to `OUTSIDE` out of the box, as long as it leads straight back in.

        Raises:
            NotSafe: With the first reason, and where.
        """
        if not np.isfinite(path).all():
            raise NotSafe("a target of the path is not finite")
        found = self._forbidden(path[None], None)
        found["workspace box"] &= ~self._returning(path)
        for reason, where in found.items():
            if where.any():
                at = int(where[0].argmax())
                where_at = f"{reason}, after {100 * at // len(path)} % of the path (tip {self.tip(path[at])} m)"
                then = "" if at else ". Guide the tip into backend.limits.low/high, the joints away from their ends"
                raise NotSafe(where_at + then)
        if (np.abs(np.diff(path, axis=0)) > self.limits.speed * DQ_MAX * self.sample_dt + 1e-9).any():
            raise NotSafe("joint speed")
        return path

    def _returning(self, path: Array) -> NDArray[np.bool_]:
        """Which targets [1, S] are still on the way back in: along no axis farther out than the targets before them."""
        tip = chain(path, self.tool_length)[2]  # [S, 3]
        out = np.maximum(0, np.maximum(self.limits.low - tip, tip - np.array(self.limits.high)))
        return ((out[0] <= OUTSIDE) & (out <= np.minimum.accumulate(out) + BOW)).all(1)[None]

    def tip(self, q: Array) -> list[float]:
        """Where the tip is for one posture [7], rounded for people, [3] m."""
        return [round(float(x), 3) for x in chain(q[None], self.tool_length)[2][0]]

    def _check_start(self, start: Array) -> None:
        if not np.isfinite(start).all():
            raise NotSafe("joint angles are not finite")
        for reason, where in self._forbidden(start[:, None], None).items():
            if where.any():
                tip = self.tip(start[int(where[:, 0].argmax())])
                raise NotSafe(f"the arm is already outside its limits: {reason} (tip at {tip} m)")

    def _forbidden(self, path: Array, start: Array | None) -> dict[str, NDArray[np.bool_]]:
        """Which targets [N, S] break which limit; the step cap counts from `start` [N, 7], if there is one."""
        n, s = path.shape[:2]
        origins, _, tip = chain(path.reshape(-1, 7), self.tool_length)
        tip, limits = tip.reshape(n, s, 3), self.limits
        body = origins[:, BODY_JOINTS, 2].min(1).reshape(n, s)
        found = {
            "joint range": ((path < self.q_low) | (path > self.q_high)).any(2),
            "workspace box": ((tip < limits.low) | (tip > limits.high)).any(2),
            "elbow or wrist too low": body < limits.low[2] + limits.body_height,
        }
        if start is not None:
            before = chain(start, self.tool_length)[2]
            found["step size"] = np.linalg.norm(tip - before[:, None], axis=2) > limits.step
        return found


def doubt(
    limits: Limits,
    *,
    state_age: float,
    mode: str,
    q: Array,
    told: Array,
    dq: Array,
    tip: Array,
) -> str:
    """Why the arm must not go on; empty if nothing speaks against it.

    Args:
        limits: What is allowed.
        state_age: Since the robot's state last changed, [s].
        mode: Of the robot, as its controller names it.
        q, told: Measured joint angles and the targets in force, [7] rad.
        dq: Measured joint velocities, [7] rad/s.
        tip: Measured position of the tip, [3] m.
    """
    if mode == "UserStopped":
        return "the stop button is pressed"
    if mode == "Reflex":
        return "the robot stopped itself (reflex)"
    if mode not in ("Move", "Idle"):
        return f"the robot is in mode {mode}"
    if not state_age <= limits.state_age:
        return f"no news from the robot for {1e3 * state_age:.0f} ms"
    if not (np.isfinite(q).all() and np.isfinite(dq).all()):
        return "the robot's state is not finite"
    near = (q < Q_MIN + limits.joint_margin / 2) | (q > Q_MAX - limits.joint_margin / 2)
    if near.any():
        return f"joint {int(near.argmax()) + 1} is at the end of its range"
    if (np.abs(dq) > DQ_MAX * min(1.0, limits.speed + 0.3)).any():
        return f"joint {int(np.abs(dq / DQ_MAX).argmax()) + 1} is too fast"
    if (np.abs(q - told) > TRACKING).any():
        return f"joint {int(np.abs(q - told).argmax()) + 1} is not where it was told to be"
    if ((tip < np.subtract(limits.low, OUTSIDE)) | (tip > np.add(limits.high, OUTSIDE))).any():
        return "the tip was pushed out of the workspace box"
    return ""


def unseen(limits: Limits, age: float | None) -> str:
    """Why the object counts as lost, from the age of its newest sight [s] (None: never seen); empty if it is seen."""
    if age is None:
        return "the object was never seen"
    return "" if 0 <= age <= limits.detection_age else f"the object was last seen {1e3 * age:.0f} ms ago"


class Retries:
    """Counts faults in a row.

    Args:
        allowed: How many may follow each other.
    """

    def __init__(self, allowed: int):
        self.allowed, self.faults = allowed, 0

    def failed(self, reason: str) -> None:
        """Count one.

        Raises:
            NotSafe: If it was one too many.
        """
        self.faults += 1
        if self.faults > self.allowed:
            raise NotSafe(f"{self.faults} faults in a row, the last: {reason}")

    def succeeded(self) -> None:
        """Start counting anew."""
        self.faults = 0
