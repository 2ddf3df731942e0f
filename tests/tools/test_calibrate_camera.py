import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

cv2 = pytest.importorskip("cv2", reason="needs the camera's packages")

from envs.perception.calibration import load_calibration  # noqa: E402
from tools.calibrate_camera import main  # noqa: E402

SIZE, NUMBER = 0.06, 7
FOCAL = 240 / np.tan(np.radians(22.5))
LENS = {"width": 640, "height": 480, "fx": FOCAL, "fy": FOCAL, "cx": 319.5, "cy": 239.5}
DOWN = np.diag([1.0, -1.0, -1.0])


def pose(rotation: np.ndarray, position: list[float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, position
    return out


# A camera in front of the robot, 0.7 m from where its hand shows it the tag.
CAMERA = pose(np.array([[0.0, 0.34, -0.94], [1, 0, 0], [0, -0.94, -0.34]]), [1.2, 0.05, 0.65])
U, _, V = np.linalg.svd(CAMERA[:3, :3])
CAMERA[:3, :3] = U @ V
TAG = pose(Rotation.from_euler("xyz", [4, 91, 12], degrees=True).as_matrix(), [0.03, -0.01, 0.05])  # on the hand


def hands(n: int, tilt: float = 25.0) -> list[np.ndarray]:
    """Poses of the hand that show the tag to the camera, tilted by up to so many degrees about each axis."""
    rng = np.random.default_rng(1)
    out = []
    for _ in range(n):
        turn = CAMERA[:3, :3] @ DOWN @ Rotation.from_euler("xyz", rng.uniform(-tilt, tilt, 3), degrees=True).as_matrix()
        place = CAMERA @ [*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.5, 0.75), 1]
        out.append(pose(turn, place[:3]) @ np.linalg.inv(TAG))
    return out


def write(folder, pairs) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "pairs.json").write_text(json.dumps({"serial": "77", "intrinsics": LENS, "pairs": pairs}))
    return str(folder)


def exact(poses) -> list[dict]:
    return [{"base_T_hand": h.tolist(), "camera_T_tag": (np.linalg.inv(CAMERA) @ h @ TAG).tolist()} for h in poses]


def run(folder, out, *more) -> int:
    return main(["solve", folder, "--out", str(out), "--size", str(SIZE), "--tag", str(NUMBER), *more])


def test_exact_poses_give_the_camera_exactly(tmp_path, capsys):
    out = tmp_path / "new" / "front.json"
    assert run(write(tmp_path / "pairs", exact(hands(8))), out) == 0
    made = load_calibration(out)
    assert abs(made.base_T_camera - CAMERA).max() < 1e-6 and made.serial == "77" and made.pairs == 8
    assert "residual: median 0.00 mm" in capsys.readouterr().out


def test_drawn_pictures_give_the_camera_within_millimetres(tmp_path, render, capsys):
    poses = hands(10)
    color, _ = render(
        [{"camera": CAMERA, "tag": h @ TAG} for h in poses], size=[640, 480], fovy=45.0, tag_size=SIZE, number=NUMBER
    )
    folder, pairs = tmp_path / "pairs", []
    folder.mkdir()
    for k, (hand, picture) in enumerate(zip(poses, color, strict=True)):
        cv2.imwrite(str(folder / f"{k}.png"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        pairs.append({"base_T_hand": hand.tolist(), "image": f"{k}.png"})
    cv2.imwrite(str(folder / "empty.png"), np.zeros((480, 640, 3), np.uint8))
    pairs.append({"base_T_hand": poses[0].tolist(), "image": "empty.png"})
    assert run(write(folder, pairs), tmp_path / "front.json") == 0
    said, made = capsys.readouterr().out, load_calibration(tmp_path / "front.json")
    assert "pair 10: tag 7 is not seen" in said and made.pairs == 10
    off = np.linalg.norm(made.base_T_camera[:3, 3] - CAMERA[:3, 3])
    turned = Rotation.from_matrix(made.base_T_camera[:3, :3].T @ CAMERA[:3, :3]).magnitude()
    print(said, f"camera off by {1000 * off:.2f} mm, {np.degrees(turned):.3f} degrees")
    assert off < 0.001 and np.degrees(turned) < 0.1
    found = re.search(r"median ([\d.]+) mm", said)
    assert found is not None and 0 < float(found[1]) < 4


def test_what_the_pairs_cannot_tell_is_said_and_nothing_written(tmp_path, capsys):
    broken = exact(hands(8))
    broken[0]["base_T_hand"][0][0] = 7.0
    wrong = exact(hands(10))
    for k, pair in enumerate(wrong):
        pair["base_T_hand"][0][3] += 0.1 * (-1) ** k
    flat = [
        pose(CAMERA[:3, :3] @ DOWN, (CAMERA @ [0.01 * k, 0.02 * k, 0.6, 1])[:3]) @ np.linalg.inv(TAG) for k in range(8)
    ]
    cases = [
        (exact(hands(3)), "6 are needed"),
        (exact(flat), "tilt it about two different axes"),
        (broken, "base_T_hand of pair 0 is not a rigid transform"),
        (wrong, "contradict each other"),
        ([{"base_T_hand": np.eye(4).tolist(), "image": "none.png"}], "cannot be read"),
        ([{"image": "none.png"}], "'base_T_hand' is missing"),
    ]
    for k, (pairs, message) in enumerate(cases):
        out = tmp_path / f"{k}.json"
        assert run(write(tmp_path / f"{k}", pairs), out) == 2, message
        said = capsys.readouterr().err
        assert message in said and "Traceback" not in said and not out.exists(), said
    assert run(str(tmp_path / "nowhere"), tmp_path / "x.json") == 2 and "there is no" in capsys.readouterr().err
    assert run(write(tmp_path / "t", exact(hands(8))), tmp_path / "x.json", "--dictionary", "X") == 2
