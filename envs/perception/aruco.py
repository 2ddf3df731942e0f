"""The object by an ArUco tag on it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.perception.base import Array
from envs.perception.calibration import transform
from envs.perception.camera import Frame
from envs.perception.extra import load
from envs.perception.intrinsics import Intrinsics

AROUND = 0.4  # of the tag's size: what is kept around it for the fine corners
HALF_PIXEL = 0.5  # AprilTag's refinement puts (0, 0) at the corner of the first pixel, OpenCV at its centre
SQUARE = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2  # corners of a tag as OpenCV orders them


class TagPose(NamedTuple):
    """Where a tag is: its pose [4, 4] in the camera's frame in m, and the error of its corners on the plane z = 1."""

    camera_T_tag: Array
    error: float


def tag_pose(rays: Array, size: float) -> TagPose | None:
    """Pose of a square tag from the directions of its corners; None if no pose in front of the camera fits.

    A small tag seen from afar fits two tilts about equally well; the better one is taken. The centre hardly differs.
    SQPNP and not IPPE_SQUARE, which is as accurate but wrong for a tag whose side is exactly level (OpenCV 4.14).

    Args:
        rays: Corners on the plane z = 1 of the camera's frame, [4, 3], in OpenCV's order.
        size: Length of a side of the black square, [m].

    Source: cv2.SOLVEPNP_SQPNP; Terzakis & Lourakis, A Consistently Fast and Globally Optimal Solution to the
        Perspective-n-Point Problem, 2020.
    """
    cv2 = load("cv2")
    points, image = np.ascontiguousarray(SQUARE * size), np.ascontiguousarray(rays[:, None, :2])
    found, turn, shift = cv2.solvePnP(points, image, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not found or not np.isfinite(shift).all() or shift[2] <= 0:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    seen = transform(pose, points)
    return TagPose(pose, float(np.sqrt(((seen[:, :2] / seen[:, 2:] - rays[:, :2]) ** 2).sum(1).mean())))


class ArucoTag:
    """Finds one tag.

    Args:
        dictionary: Name of the family in cv2.aruco, e.g. "DICT_4X4_50".
        tag: Number of the tag in its family.
        size: Length of a side of the black square, [m].
        offset: The object's centre in the tag's frame (x right, y up on the tag, z out of it), [3] m.
        max_error: Root mean square by which the corners may miss a square's, [pixel]; a bent, blurred or covered
            tag misses by more.

    Raises:
        ValueError: For a tag that does not exist or a size that is not positive.
    """

    depth = False

    def __init__(self, *, dictionary: str, tag: int, size: float, offset: Sequence[float], max_error: float):
        aruco = load("cv2").aruco
        families = sorted(name for name in dir(aruco) if name.startswith("DICT_"))
        if dictionary not in families:
            raise ValueError(f"dictionary={dictionary!r} is unknown; available: {', '.join(families)}")
        family = aruco.getPredefinedDictionary(getattr(aruco, dictionary))
        if not 0 <= tag < len(family.bytesList):
            raise ValueError(f"tag={tag} is not in {dictionary}, which has 0 to {len(family.bytesList) - 1}")
        if not (size > 0 and max_error > 0 and len(offset) == 3):
            raise ValueError(f"size={size} m and max_error={max_error} must be positive, offset={offset} three numbers")
        # Coarse corners in the whole picture, fine ones around the tag: AprilTag fits lines to the sides, in 80 ms on a
        # whole noisy picture and 1 ms on a part. On tags of 30 pixels it leaves a quarter of the error of
        # CORNER_REFINE_SUBPIX, whose window reaches the next cell.
        fine = aruco.DetectorParameters()
        fine.cornerRefinementMethod = aruco.CORNER_REFINE_APRILTAG
        self._coarse, self._fine = aruco.ArucoDetector(family), aruco.ArucoDetector(family, fine)
        self.tag, self.size, self.offset, self.max_error = tag, size, np.array(offset, float), max_error

    def corners(self, color: NDArray[np.uint8]) -> Array | None:
        """Corners of the tag in a picture [H, W, 3], [4, 2] pixel; None unless exactly one such tag is seen."""
        cv2 = load("cv2")
        grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        coarse = self._one(self._coarse, grey)
        if coarse is None:
            return None
        margin = AROUND * np.ptp(coarse, axis=0).max()
        low = np.maximum(coarse.min(0) - margin, 0).astype(int)
        high = (coarse.max(0) + margin).astype(int)
        fine = self._one(self._fine, np.ascontiguousarray(grey[low[1] : high[1], low[0] : high[0]]))
        return None if fine is None else fine + low - HALF_PIXEL

    def _one(self, detector: Any, grey: NDArray[np.uint8]) -> Array | None:
        corners, numbers, _ = detector.detectMarkers(grey)
        mine = [] if numbers is None else [k for k, number in enumerate(numbers.ravel()) if number == self.tag]
        return corners[mine[0]][0] if len(mine) == 1 else None

    def find(self, frame: Frame, intrinsics: Intrinsics, base_T_camera: Array) -> Array | None:
        """The object's centre in the robot's base frame, [3] m; None if it is not seen well."""
        corners = self.corners(frame.color)
        found = None if corners is None else tag_pose(intrinsics.rays(corners), self.size)
        if found is None or found.error * intrinsics.fx > self.max_error:
            return None
        return transform(base_T_camera @ found.camera_T_tag, self.offset[None])[0]
