"""The real client against a controller that speaks the robot's protocol: it moves as told, and no further."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envs.backends.arm import Arm
from envs.backends.base import BackendError
from envs.backends.franka import FrankaBackend
from envs.backends.rig import Rig
from envs.backends.safety import NotSafe
from envs.perception.base import Detection
from envs.stand_in.client import StandIn
from envs.tasks.push import Push

RIGHT = np.array([[0.0, 0.5]])


def test_the_arm_moves_as_told_and_everything_is_recorded(robot: FrankaBackend) -> None:
    first, rows = robot._observation.copy(), []
    for _ in range(4):
        out = robot.send(RIGHT)
        rows.append(robot.samples())
        assert not out.invalid[0] and robot.note == ""
        np.testing.assert_allclose(out.action_sent, RIGHT)
    moved = out.observation - first
    assert moved[0, 1] > 0.05 and abs(moved[0, 0]) < 0.02  # four times half of 5 cm, less what compliance holds back
    times = np.concatenate([r["time"] for r in rows if r])
    assert (np.diff(times) > 0).all() and len(times) / (times[-1] - times[0]) > 100  # [Hz]
    assert robot.pace.report()["period_median_s"] == pytest.approx(0.2, abs=0.005)


def test_no_two_samples_have_one_time(robot: FrankaBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = robot.rig.stream
    stream.hold()
    stream.take_samples()
    now = stream.clock.now() + 100.0
    monkeypatch.setattr(stream, "clock", SimpleNamespace(now=lambda: now))
    for _ in range(3):
        stream._tick()
    times = [s.time for s in stream.take_samples()]
    assert times.count(now) == 1 and times == sorted(set(times))
    stream._tick()
    assert stream.take_samples() == []


def test_a_move_out_of_the_box_is_cut_and_says_so(stand_in: StandIn, on_stand_in) -> None:
    robot = on_stand_in(stand_in, high=(0.82, 0.08, 0.10))
    for _ in range(4):
        out = robot.send(2 * RIGHT)
        assert not out.invalid[0] and robot.gate.tip(robot.rig.stream.told)[1] <= 0.08
    assert robot.note == "limited: workspace box" and out.action_sent[0, 1] < 0.5
    assert robot.report()["limited"] >= 2


def seer(robot: FrankaBackend, read: Callable[[], Detection | None]) -> None:
    robot.rig._perception = SimpleNamespace(read=read, close=lambda: None)  # type: ignore[assignment]


def test_a_picture_without_the_object_says_nothing_until_the_last_sight_is_old(robot: FrankaBackend) -> None:
    first = robot.rig.sight()._replace(time=time.monotonic())
    answers = [first]
    seer(robot, lambda: answers.pop() if answers else None)
    assert robot.rig.sight() is first and robot.rig.sight() is first and robot.rig.waits == 0
    with pytest.raises(NotSafe, match="last seen"):
        while True:
            robot.rig.sight()
            time.sleep(0.02)


def test_waiting_for_the_object_is_no_overrun(robot: FrankaBackend) -> None:
    seen, lost_until = robot.rig.sight(), time.monotonic() + 0.7

    def read() -> Detection:
        now = time.monotonic()
        return seen._replace(time=now if now > lost_until else now - 10)

    seer(robot, read)
    for _ in range(2):
        assert not robot.send(RIGHT).invalid[0]
    assert robot.rig.waits == 1 and robot.pace.overruns == 0 and len(robot.pace.lengths) == 1


def test_a_joint_near_its_range_does_not_come_nearer(robot: FrankaBackend) -> None:
    """Joint 7 is told to go beyond its range: the gate cuts it, the arm stays 0.1 rad away and is not stopped."""
    stream, end = robot.rig.stream, robot.gate.q_high[6]
    for _ in range(12):
        start = stream.hold()
        goal = start + [0, 0, 0, 0, 0, 0, 0.2]
        step = robot.gate.step(start[None], goal[None], robot.samples_per_step)
        robot.rig.follow(step.path[0])
    assert step.note == ["joint range"] and stream.told[6] == pytest.approx(end, abs=0.02)
    assert stream.state.q[6] < end + 0.02 and not stream.stopped.is_set()
    with pytest.raises(NotSafe, match="joint range"):
        stream.play(stream.hold()[None] + [0, 0, 0, 0, 0, 0, 0.03])  # the gate cannot be gone around


def test_a_second_client_is_told_so(robot: FrankaBackend, stand_in: StandIn, robot_config: dict) -> None:
    second = Arm(stand_in.ip, **{**robot_config["arm"], "timeout": 1})
    with pytest.raises(BackendError, match="Another client may hold it"):
        second.connect()


def test_nobody_at_the_address(robot_config: dict) -> None:
    pytest.importorskip("franky", reason="needs the robot's client")
    began = time.monotonic()
    with pytest.raises(BackendError, match="no robot answers at 127.77.77.77"):
        Arm("127.77.77.77", **robot_config["arm"]).connect()
    assert time.monotonic() - began < 5


def test_a_connection_that_did_not_finish_counts_for_nothing(
    stand_in: StandIn, robot_config: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever tries again must set contact thresholds and load again."""
    calls, whole = [], Arm._call

    def broken(arm: Arm, do: Callable[[], Any]) -> Any:
        calls.append(do)
        if len(calls) == 2:
            raise BackendError("the line is dead")
        return whole(arm, do)

    monkeypatch.setattr(Arm, "_call", broken)
    arm = Arm(stand_in.ip, **{**robot_config["arm"], "timeout": 30})
    with pytest.raises(BackendError, match="the line is dead"):
        arm.connect()
    assert len(calls) == 2 and arm.robot is None


def test_no_load_takes_back_the_load_of_before(stand_in: StandIn, robot_config: dict) -> None:
    """The robot keeps what the last client told it."""
    told = []
    for mass in (0.3, 0.0):
        arm = Arm(stand_in.ip, **{**robot_config["arm"], "timeout": 30, "load_mass": mass})
        arm.connect()
        time.sleep(0.3)  # the first states may be older
        told.append(arm.robot.state.m_load)
        arm.close()
    assert told == pytest.approx([0.3, 0.0])


@pytest.mark.parametrize("patience", [None, -1.0, float("inf")])
def test_patience_is_a_number_of_seconds(patience: float | None) -> None:
    with pytest.raises(ValueError, match="patience=.*a number of seconds, 0 or more"):
        Rig(None, None, None, gripper=None, clock="robot", patience=patience, dry_run=False)  # type: ignore


@pytest.mark.parametrize("tip", [[0.4, 0.0], [0.4, 0.0, float("nan")], 0.4])
def test_the_safe_tip_is_a_place(tip: Any, robot_push: Push) -> None:
    rig = SimpleNamespace(gate=SimpleNamespace(limits=SimpleNamespace(speed=1.0)))
    with pytest.raises(ValueError, match="safe_tip=.*three numbers"):
        FrankaBackend(robot_push, rig, safe_tip=tip, reset_speed=0.1)  # type: ignore
