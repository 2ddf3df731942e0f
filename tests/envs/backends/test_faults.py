"""Every fault we can cause, in a recorded episode: the arm holds in time, the episode says why, no row is lost."""

import ctypes
import re
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from envs.backends.base import BackendError
from envs.backends.franka import FrankaBackend
from envs.env import ControlEnv
from envs.stand_in.client import StandIn
from mpc_sgft.runs.real_rollout import drive
from mpc_sgft.storage.episode_file import Episode, read_episode
from mpc_sgft.storage.rollout import Rollout
from planners.base import Plan

AT = 3  # step that the fault comes before
NOTICED = 100  # [ms] from the doubt, which freezes the target, to the stop


class Planner:
    """Always to the right, and a fault in the middle."""

    def __init__(self, fault: Callable[[], object]):
        self.fault, self.steps = fault, 0

    def plan(self, *_: object, **__: object) -> Plan:
        self.steps += 1
        value = 0.3
        if self.steps == AT + 1:
            value = self.fault() or value
        action = torch.tensor([[0.0, value]])
        return Plan(action=action, mean=action[:, None], std=action[:, None], value=torch.zeros(1))


class Seer(torch.nn.Linear):
    """A model that sees what there is."""

    def encode(self, observation: torch.Tensor) -> torch.Tensor:
        return observation


@pytest.fixture
def episode(robot: FrankaBackend, tmp_path: Path) -> Callable[..., tuple[Rollout | None, Episode]]:
    """episode(fault): an episode in which it happens (None if an exception ended it), and its recording."""

    def run(fault: Callable[[], object], expected: type[Exception] | None = None, number: int = 1):
        robot.task.episode_steps = AT + 3
        path, rollout = tmp_path / f"{number}.mcap", None
        options = {"number": number, "seed": 1, "noise": 0.0, "candidate_steps": ()}
        if expected is None:
            rollout = drive(ControlEnv(robot), Seer(1, 1), Planner(fault), path, **options)
        else:
            with pytest.raises(expected):
                drive(ControlEnv(robot), Seer(1, 1), Planner(fault), path, **options)
        return rollout, read_episode(path)

    steps = robot.task.episode_steps
    yield run
    robot.task.episode_steps = steps


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ({"fault": "reflex"}, "reflex"),
        ({"fault": "user_stop"}, "stop button"),
        ({"blind": True}, "last seen"),
        ({"silent": True}, "no news|ended the motion|was lost"),
    ],
    ids=lambda value: next(iter(value), "") if isinstance(value, dict) else "",
)
def test_a_fault_ends_the_episode(order, words, robot: FrankaBackend, stand_in: StandIn, episode) -> None:
    rollout, recording = episode(lambda: stand_in.scene.tell(**order))
    assert robot.rig.running is None  # at rest
    assert re.search(words, rollout.aborted), rollout.aborted
    assert robot.hold_ms is not None and robot.hold_ms < NOTICED
    check_rows(recording, rollout)
    if order == {"fault": "user_stop"}:  # a person decides
        with pytest.raises(BackendError, match="Release the stop button"):
            robot.reset(np.arange(1))
        return
    stand_in.scene.tell(**{key: False for key in order if key != "fault"})
    again, _ = episode(lambda: None, number=2)  # recovered: the session goes on
    assert again.aborted is None and len(again.steps) == AT + 3


def check_rows(recording: Episode, rollout: Rollout) -> None:
    """Each step that was driven is in the file, the aborted one is marked, and joints were recorded in each."""
    assert recording.complete and recording.outcome["aborted"] == rollout.aborted
    steps = recording.transitions["step"]
    assert list(steps) == list(range(len(rollout.steps))) and len(steps) >= AT + 1
    assert recording.transitions["invalid"].tolist() == [False] * (len(steps) - 1) + [True]
    assert (np.diff(recording.joints["time"]) < 0.1).all() and len(recording.joints["time"]) >= 20 * AT  # 100 Hz


def test_a_planner_that_returns_nan_never_reaches_the_arm(robot: FrankaBackend, episode) -> None:
    _, recording = episode(lambda: float("nan"), expected=FloatingPointError)
    assert len(recording.transitions["step"]) == AT and "not finite" in recording.outcome["aborted"]
    with pytest.raises(FloatingPointError, match="not finite"):
        robot.send(np.array([[np.nan, 0.0]]))
    held = robot.rig.stream.told.copy()
    time.sleep(0.1)
    assert np.isfinite(held).all() and np.array_equal(robot.rig.stream.told, held)


def test_a_full_disk_in_mid_episode_leaves_the_arm_at_rest(robot: FrankaBackend, episode, tmp_path: Path) -> None:
    """No file may grow any further, which is what a full disk is to the writer."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "1.mcap"
    try:
        full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, limit[1]))  # noqa: E731
        _, recording = episode(full, expected=OSError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert list(recording.transitions["step"]) == list(range(AT)) and not recording.complete
    assert len(recording.joints["time"]) >= 20 * AT
    stream = robot.rig.stream
    deadline = time.monotonic() + 5
    while stream.playing and time.monotonic() < deadline:  # the last few milliseconds of the step that was lost
        time.sleep(0.001)
    assert not stream.playing and not stream.stopped.is_set()  # it holds
    assert robot.rig.end() == ""  # as closing the backend does on the command's way out
    state = robot.rig.arm.read()
    assert state.mode == "Idle" and abs(state.dq).max() < 0.01  # [rad/s]


def test_a_process_that_stalls_holds_and_goes_on(robot: FrankaBackend, episode) -> None:
    def stall() -> None:
        began = robot.rig.arm.read().time
        while robot.rig.arm.read().time < began + 0.5:
            ctypes.PyDLL(None).sleep(3)  # the whole interpreter stands still, the controller's thread does not

    rollout, recording = episode(stall)
    assert robot.pace.overruns == 1 and len(recording.transitions["step"]) >= AT
    assert rollout.aborted is None or "no news" in rollout.aborted


def test_a_robot_that_disappears_ends_the_session_with_a_line(robot: FrankaBackend, stand_in: StandIn, episode) -> None:
    rollout, recording = episode(stand_in.process.kill)
    check_rows(recording, rollout)
    with pytest.raises(BackendError, match="no robot answers|was lost"):
        robot.reset(np.arange(1))
    stand_in.scene = SimpleNamespace(close=stand_in.scene.close)


def test_an_object_that_is_hidden_before_an_episode_is_asked_for_again(robot: FrankaBackend, stand_in: StandIn) -> None:
    """By a hand, say. The arm rests while somebody puts it down."""
    put, place = [], robot.rig._place

    def hide_once(position: np.ndarray) -> None:
        put.append(robot.rig.running)
        place(position)
        stand_in.scene.tell(blind=len(put) == 1)

    robot.rig._place = hide_once
    robot.reset(np.arange(1))
    assert put == [None, None] and robot.counters["faults"] == robot.rig.retries.faults == 1
    assert not robot.send(np.array([[0.0, 0.3]])).invalid[0]


def test_an_arm_that_was_stopped_on_its_way_to_a_start_stays_at_rest(robot: FrankaBackend, stand_in: StandIn) -> None:
    """Somebody may be in its way: it does not move again by itself."""
    put, place = [], robot.rig._place

    def strike(position: np.ndarray) -> None:
        put.append(position)
        place(position)
        stand_in.scene.tell(fault="reflex")

    robot.rig._place = strike
    with pytest.raises(BackendError, match="cannot begin: .*The arm is at rest"):
        robot.reset(np.arange(1))
    assert len(put) == 1 and robot.rig.running is None


def test_a_start_out_of_the_box_is_said_at_once(robot: FrankaBackend) -> None:
    high = robot.gate.limits.high
    robot.gate.limits = replace(robot.gate.limits, low=(high[0] - 0.02, *robot.gate.limits.low[1:]))
    with pytest.raises(BackendError, match="workspace box, after 0 %.*Guide the tip into backend.limits.low/high"):
        robot.reset(np.arange(1))
    assert robot.rig.retries.faults == 0 and robot.rig.running is None


def test_faults_in_a_row_end_the_session(stand_in: StandIn, on_stand_in) -> None:
    robot = on_stand_in(stand_in, retries=1)
    for _ in range(2):
        stand_in.scene.tell(fault="reflex")
        while not robot.send(np.array([[0.0, 0.3]])).invalid[0]:
            pass
        if robot.rig.retries.faults == 0:
            robot.reset(np.arange(1))
    with pytest.raises(BackendError, match="2 faults in a row"):
        robot.reset(np.arange(1))
