"""A RealSense camera, or what one recorded: colour pictures, the depth behind each pixel, and when they were taken."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.perception.base import Array, PerceptionError
from envs.perception.extra import load
from envs.perception.intrinsics import Intrinsics
from envs.perception.pipeline import start_camera, start_recording, stop

START_S = 5.0  # [s] until the first picture of a camera
NEXT_MS = 1000  # for the next frame of a recording to be read; then it has ended
# Of a frame period, between a picture and the depth shown with it: more would tear a moving object apart.
MAX_SKEW = 0.75


class Frame(NamedTuple):
    """One picture.

    Attributes:
        color: [H, W, 3] red, green, blue.
        depth: Along the optical axis behind each pixel of `color`, [H, W] m, 0 where unknown; None if not streamed.
        time: Of the capture, on the clock of time.monotonic(), [s].
    """

    color: NDArray[np.uint8]
    depth: Array | None
    time: float


class RealSense:
    """The colour stream of one camera, with depth aligned to it if asked for.

    Args:
        serial: Which camera; a recording has its own.
        depth: Whether depth is needed.
        width, height: Of the streams, [pixel]; a recording has its own.
        fps: Frames per second; a recording has its own.
        recording: A .db3 file in place of the camera. Its first frame counts as taken when it is first read.
        clock: What a recording is played by, [s].

    Attributes:
        serial: Of the camera, or of the one that made the recording.
        intrinsics: Of the colour stream.

    Raises:
        PerceptionError: If the camera or the file cannot be used; says why and what to do.
    """

    def __init__(
        self,
        serial: str,
        *,
        depth: bool,
        width: int = 640,
        height: int = 480,
        fps: int = 30,
        recording: str | Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._rs, self._clock = load("pyrealsense2"), clock
        self._pipeline: Any
        self._frame: Frame | None = None
        self._ahead: tuple[float, Any] | None = None  # capture time and frames that are read but not due yet
        self._last = -np.inf  # capture time of the newest frames that were read
        self._first: tuple[float, float] | None = None  # of a recording: clock and time stamp of its first frame, [s]
        self._recorded = self._more = recording is not None  # more: the recording has not ended
        if recording is None:
            name = f"camera {serial}"
            self._pipeline, profile = start_camera(serial, depth=depth, width=width, height=height, fps=fps)
        else:
            name = str(recording)
            self._pipeline, profile = start_recording(recording)
        try:
            self._describe(name, profile, depth)
            if not self._recorded:
                self._wait(name)
        except PerceptionError:
            self.close()
            raise

    def _describe(self, name: str, profile: Any, depth: bool) -> None:
        rs = self._rs
        streams = {s.stream_type(): s for s in profile.get_streams()}
        color = streams.get(rs.stream.color)
        if color is None or color.format() != rs.format.rgb8 or (depth and rs.stream.depth not in streams):
            raise PerceptionError(f"{name} has no {'depth and ' * depth}color (rgb8) stream.")
        lens = color.as_video_stream_profile().get_intrinsics()
        try:
            self.intrinsics = Intrinsics(
                width=lens.width,
                height=lens.height,
                fx=lens.fx,
                fy=lens.fy,
                cx=lens.ppx,
                cy=lens.ppy,
                model=lens.model.name,
                coefficients=tuple(lens.coeffs),
            )
        except ValueError as err:
            raise PerceptionError(f"{name}: {err}.") from err
        self.serial: str = profile.get_device().get_info(rs.camera_info.serial_number)
        self._skew_ms = MAX_SKEW * 1000 / color.fps()
        self._align = rs.align(rs.stream.color) if depth else None

    def _wait(self, name: str) -> None:
        deadline = time.monotonic() + START_S
        while self.read() is None:
            if time.monotonic() > deadline:
                raise PerceptionError(f"{name} sent no picture for {START_S:.0f} s; plug it into another USB 3 port.")
            time.sleep(0.01)

    def read(self) -> Frame | None:
        """The newest frame; the same one, with its old time, as long as there is no newer. None before the first.

        Raises:
            PerceptionError: If the camera is closed or reports a failure.
        """
        if self._pipeline is None:
            raise PerceptionError("the camera is closed.")
        newest = None
        try:
            while (due := self._due()) is not None:
                newest = due
            if newest is not None:
                self._frame = self._picture(*newest)
        except RuntimeError as err:
            raise PerceptionError(f"camera {self.serial} failed: {err}.") from err
        return self._frame

    def _due(self) -> tuple[float, Any] | None:
        """The next frames, if their time has come."""
        while self._ahead is None and (frames := self._poll()) is not None:
            taken = self._usable(frames)
            if taken is not None and taken > self._last:
                self._ahead, self._last = (taken, frames), taken
        if self._ahead is None or self._ahead[0] > self._clock():
            return None
        due, self._ahead = self._ahead, None
        return due

    def _poll(self) -> Any:
        """Frames that were not handed out yet, or None: of a camera the newest, of a recording the next."""
        if self._more:
            self._more, frames = self._pipeline.try_wait_for_frames(NEXT_MS)
        else:
            frames = self._pipeline.poll_for_frames()
        return frames if frames.size() else None

    def _usable(self, frames: Any) -> float | None:
        """When frames were taken, [s]; None if the picture is missing, or the depth that was taken with it."""
        wanted = [frames.get_color_frame(), *([frames.get_depth_frame()] if self._align else [])]
        if not all(wanted):
            return None
        stamps = [frame.get_timestamp() for frame in wanted]
        if max(stamps) - min(stamps) > self._skew_ms:
            return None
        return self._capture_time(min(stamps) / 1000, wanted[0].get_frame_timestamp_domain())

    def _capture_time(self, stamp: float, domain: Any) -> float:
        """A time stamp [s] on the clock of time.monotonic(), [s]; of a camera never in the future."""
        now = self._clock()
        if self._recorded:
            if self._first is None:
                self._first = now, stamp
            return self._first[0] + (stamp - self._first[1])
        if domain == self._rs.timestamp_domain.hardware_clock:
            raise PerceptionError(
                f"camera {self.serial} stamps frames with a clock of its own, so their age is unknown; switch on its"
                " option global_time_enabled (realsense-viewer) or update its firmware."
            )
        return min(now, now - (time.time() - stamp))

    def _picture(self, taken: float, frames: Any) -> Frame:
        if self._align is None:
            return Frame(np.array(frames.get_color_frame().get_data()), None, taken)
        aligned = self._align.process(frames)
        depth = aligned.get_depth_frame()
        metres = np.asarray(depth.get_data()) * np.float32(depth.get_units())
        return Frame(np.array(aligned.get_color_frame().get_data()), metres, taken)

    def close(self) -> None:
        """Let go of the camera; a second call does nothing."""
        pipeline, self._pipeline, self._ahead = self._pipeline, None, None
        if pipeline is not None:
            stop(pipeline)
