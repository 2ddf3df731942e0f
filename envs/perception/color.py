"""The object by its colour, and its place by the depth behind the coloured pixels."""

from collections.abc import Sequence

import numpy as np

from envs.perception.base import Array
from envs.perception.calibration import transform
from envs.perception.camera import Frame
from envs.perception.extra import load
from envs.perception.intrinsics import Intrinsics

HSV_MAX = (179, 255, 255)  # OpenCV's range of hue, saturation and value
WHOLE = 0.8  # of the diameter: a disc that is narrower in some direction is partly hidden
ANGLES = np.arange(0, np.pi, np.pi / 8)


class ColorBlob:
    """Finds the largest patch of one colour within a box, and takes the mean of the points on its top.

    Args:
        hsv_low, hsv_high: Range of hue 0..179, saturation and value 0..255 (OpenCV's HSV). A low hue above the high one
            goes through red: [170, ...] to [10, ...].
        low, high: Corners of the box in the robot's base frame in which the object can be, [3] m. Its floor should be
            just above the table.
        top: Depth of the layer below the highest point that is averaged, [m]: the object's flat top without its sides.
        min_pixels: Smaller patches are not the object.
        offset: From the centre of the top to the object's centre, base frame, [3] m.
        diameter: Of the object's round top, [m]. The part of it that an arm or a hand leaves to see has its middle
            elsewhere (half of a disc of 5 cm: 11 mm) and is not taken for the object; None: it is.

    Raises:
        ValueError: For ranges that are not ranges, or a number that must be positive and is not.
    """

    depth = True

    def __init__(
        self,
        *,
        hsv_low: Sequence[int],
        hsv_high: Sequence[int],
        low: Sequence[float],
        high: Sequence[float],
        top: float,
        min_pixels: int,
        offset: Sequence[float],
        diameter: float | None = None,
    ):
        for name, values in (("hsv_low", hsv_low), ("hsv_high", hsv_high)):
            if len(values) != 3 or any(not 0 <= v <= m for v, m in zip(values, HSV_MAX, strict=True)):
                raise ValueError(f"{name}={list(values)} must be three numbers within 0..{list(HSV_MAX)}")
        if any(a > b for a, b in zip(hsv_low[1:], hsv_high[1:], strict=True)):
            raise ValueError(
                f"hsv_low={list(hsv_low)} must not exceed hsv_high={list(hsv_high)} in saturation and value"
            )
        if len(low) != 3 or len(high) != 3 or any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(
                f"the box from low={list(low)} to high={list(high)} is inside out or not three numbers each"
            )
        if not (top > 0 and min_pixels > 0 and len(offset) == 3):
            raise ValueError(f"top={top} m and min_pixels={min_pixels} must be positive, offset={offset} three numbers")
        if diameter is not None and diameter <= 0:
            raise ValueError(f"diameter={diameter} m must be positive, or null for an object of any size")
        h, s, v = HSV_MAX
        low_hue, high_hue = hsv_low[0], hsv_high[0]
        hues = [(low_hue, high_hue)] if low_hue <= high_hue else [(low_hue, h), (0, high_hue)]
        self._ranges = [((a, *hsv_low[1:]), (b, *hsv_high[1:])) for a, b in hues]
        self.low, self.high, self.offset = (np.array(x, float) for x in (low, high, offset))
        self.top, self.min_pixels, self.diameter = top, min_pixels, diameter

    def find(self, frame: Frame, intrinsics: Intrinsics, base_T_camera: Array) -> Array | None:
        """The object's centre in the robot's base frame, [3] m; None if too little of it is seen in the box."""
        assert frame.depth is not None, "the camera was opened without depth"
        cv2 = load("cv2")
        hsv = cv2.cvtColor(frame.color, cv2.COLOR_RGB2HSV)
        mask = np.bitwise_or.reduce([cv2.inRange(hsv, a, b) for a, b in self._ranges])
        mask = cv2.erode(mask, np.ones((3, 3), np.uint8))  # depth at an edge belongs to neither side
        v, u = np.nonzero((mask > 0) & (frame.depth > 0))
        rays = intrinsics.rays(np.column_stack([u, v]).astype(float))
        points = transform(base_T_camera, rays * frame.depth[v, u, None])  # [n, 3]
        inside = ((points >= self.low) & (points <= self.high)).all(1)
        v, u, points = v[inside], u[inside], points[inside]
        if len(points) < self.min_pixels:
            return None
        patch = np.zeros(mask.shape, np.uint8)
        patch[v, u] = 1
        _, labels, stats, _ = cv2.connectedComponentsWithStats(patch)
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        if stats[largest, cv2.CC_STAT_AREA] < self.min_pixels:
            return None
        points = points[labels[v, u] == largest]
        height = np.percentile(points[:, 2], 90)
        disc = points[points[:, 2] > height - self.top]
        if self.diameter is not None:
            widths = np.ptp(disc[:, :2] @ np.stack([np.cos(ANGLES), np.sin(ANGLES)]), axis=0)
            if widths.min() < WHOLE * self.diameter:
                return None
        return disc.mean(0) + self.offset
