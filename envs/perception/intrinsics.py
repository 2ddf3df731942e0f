"""How a camera turns directions into pixels, and back."""

from dataclasses import dataclass

import numpy as np

from envs.perception.base import Array

MODELS = ("none", "brown_conrady", "inverse_brown_conrady")
ITERATIONS = 10  # of the fixed point that undoes the lens
SAME = 0.01  # share by which focal lengths may differ and be the same camera's


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole with lens distortion, as RealSense cameras describe themselves.

    The camera's frame is OpenCV's: x to the right of the picture, y downwards, z into the scene; the centre of the
    first pixel is (0, 0).

    Attributes:
        width, height: Of the picture, [pixel].
        fx, fy: Focal lengths, [pixel].
        cx, cy: Principal point, [pixel].
        model: Distortion model by its name in librealsense.
        coefficients: k1 k2 p1 p2 k3.

    Raises:
        ValueError: For an unknown model, a size or focal length that is not positive, or not five finite coefficients.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "none"
    coefficients: tuple[float, ...] = (0.0,) * 5

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"distortion model {self.model!r}; known are {', '.join(MODELS)}")
        if not (min(self.width, self.height) > 0 and min(self.fx, self.fy) > 0):
            raise ValueError(f"size {self.width}x{self.height} and focal lengths {self.fx}, {self.fy} must be positive")
        if len(self.coefficients) != 5 or not np.isfinite([self.cx, self.cy, *self.coefficients]).all():
            raise ValueError(f"five finite distortion coefficients are needed, {self.coefficients} came")

    def rays(self, pixels: Array) -> Array:
        """Directions of pixels (u, v) [n, 2] as points on the plane z = 1 of the camera's frame, [n, 3].

        Source: rs2_deproject_pixel_to_point of librealsense (rsutil.h).
        """
        measured = (np.asarray(pixels, float) - [self.cx, self.cy]) / [self.fx, self.fy]  # [n, 2]
        if not any(self.coefficients):
            return np.column_stack([measured, np.ones(len(measured))])
        k1, k2, p1, p2, k3 = self.coefficients
        xy = measured
        for _ in range(ITERATIONS):
            r2 = (xy**2).sum(1)
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))  # [n]
            x, y = xy.T if self.model == "brown_conrady" else xy.T * radial
            bend = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x**2), 2 * p2 * x * y + p1 * (r2 + 2 * y**2)], 1)
            xy = (measured - bend) / radial[:, None]
        return np.column_stack([xy, np.ones(len(xy))])

    def agrees(self, other: "Intrinsics") -> bool:
        """Whether both can be the same camera; streams of another size say nothing."""
        if (self.width, self.height) != (other.width, other.height):
            return True
        mine, its = np.array([self.fx, self.fy, self.cx, self.cy]), np.array([other.fx, other.fy, other.cx, other.cy])
        return bool((abs(mine - its) <= SAME * self.fx).all())
