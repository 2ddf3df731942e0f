import numpy as np
import pytest

pytest.importorskip("cv2", reason="needs the camera's packages")

from envs.perception.camera import Frame  # noqa: E402
from envs.perception.color import ColorBlob  # noqa: E402

SETTINGS = {
    "hsv_low": (170, 120, 60),
    "hsv_high": (10, 255, 255),  # through red
    "low": (0.3, -0.4, 0.005),
    "high": (0.9, 0.4, 0.1),
    "top": 0.006,
    "min_pixels": 100,
    "offset": (0.0, 0.0, -0.015),
}


@pytest.fixture(scope="module")
def red(render):
    """A camera, its lens, and frames of one puck, of two, and of none; depth with 1 mm of noise."""
    from envs.perception.intrinsics import Intrinsics

    focal = 240 / np.tan(np.radians(22.5))
    lens = Intrinsics(width=640, height=480, fx=focal, fy=focal, cx=319.5, cy=239.5)
    camera = np.eye(4)
    z = np.array([-0.4, 0.4, -0.55]) / np.linalg.norm([-0.4, 0.4, -0.55])
    x = np.cross(z, [0, 0, 1.0]) / np.linalg.norm(np.cross(z, [0, 0, 1.0]))
    camera[:3, :3], camera[:3, 3] = np.stack([x, np.cross(z, x), z], 1), [0.9, -0.4, 0.55]
    one, other = np.eye(4), np.eye(4)
    one[:3, 3], other[:3, 3] = [0.55, 0.05, 0.015], [0.62, -0.2, 0.015]
    shots = [{"camera": camera, "puck": one}, {"camera": camera, "puck": one, "other": other}, {"camera": camera}]
    color, depth = render(shots, size=[640, 480], fovy=45.0, tag_size=0.04, number=7)
    depth = depth + np.random.default_rng(0).normal(0, 0.001, depth.shape)
    return camera, lens, [Frame(c, d, 0.0) for c, d in zip(color, depth, strict=True)], one[:3, 3]


def test_a_red_puck_is_found_within_five_millimetres(red):
    camera, lens, frames, puck = red
    found = ColorBlob(**SETTINGS).find(frames[0], lens, camera)
    assert found is not None and np.linalg.norm(found - puck) < 0.005, found - puck


def hidden(frame: Frame, lens, camera, puck, cut) -> Frame:
    """A frame in which something grey covers points of the puck of which `cut(x, y)`, from its centre, is true."""
    v, u = np.nonzero(frame.depth > 0)
    rays = lens.rays(np.column_stack([u, v]).astype(float)) * frame.depth[v, u, None]
    x, y = (rays @ camera[:3, :3].T + camera[:3, 3] - puck)[:, :2].T
    color = frame.color.copy()
    covered = cut(x, y)
    color[v[covered], u[covered]] = 128
    return frame._replace(color=color)


@pytest.mark.parametrize(
    "cut",
    [lambda x, y: x > 0.01, lambda x, y: y < -0.01, lambda x, y: x + y > 0.014, lambda x, y: abs(y - 0.003) < 0.01],
    ids=["side", "front", "corner", "a bar across"],
)
def test_a_puck_of_which_a_part_is_hidden_is_not_taken_for_a_whole_one(red, cut):
    camera, lens, frames, puck = red
    seen = ColorBlob(**SETTINGS | {"diameter": 0.05}).find(frames[0], lens, camera)
    assert seen is not None and np.linalg.norm(seen - puck) < 0.005
    part = hidden(frames[0], lens, camera, puck, cut)
    any_size = ColorBlob(**SETTINGS).find(part, lens, camera)
    assert any_size is not None and np.linalg.norm(any_size - puck) > 0.005, "where the middle of the rest is"
    assert ColorBlob(**SETTINGS | {"diameter": 0.05}).find(part, lens, camera) is None


def test_what_is_outside_the_box_does_not_count(red):
    camera, lens, frames, puck = red  # the other puck is nearer and so larger in the picture
    box = {"low": (0.3, -0.1, 0.005), "high": (0.9, 0.4, 0.1)}
    found = ColorBlob(**SETTINGS | box).find(frames[1], lens, camera)
    assert found is not None and np.linalg.norm(found - puck) < 0.005
    both = ColorBlob(**SETTINGS).find(frames[1], lens, camera)
    assert both is not None and np.linalg.norm(both - puck) > 0.2


def test_no_puck_no_depth_or_another_colour_is_none(red):
    camera, lens, frames, _ = red
    assert ColorBlob(**SETTINGS).find(frames[2], lens, camera) is None
    blind = frames[0]._replace(depth=np.zeros((480, 640)))
    assert ColorBlob(**SETTINGS).find(blind, lens, camera) is None
    assert (
        ColorBlob(**SETTINGS | {"hsv_low": (50, 120, 60), "hsv_high": (70, 255, 255)}).find(frames[0], lens, camera)
        is None
    )
    assert ColorBlob(**SETTINGS | {"min_pixels": 10_000}).find(frames[0], lens, camera) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hsv_high": (200, 255, 255)}, "within"),
        ({"hsv_low": (170, 120)}, "three numbers"),
        ({"hsv_low": (0, 200, 0), "hsv_high": (10, 100, 255)}, "must not exceed"),
        ({"low": (0.9, 0, 0), "high": (0.3, 1, 1)}, "inside out"),
        ({"top": 0.0}, "must be positive"),
        ({"diameter": 0.0}, "diameter=0.0 m must be positive"),
    ],
)
def test_wrong_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        ColorBlob(**SETTINGS | change)
