"""What a real controller does when something is wrong, for rehearsal: franky-sim itself never refuses anything."""

from typing import Any

FAULTS = ("reflex", "user_stop")


def inject(server: Any, fault: str | None) -> None:
    """Abort the motion as the robot's controller does, and report the mode that goes with it.

    Args:
        server: franky-sim's FrankaRobotServer.
        fault: "reflex" (until the client recovers), "user_stop" (until None is injected), or None.
    """
    from franky_sim.franka_robot_protocol import (
        AutomaticErrorRecoveryCommand,
        AutomaticErrorRecoveryStatus,
        BaseCommand,
        MoveCommand,
        MoveStatus,
        RobotCommand,
        RobotMode,
    )

    if fault is not None and fault not in FAULTS:
        raise ValueError(f"unknown fault {fault!r}; allowed: {', '.join(FAULTS)}, null")
    kind = type(server)
    if not hasattr(kind, "injected"):
        plain_state, recover, move = kind.robot_state, AutomaticErrorRecoveryCommand.handle, MoveCommand.handle

        def robot_state(self: Any) -> Any:
            state = plain_state.__get__(self)
            if self.injected is None:
                return state
            mode = RobotMode.kReflex if self.injected == "reflex" else RobotMode.kUserStopped
            reflex = tuple(i == 11 and self.injected == "reflex" for i in range(41))
            return state.replace(robot_mode=mode, errors=reflex, reflex_reason=reflex)

        def handle_recovery(self: Any, to: Any) -> None:
            if to.injected == "user_stop":
                self.reply(AutomaticErrorRecoveryStatus.kCommandRejectedDueToActivatedSafetyFunctions)
                return
            to.injected = None
            recover(self, to)

        def handle_move(self: Any, to: Any) -> None:
            if to.injected is None:
                move(self, to)
            else:
                self.reply(MoveStatus.kCommandNotPossibleRejected)

        kind.injected, kind.robot_state = None, property(robot_state)
        AutomaticErrorRecoveryCommand.handle, MoveCommand.handle = handle_recovery, handle_move
    server.injected = fault
    motion = server.current_motion_id
    if fault is not None and motion:
        server.stop_motion(send_preemption_signal=False)
        status = MoveStatus.kReflexAborted if fault == "reflex" else MoveStatus.kEmergencyAborted
        BaseCommand.send_response(server._tcp_socket, RobotCommand.kMove, motion, status)
        server.reset_current_motion_id()
