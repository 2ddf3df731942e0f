import json

import numpy as np
import pytest

from envs.perception.base import PerceptionError
from envs.perception.calibration import Calibration, load_calibration
from envs.perception.intrinsics import MODELS, Intrinsics

LENS = Intrinsics(width=640, height=480, fx=610.0, fy=611.0, cx=322.0, cy=241.0)
POSE = np.array([[0.0, -1, 0, 0.9], [-1, 0, 0, -0.4], [0, 0, -1, 0.5], [0, 0, 0, 1]])
GOOD = Calibration(serial="123", intrinsics=LENS, base_T_camera=POSE, residual_mm=0.7, pairs=18)


def test_a_file_comes_back_as_it_was(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(GOOD.to_json())
    back = load_calibration(path)
    assert (back.base_T_camera == POSE).all() and back.intrinsics == LENS
    assert (back.serial, back.residual_mm, back.pairs) == ("123", 0.7, 18)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base_T_camera": (2 * POSE).tolist()}, "not a rigid transform"),
        ({"base_T_camera": (np.diag([1, 1, -1, 1]) @ POSE).tolist()}, "not a rigid transform"),
        ({"base_T_camera": [[1, 2], [3, 4]]}, "4 x 4"),
        ({"base_T_camera": "none"}, "4 x 4"),
        ({"base_T_camera": (POSE + np.eye(4)[:, [3]] * 0 + 900 * np.eye(4, k=3)).tolist()}, "in metres"),
        ({"intrinsics": {"width": 640}}, "coefficients"),
        ({"colour": 1}, "colour"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(json.loads(GOOD.to_json()) | change))
    with pytest.raises(PerceptionError, match=message) as caught:
        load_calibration(path)
    assert str(path) in str(caught.value) and "calibrate_camera" in str(caught.value)


def test_a_missing_or_broken_file_is_named(tmp_path):
    with pytest.raises(PerceptionError, match="there is no calibration"):
        load_calibration(tmp_path / "none.json")
    (tmp_path / "half.json").write_text(GOOD.to_json()[:40])
    with pytest.raises(PerceptionError, match="not a calibration"):
        load_calibration(tmp_path / "half.json")
    with pytest.raises(PerceptionError, match="cannot read"):
        load_calibration(tmp_path)


def test_another_camera_or_lens_is_refused():
    GOOD.check_camera("123", LENS)
    with pytest.raises(PerceptionError, match="of camera 123, this is 456"):
        GOOD.check_camera("456", LENS)
    with pytest.raises(PerceptionError, match="not as it was"):
        GOOD.check_camera("123", Intrinsics(width=640, height=480, fx=640.0, fy=611.0, cx=322.0, cy=241.0))
    GOOD.check_camera("123", Intrinsics(width=1280, height=720, fx=915.0, fy=916.0, cx=643.0, cy=361.0))


@pytest.mark.parametrize("model", MODELS)
def test_rays_are_those_of_librealsense(model):
    rs = pytest.importorskip("pyrealsense2", reason="needs the camera's packages", exc_type=ImportError)
    bend = (0.12, -0.25, 0.001, -0.0006, 0.08) if model != "none" else (0.0,) * 5
    mine = Intrinsics(width=640, height=480, fx=610.0, fy=611.0, cx=322.0, cy=241.0, model=model, coefficients=bend)
    its = rs.intrinsics()
    its.width, its.height, its.fx, its.fy, its.ppx, its.ppy = 640, 480, 610.0, 611.0, 322.0, 241.0
    its.model, its.coeffs = getattr(rs.distortion, model), list(bend)
    pixels = np.array([[0.0, 0], [639, 479], [100, 400], [322, 241], [500, 20]])
    expected = [rs.rs2_deproject_pixel_to_point(its, list(p), 1.0) for p in pixels]
    assert abs(mine.rays(pixels) - expected).max() < 1e-5


@pytest.mark.parametrize("change", [{"model": "ftheta"}, {"fx": 0.0}, {"coefficients": (0.0,)}, {"cx": float("nan")}])
def test_an_impossible_lens_is_refused(change):
    good = {"width": 640, "height": 480, "fx": 610.0, "fy": 611.0, "cx": 322.0, "cy": 241.0}
    with pytest.raises(ValueError):
        Intrinsics(**good | change)
