"""Where a camera stands: the file that `tools/calibrate_camera.py` writes and perception reads."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from envs.perception.base import Array, PerceptionError
from envs.perception.intrinsics import Intrinsics

FAR = 10.0  # [m] no camera stands further from the base; millimetres in the file do
REDO = "python -m tools.calibrate_camera makes one (see --help)"


def check_pose(pose: object, name: str) -> Array:
    """A rigid transform [4, 4], translation in m.

    Raises:
        ValueError: If it is none: what came and what a pose is.
    """
    try:
        array = np.asarray(pose, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be 4 x 4 numbers") from None
    if array.shape != (4, 4) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be 4 x 4 finite numbers, the shape is {array.shape}")
    rotation = array[:3, :3]
    off = abs(rotation @ rotation.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(rotation) < 0 or (array[3] != [0, 0, 0, 1]).any():
        raise ValueError(
            f"{name} is not a rigid transform: R R^T is off by {off:.2g}, det R = {np.linalg.det(rotation):.3f}"
        )
    return array


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """One camera's place.

    Attributes:
        serial: Serial number of the camera.
        intrinsics: Those of its colour stream when it was calibrated.
        base_T_camera: Pose of the colour camera (x right, y down, z forward) in the robot's base frame, [4, 4], m.
        residual_mm: Typical distance between where the tag was seen and where it should have been, [mm].
        pairs: How many views it was made from.

    Raises:
        ValueError: If the pose is not rigid or further than 10 m away.
    """

    serial: str
    intrinsics: Intrinsics
    base_T_camera: Array
    residual_mm: float
    pairs: int

    def __post_init__(self) -> None:
        pose = check_pose(self.base_T_camera, "base_T_camera")
        if np.linalg.norm(pose[:3, 3]) > FAR:
            raise ValueError(f"base_T_camera is {np.linalg.norm(pose[:3, 3]):.0f} m away; it must be in metres")
        object.__setattr__(self, "base_T_camera", pose)

    def to_json(self) -> str:
        values = asdict(self) | {"base_T_camera": self.base_T_camera.tolist()}
        return json.dumps(values, indent=1) + "\n"

    def check_camera(self, serial: str, intrinsics: Intrinsics) -> None:
        """Make sure that this is the file of a camera.

        Raises:
            PerceptionError: For another serial number, or a lens that has changed.
        """
        if serial != self.serial:
            raise PerceptionError(f"the calibration is of camera {self.serial}, this is {serial}; {REDO}.")
        if not intrinsics.agrees(self.intrinsics):
            raise PerceptionError(
                f"camera {serial} has fx={intrinsics.fx:.1f}, its calibration fx={self.intrinsics.fx:.1f}: it is not as"
                f" it was when calibrated; {REDO}."
            )


def load_calibration(path: str | Path) -> Calibration:
    """Read the file of one camera.

    Raises:
        PerceptionError: If it is missing, not readable or not a calibration: what is wrong and how to make one.
    """
    try:
        values = json.loads(Path(path).read_text())
        lens = values.pop("intrinsics")
        lens["coefficients"] = tuple(lens["coefficients"])
        return Calibration(intrinsics=Intrinsics(**lens), **values)
    except FileNotFoundError:
        raise PerceptionError(f"there is no calibration {path}; {REDO}.") from None
    except OSError as err:
        raise PerceptionError(f"cannot read the calibration {path}: {err.strerror}.") from err
    except KeyError as err:
        raise PerceptionError(f"{path} is not a calibration: {err} is missing; {REDO}.") from err
    except (ValueError, TypeError, AttributeError) as err:
        raise PerceptionError(f"{path} is not a calibration: {err}; {REDO}.") from err


def transform(pose: Array, points: Array) -> Array:
    """Points [n, 3] of one frame in another, whose pose [4, 4] is given."""
    return points @ pose[:3, :3].T + pose[:3, 3]
