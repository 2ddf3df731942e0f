import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra.utils import instantiate

from envs.perception.base import Detection, PerceptionError
from envs.perception.cameras import fuse
from mpc_sgft.command.errors import UserError, from_config

CONFIGS = Path(__file__).resolve().parents[3] / "configs/perception"


def seen(x: float, time: float) -> Detection:
    return Detection(np.array([x, 0.0, 0.0]), time)


def test_two_that_agree_give_the_mean_at_the_older_time():
    both = fuse([seen(0.50, 7.00), seen(0.51, 7.03)], window=0.1, agree=0.02)
    assert both is not None and both.time == 7.00 and abs(both.position[0] - 0.505) < 1e-12


def test_two_that_contradict_each_other_give_nothing():
    assert fuse([seen(0.5, 7.0), seen(0.6, 7.0)], window=0.1, agree=0.02) is None


def test_one_that_is_late_or_blind_has_no_say():
    for other in (None, seen(0.9, 6.0)):
        one = fuse([other, seen(0.5, 7.0)], window=0.1, agree=0.02)
        assert one is not None and one.time == 7.0 and one.position[0] == 0.5
    assert fuse([None, None], window=0.1, agree=0.02) is None


def make(name: str, **changes):
    """Perception with the numbers of configs/perception/<name>.yaml, built as the backend builds it."""
    numbers = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    assert numbers.pop("name") == name
    numbers["detector"] |= changes.pop("detector", {})
    clock = changes.pop("clock", time.monotonic)
    with from_config("perception"):
        return instantiate(numbers | changes, clock=clock, _convert_="all")


@pytest.mark.parametrize("name", ["aruco", "color"])
def test_two_replayed_cameras_follow_the_puck_and_lose_it(name, table, film, calibration):
    noise = np.random.default_rng(0)
    files, films, now = [], [], [0.0]
    for k in range(2):
        serial = f"{k + 20}"
        order = [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3] if name == "aruco" else [4, 4, 4, 5, 5, 5, 6, 6, 6, 3, 3, 3]
        depth = table.depth[k][order] + noise.normal(0, 0.001, (12, 480, 640))
        films.append(film(serial, table.color[k][order], depth))
        files.append(calibration(serial, table.cameras[k]))
    change = {"tag": 7, "size": 0.04} if name == "aruco" else {"low": [0.3, -0.4, 0.005], "high": [0.9, 0.4, 0.1]}
    perception = make(name, calibrations=files, recordings=films, detector=change, clock=lambda: now[0])
    found = []
    for now[0] in np.arange(12) / 30 + 0.01:
        found.append(perception.read())
    perception.close()
    times = [d.time for d in found if d is not None]
    assert times == sorted(times) and found[-1] is None  # the table is empty at the end
    hits = {min(range(3), key=lambda i: np.linalg.norm(d.position - table.pucks[i])) for d in found if d is not None}
    assert hits == {0, 1, 2}
    for d in found:
        assert d is None or min(np.linalg.norm(d.position[:2] - p[:2]) for p in table.pucks) < 0.008


def test_a_calibration_of_another_camera_is_refused(table, film, calibration):
    path = film("30", table.color[0], table.depth[0])
    with pytest.raises(PerceptionError, match="of camera 31, this is 30"):
        make("color", calibrations=[calibration("31", table.cameras[0])], recordings=[path])


def test_settings_that_do_not_fit_are_named(calibration):
    pytest.importorskip("cv2", reason="needs the camera's packages")
    one = calibration("40", np.eye(4))
    for changes, message in (
        ({"calibrations": []}, "a file of each camera"),
        ({"calibrations": [one], "recordings": ["a", "b"]}, "a file of each camera"),
        ({"calibrations": [one, one]}, "twice"),
        ({"calibrations": [one], "agree": 0.0}, "must be positive"),
    ):
        with pytest.raises(UserError, match=message):
            make("color", **changes)
    with pytest.raises(PerceptionError, match="there is no calibration"):
        make("color", calibrations=["none.json"])
