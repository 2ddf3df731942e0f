import numpy as np
import pytest

pytest.importorskip("cv2", reason="needs the camera's packages")

from envs.perception.aruco import SQUARE, ArucoTag, tag_pose  # noqa: E402
from envs.perception.camera import Frame  # noqa: E402

SETTINGS = {"dictionary": "DICT_4X4_50", "tag": 7, "size": 0.04, "offset": (0.0, 0.0, -0.0155), "max_error": 1.0}


def test_a_drawn_tag_is_found_within_seven_millimetres(table):
    detector = ArucoTag(**SETTINGS)
    for camera, color in zip(table.cameras, table.color, strict=True):
        for k, puck in enumerate(table.pucks):
            found = detector.find(Frame(color[k], None, 0.0), table.lens, camera)
            assert found is not None and np.linalg.norm(found - puck) < 0.007, (k, found, puck)
            across = (found - puck) - (found - puck) @ camera[:3, 2] * camera[:3, 2]
            assert np.linalg.norm(across) < 0.001, (
                across
            )  # the error is one of distance: a tag's side is 30 pixels long


def test_the_offset_is_along_the_tags_own_axes(table):
    aside = ArucoTag(**SETTINGS | {"offset": (0.03, 0.0, 0.0)})  # the drawn tag lies along the base's axes
    found = aside.find(Frame(table.color[0][0], None, 0.0), table.lens, table.cameras[0])
    assert found is not None and np.linalg.norm(found - table.pucks[0] - [0.03, 0, 0.0155]) < 0.007


def test_nothing_is_found_where_the_tag_is_missing_doubled_or_another(table):
    camera = table.cameras[0]
    assert ArucoTag(**SETTINGS).find(Frame(table.color[0][3], None, 0.0), table.lens, camera) is None
    assert ArucoTag(**SETTINGS | {"tag": 8}).find(Frame(table.color[0][0], None, 0.0), table.lens, camera) is None
    doubled = table.color[0][0].copy()
    v, u = (int(x) for x in ArucoTag(**SETTINGS).corners(doubled).mean(0)[::-1])
    doubled[20:120, 20:120] = doubled[v - 50 : v + 50, u - 50 : u + 50]
    assert ArucoTag(**SETTINGS).find(Frame(doubled, None, 0.0), table.lens, camera) is None


def test_corners_that_are_no_square_are_refused(table):
    strict = ArucoTag(**SETTINGS | {"max_error": 1e-4})
    assert strict.find(Frame(table.color[0][0], None, 0.0), table.lens, table.cameras[0]) is None


@pytest.mark.parametrize("yaw", [0.0, 0.3])  # IPPE_SQUARE fails at 0
def test_pose_of_exact_corners(yaw):
    cos, sin = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    tilt, turn = (
        np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]),
        np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]),
    )
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ tilt @ turn
    pose[:3, 3] = [0.1, -0.05, 0.7]
    corners = (SQUARE * 0.05) @ pose[:3, :3].T + pose[:3, 3]
    found = tag_pose(corners / corners[:, 2:], 0.05)
    assert found is not None and abs(found.camera_T_tag - pose).max() < 1e-5 and found.error < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [({"dictionary": "4X4"}, "DICT_4X4_50"), ({"tag": 50}, "0 to 49"), ({"size": 0}, "must be positive")],
)
def test_wrong_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        ArucoTag(**SETTINGS | change)
