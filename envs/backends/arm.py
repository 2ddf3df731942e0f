"""The FR3 through franky: connect, read, aim an impedance tracker, stop. No task and no limits in here."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.backends.arm_errors import explain, first_line, not_ready
from envs.backends.base import BackendError
from envs.backends.client import knock, load_franky, within

Array = NDArray[np.float64]
FCI_PORT = 1337
NULL_STIFFNESS = 10.0  # [N m/rad] of the pull to a posture, which leaves the tip where it is


class ArmState(NamedTuple):
    """What the robot says of itself: q [7] rad, dq [7] rad/s, torque [7] N m, its own clock [s], mode, errors."""

    q: Array
    dq: Array
    torque: Array
    time: float
    mode: str
    errors: str


class Arm:
    """One robot. Every call that fails raises BackendError with one line for people.

    Args:
        ip: Address of the robot.
        realtime: "enforce" needs a real-time kernel, "ignore" runs without: then a busy computer can make the robot
            stop by itself, and it holds.
        interface: "joint" or "cartesian", the impedance controller that follows the targets.
        stiffness: Of the joints, [7] N m/rad (joint interface).
        cartesian_stiffness: Translation [N/m] and rotation [N m/rad] (Cartesian interface).
        torque_threshold: Contact torque at which the robot stops itself, [N m].
        force_threshold: Contact force at which the robot stops itself, [N].
        load_mass, load_centre: What hangs on the flange and the robot's own settings do not know, [kg] and [3] m.
        timeout: For connecting, [s].
    """

    def __init__(
        self,
        ip: str,
        *,
        realtime: str,
        interface: str,
        stiffness: list[float],
        cartesian_stiffness: tuple[float, float],
        torque_threshold: float,
        force_threshold: float,
        load_mass: float,
        load_centre: list[float],
        timeout: float,
    ):
        for name, value, allowed in (
            ("realtime", realtime, ("ignore", "enforce")),
            ("interface", interface, ("joint", "cartesian")),
        ):
            if value not in allowed:
                raise ValueError(f"{name}={value!r}; allowed: {', '.join(allowed)}")
        if len(stiffness) != 7 or min(stiffness) <= 0:
            raise ValueError(f"stiffness={stiffness}; seven numbers above 0 are needed [N m/rad]")
        self.ip, self.realtime, self.interface, self.timeout = ip, realtime, interface, timeout
        self.stiffness, self.cartesian_stiffness = np.array(stiffness, float), cartesian_stiffness
        self.thresholds, self.load = (torque_threshold, force_threshold), (load_mass, load_centre)
        self.franky = load_franky()
        self.posture: Array | None = None  # [7] rad that the Cartesian interface keeps near; where it begins if None
        self.robot: Any = None
        self.tracker: Any = None
        self.newest_time = 0.0  # [s] on the robot's clock, of the last state that was read

    def connect(self) -> None:
        """Connect and set contact thresholds and load.

        Raises:
            BackendError: Why not, and what to check.
        """
        try:
            knock(self.ip, FCI_PORT)
        except OSError as error:
            raise BackendError(
                f"no robot answers at {self.ip} ({error}). Check --robot-ip, the cable, and in Desk that the "
                "joints are unlocked and FCI is active."
            ) from error
        mode = self.franky.RealtimeConfig.Enforce if self.realtime == "enforce" else self.franky.RealtimeConfig.Ignore
        found = within(self.timeout, lambda: self.franky.Robot(self.ip, realtime_config=mode), "robot", self.ip)
        self._call(lambda: found.set_collision_behavior(*self.thresholds))
        mass = self.load[0]  # none is told, too: the robot keeps what the last client said
        centre = [float(x) for x in self.load[1]] if mass else [0.0, 0.0, 0.0]
        inertia = (mass * 0.05**2 * np.eye(3)).ravel().tolist()
        self._call(lambda: found.set_load(mass, centre, inertia))
        self.robot = found  # only now: whoever tries again must set them again

    def read(self) -> ArmState:
        """The newest state; outside of a motion it is asked for, which takes a few milliseconds."""
        state = self._call(lambda: self.robot.state)
        self.newest_time = state.time.to_sec()
        return ArmState(
            np.array(state.q, float).ravel(),
            np.array(state.dq, float).ravel(),
            np.array(state.tau_J, float).ravel(),
            self.newest_time,
            str(state.robot_mode).rpartition(".")[2],
            str(state.current_errors).strip("[]"),
        )

    def track(self) -> None:
        """Begin to hold the arm where it is, by the impedance controller."""
        f = self.franky
        if self.interface == "joint":
            self.tracker = self._call(lambda: f.JointImpedanceTracker(self.robot, stiffness=self.stiffness))
            return
        along, about = (float(x) for x in self.cartesian_stiffness)
        posture = f.PostureTask(self.read().q if self.posture is None else self.posture, NULL_STIFFNESS)
        self.tracker = self._call(
            lambda: f.CartesianImpedanceTracker(
                self.robot, translational_stiffness=along, rotational_stiffness=about, posture_task=posture
            )
        )
        state = self._call(lambda: self.robot.state)
        self._end_effector = state.F_T_EE, state.EE_T_K

    def aim(self, q: Array) -> None:
        """Give the controller its next target, [7] rad. Only the stream calls this, with what the gate let through."""
        if self.interface == "joint":
            self._call(lambda: self.tracker.set_target(q))
        else:
            frame = self.franky.Frame.EndEffector
            pose = self._call(lambda: self.robot.model.pose(frame, q, *self._end_effector))
            self._call(lambda: self.tracker.set_target(pose))

    @property
    def in_control(self) -> bool:
        """Whether the controller that `track` began still runs."""
        return self.tracker is not None and bool(self.robot.is_in_control)

    def stop(self) -> str:
        """Bring the arm to rest and end the controller; what the robot reported about its end, empty if nothing."""
        if self.tracker is None:
            return ""
        self.tracker = None
        said = ""
        try:
            if self.robot.is_in_control:
                self.robot.move(self.franky.TorqueStopMotion(), asynchronous=True)
            if not self.robot.join_motion(timeout=4.0):
                self.robot.stop()
        except Exception as error:  # franky's errors have no common base; whatever it is, the motion is over
            said = first_line(error)
        return said

    def recover(self) -> None:
        """Clear the errors of the last motion.

        Raises:
            BackendError: If the robot does not become ready.
        """
        try:
            self.robot.recover_from_errors()
        except Exception as error:
            raise BackendError(explain(error, self.ip)) from error
        deadline = time.monotonic() + 2.0
        mode = self.read().mode  # the answer of the recovery itself may be False although the robot is ready
        while mode != "Idle":
            if time.monotonic() > deadline:
                raise BackendError(not_ready(mode))
            time.sleep(0.02)
            mode = self.read().mode

    def close(self) -> None:
        """Stop and disconnect."""
        if self.robot is not None:
            self.stop()
            self.robot = None

    def _call(self, do: Callable[[], Any]) -> Any:
        try:
            return do()
        except BackendError:
            raise
        except Exception as error:  # franky raises its own errors, RuntimeError and others: all mean the same here
            raise BackendError(explain(error, self.ip)) from error
