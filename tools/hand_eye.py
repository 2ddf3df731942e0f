"""Where a camera stands that watches the robot, from views of a tag on the robot's hand."""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from envs.perception.aruco import SQUARE, tag_pose
from envs.perception.base import Array

MIN_PAIRS = 6
MIN_TURN = np.radians(10)  # that the hand must turn about a second axis, else the camera's place is not determined


class HandEye(NamedTuple):
    """What the views say.

    Attributes:
        base_T_camera: [4, 4] m.
        hand_T_tag: Where the tag sits on the hand, [4, 4] m.
        residual: Between the tag's centre as seen and as the robot's pose says, of each view, [n] m.
        pixels: The same for the corners in the picture, root mean square of each view, on the plane z = 1, [n].
        position_sd: Standard deviation of the camera's position that the scatter of the corners implies, [3] m.
    """

    base_T_camera: Array
    hand_T_tag: Array
    residual: Array
    pixels: Array
    position_sd: Array


def solve(base_T_hand: Array, rays: Array, size: float) -> HandEye:
    """Find the camera's pose in the base's frame and the tag's on the hand.

        min  sum_ij rho(|project(camera_T_base base_T_hand_i hand_T_tag corner_j) - ray_ij|^2)

    Started from cv2.calibrateHandEye, which needs each tag's tilt; the sum uses the corners alone, so a tilt that was
    taken for its mirror image does no harm.

    Args:
        base_T_hand: Poses of the hand, [n, 4, 4] m.
        rays: Corners of the tag on the plane z = 1 of the camera's frame, [n, 4, 3].
        size: Length of a side of the tag's black square, [m].

    Raises:
        ValueError: For too few views, or a hand that hardly turned: what is needed.

    Source: Park & Martin, Robot sensor calibration: solving AX = XB on the Euclidean group, 1994, for the start.
    """
    n = len(base_T_hand)
    if n < MIN_PAIRS:
        raise ValueError(f"{n} views show the tag, {MIN_PAIRS} are needed and 15 to 20 are good")
    turns = Rotation.from_matrix(base_T_hand[:, :3, :3])
    spread = np.linalg.svd((turns * turns.mean().inv()).as_rotvec(), compute_uv=False) / np.sqrt(n)  # [3] rad
    if spread[1] < MIN_TURN / 2:  # a standard deviation: half of a turn to both sides
        raise ValueError(
            f"the hand turned by {np.degrees(2 * spread[1]):.1f} degrees about its second axis, at least"
            f" {np.degrees(MIN_TURN):.0f} are needed: tilt it about two different axes, by 20 degrees or more"
        )
    found = [tag_pose(r, size) for r in rays]
    if any(pose is None for pose in found):
        raise ValueError(f"the corners of view {found.index(None)} are no square in front of the camera")
    seen = np.stack([pose.camera_T_tag for pose in found if pose is not None])  # [n, 4, 4]
    hand_T_base = np.linalg.inv(base_T_hand)
    turn, shift = cv2.calibrateHandEye(
        hand_T_base[:, :3, :3], hand_T_base[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3], method=cv2.CALIB_HAND_EYE_PARK
    )
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = turn, shift[:, 0]
    tags = hand_T_base @ camera @ seen
    tag = np.eye(4)
    tag[:3, :3] = Rotation.from_matrix(tags[:, :3, :3]).mean().as_matrix()
    tag[:3, 3] = np.median(tags[:, :3, 3], axis=0)

    corners = np.column_stack([SQUARE * size, np.ones(4)])

    def miss(x: Array) -> Array:
        points = _pose(x[6:]) @ base_T_hand @ _pose(x[:6]) @ corners.T  # [n, 4, 4] m
        return np.swapaxes(points[:, :2] / points[:, 2:3], 1, 2) - rays[..., :2]  # [n, 4, 2]

    start = np.concatenate([_vector(tag), _vector(np.linalg.inv(camera))])
    scale = 1e-3  # on the plane z = 1: about half a pixel; more counts as an outlier and weighs less
    fit = least_squares(lambda x: miss(x).ravel(), start, loss="soft_l1", f_scale=scale, x_scale="jac")
    tag, camera = _pose(fit.x[:6]), np.linalg.inv(_pose(fit.x[6:]))
    expected = (np.linalg.inv(camera) @ base_T_hand @ tag)[:, :3, 3]
    errors = miss(fit.x)
    variance = (errors**2).sum() / (errors.size - 12)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)[6:, 6:] * variance
    return HandEye(
        camera,
        tag,
        np.linalg.norm(expected - seen[:, :3, 3], axis=1),
        np.sqrt((errors**2).sum(2).mean(1)),
        _position_sd(fit.x[6:], covariance),
    )


def _pose(x: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
    return pose


def _vector(pose: Array) -> Array:
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def _position_sd(camera_T_base: Array, covariance: Array) -> Array:
    """Of the camera's position in the base's frame, which is the inverse's translation; by finite differences."""
    step = 1e-6
    here = np.linalg.inv(_pose(camera_T_base))[:3, 3]
    jac = (
        np.stack([np.linalg.inv(_pose(camera_T_base + step * e))[:3, 3] - here for e in np.eye(6)], 1) / step
    )  # [3, 6]
    return np.sqrt(np.diag(jac @ covariance @ jac.T))
