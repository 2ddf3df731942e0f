"""Recordings made with librealsense's software camera, replayed as if the camera were there."""

import subprocess
import sys

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="needs the camera's packages", exc_type=ImportError)

from envs.perception.base import PerceptionError  # noqa: E402
from envs.perception.camera import RealSense  # noqa: E402

PERIOD = 1 / 30  # [s]
GREY = np.repeat(np.arange(6, dtype=np.uint8), 480 * 640 * 3).reshape(6, 480, 640, 3) * 10
WALL = np.repeat(0.5 + 0.01 * np.arange(6), 480 * 640).reshape(6, 480, 640)  # [m]


def test_frames_come_once_when_they_are_due_with_their_own_depth_and_time(film):
    now = [100.0]
    camera = RealSense("", depth=True, recording=film("11", GREY, WALL), clock=lambda: now[0])
    for k in range(6):
        now[0] = 100.0 + k * PERIOD + 1e-4 * (k > 0)  # the first is taken when it is read
        frame = camera.read()
        assert frame is not None and frame.depth is not None and camera.read() is frame
        assert frame.color[0, 0, 0] == 10 * k and abs(frame.depth[240, 320] - (0.5 + 0.01 * k)) < 6e-4
        assert abs(frame.time - (100.0 + k * PERIOD)) < 1e-4
    now[0] = 110.0
    assert camera.read() is frame  # after the last one nothing is new, its time stays old
    camera.close()


def test_a_slow_reader_gets_the_newest_frame(film):
    now = [0.0]
    camera = RealSense("", depth=False, recording=film("12", GREY, None), clock=lambda: now[0])
    first = camera.read()
    now[0] = 3.5 * PERIOD
    frame = camera.read()
    assert first is not None and frame is not None and (first.color[0, 0, 0], frame.color[0, 0, 0]) == (0, 30)
    assert abs(frame.time - first.time - 3 * PERIOD) < 1e-4
    camera.close()


def test_depth_of_another_moment_is_not_shown_with_a_picture(film):
    path = film("13", GREY, WALL, late_ms=20_000 * PERIOD)
    camera = RealSense("", depth=True, recording=path, clock=lambda: 0.0)
    assert camera.read() is None
    camera.close()


STOPS = """
import os, sys
from envs.perception.camera import RealSense

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
for k in range(40):
    camera = RealSense("", depth=True, recording=sys.argv[1])
    for _ in range(k % 4):
        camera.read()
    camera.close()
"""


def test_a_recording_can_be_stopped_at_any_moment(film):
    path = film("16", GREY, WALL)
    # Processes that share a core: librealsense's reading thread is then often behind when its recording is closed.
    line = [sys.executable, "-c", STOPS, path]
    running = [subprocess.Popen(line, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    try:
        for process in running:
            _, err = process.communicate(timeout=60)
            assert process.returncode == 0, err
    finally:
        for process in running:
            process.kill()


def test_what_cannot_be_opened_is_named(film, tmp_path):
    with pytest.raises(PerceptionError, match="camera 99 is not connected"):
        RealSense("99", depth=True)
    with pytest.raises(PerceptionError, match="there is no recording"):
        RealSense("99", depth=True, recording=tmp_path / "none.db3")
    junk = tmp_path / "junk.db3"
    junk.write_text("no film")
    with pytest.raises(PerceptionError, match="junk.db3 does not start"):
        RealSense("99", depth=True, recording=junk)
    with pytest.raises(PerceptionError, match="no depth"):
        RealSense("14", depth=True, recording=film("14", GREY[:2], None))


def test_a_closed_camera_says_so(film):
    camera = RealSense("15", depth=False, recording=film("15", GREY[:2], None), clock=lambda: 0.0)
    camera.close()
    camera.close()
    with pytest.raises(PerceptionError, match="closed"):
        camera.read()
