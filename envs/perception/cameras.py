"""The object as one or several calibrated cameras see it."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from envs.perception.base import Array, Detection, PerceptionError
from envs.perception.calibration import Calibration, load_calibration
from envs.perception.camera import Frame, RealSense
from envs.perception.intrinsics import Intrinsics

log = logging.getLogger(__name__)


class Detector(Protocol):
    """Finds the object in one picture.

    Attributes:
        depth: Whether frames must have depth.
    """

    depth: bool

    def find(self, frame: Frame, intrinsics: Intrinsics, base_T_camera: Array) -> Array | None:
        """The object's centre in the robot's base frame, [3] m, or None."""
        ...


class View:
    """One calibrated camera and what is looked for in its pictures; each picture is searched once."""

    def __init__(self, camera: RealSense, calibration: Calibration, detector: Detector):
        self.camera, self.calibration, self.detector = camera, calibration, detector
        self._time, self._found = -math.inf, None

    def read(self) -> Detection | None:
        """What the newest picture shows, under the time at which it was taken."""
        frame = self.camera.read()
        if frame is not None and frame.time > self._time:
            position = self.detector.find(frame, self.camera.intrinsics, self.calibration.base_T_camera)
            self._time, self._found = frame.time, None if position is None else Detection(position, frame.time)
        return self._found


def fuse(detections: Sequence[Detection | None], *, window: float, agree: float) -> Detection | None:
    """One answer out of several cameras'.

    Those that see nothing, or whose picture is older than the newest by more than `window`, have no say. The mean of
    the others, at the time of the oldest of them; None if any of them is further than `agree` from the mean: one is
    wrong, and nobody knows which.

    Args:
        detections: One of each camera.
        window: [s].
        agree: [m].
    """
    seen = [d for d in detections if d is not None]
    if not seen:
        return None
    newest = max(d.time for d in seen)
    seen = [d for d in seen if newest - d.time <= window]
    mean = np.mean([d.position for d in seen], axis=0)
    if any(np.linalg.norm(d.position - mean) > agree for d in seen):
        return None
    return Detection(mean, min(d.time for d in seen))


class Cameras:
    """Perception by RealSense cameras.

    Args:
        calibrations: A file of each camera (tools/calibrate_camera.py makes it); it says which camera.
        detector: What is looked for.
        width, height, fps: Of the streams, [pixel], [1/s].
        window: Pictures within so much time are of the same moment, [s].
        agree: Cameras further than this from their mean contradict each other, [m].
        recordings: A .db3 file for each camera, to be replayed in its place; None: the cameras.
        clock: What recordings are played by, [s].

    Raises:
        ValueError: For settings that do not fit together.
        PerceptionError: If a calibration, a camera or a recording cannot be used.
    """

    def __init__(
        self,
        *,
        calibrations: Sequence[str],
        detector: Detector,
        width: int,
        height: int,
        fps: int,
        window: float,
        agree: float,
        recordings: Sequence[str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        if not calibrations or (recordings is not None and len(recordings) != len(calibrations)):
            raise ValueError(
                f"calibrations={list(calibrations)} needs a file of each camera,"
                f" and recordings={recordings} as many or null"
            )
        if not (window > 0 and agree > 0):
            raise ValueError(f"window={window} s and agree={agree} m must be positive")
        self.window, self.agree, self._contradict = window, agree, False
        self._views: list[View] = []
        places = [load_calibration(path) for path in calibrations]
        if len({place.serial for place in places}) < len(places):
            raise ValueError(f"calibrations={list(calibrations)} name one camera twice")
        try:
            for path, place, recording in zip(calibrations, places, recordings or [None] * len(places), strict=True):
                camera = RealSense(
                    place.serial,
                    depth=detector.depth,
                    width=width,
                    height=height,
                    fps=fps,
                    recording=recording,
                    clock=clock,
                )
                self._views.append(View(camera, place, detector))
                try:
                    place.check_camera(camera.serial, camera.intrinsics)
                except PerceptionError as err:
                    raise PerceptionError(f"{path}: {err}") from err
        except PerceptionError:
            self.close()
            raise

    def read(self) -> Detection | None:
        """The newest detection; None if the newest pictures do not show the object, or contradict each other.

        A camera that fails is left out from then on, with a warning.
        """
        detections = [self._read(view) for view in list(self._views)]
        fused = fuse(detections, window=self.window, agree=self.agree)
        contradict = fused is None and any(d is not None for d in detections)
        if contradict and not self._contradict:
            log.warning("cameras see the object more than %s m from the mean of all; calibrate them again", self.agree)
        self._contradict = contradict
        return fused

    def _read(self, view: View) -> Detection | None:
        try:
            return view.read()
        except PerceptionError as err:
            log.warning("%s It is left out from now on.", err)
            self._views.remove(view)
            view.camera.close()
            return None

    def close(self) -> None:
        """Let go of the cameras; a second call does nothing."""
        for view in self._views:
            view.camera.close()
        self._views = []
