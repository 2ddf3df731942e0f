"""Names that leave the same trace are found, and those that do not are not."""

import numpy as np
import pytest

from tools.studies.blind.alike import rivals, separation
from tools.studies.blind.cases import instead
from tools.studies.blind.draw import Case, Given, draw
from tools.studies.blind.make import make
from tools.studies.blind.plants import PLANTS

HALF = {"sign": 0.7, "ratio": 0.5, "speed": 0.5}


def made(plant: str, effect: str, multiple: float = 6.0, force: bool = False, noise: int = 1) -> list[str]:
    first: Case = next(c for c in draw(3, 60) if c.group == "single" and c.plant == plant)
    hidden = (Given(effect, 0, multiple, HALF),)
    case = first._replace(effects=hidden, wrong={}, uncertain={}, force_channel=force, noise=noise, seconds=0.6)
    return make([case])[0].truth[0]["alike"]


def test_on_a_servo_a_stretched_encoder_is_a_stretched_command() -> None:
    assert made("pendulum", "sensor_gain") == ["actuator_gain"]


def test_a_measured_force_tells_a_command_from_a_sensor() -> None:
    assert "sensor_gain" in made("slide", "actuator_gain", 10.0, noise=2)
    assert "sensor_gain" not in made("slide", "actuator_gain", 10.0, force=True, noise=2)


def test_large_friction_has_a_trace_of_its_own() -> None:
    assert made("slide", "coulomb_friction", 10.0) == []


def test_separation_by_hand() -> None:
    rng = np.random.default_rng(0)
    rival, other, own = rng.normal(size=(3, 2, 50, 1))
    assert separation(2 * rival + other, rival, [other], signed=False) == pytest.approx(0.0, abs=1e-9)
    assert separation(-rival, rival, [], signed=True) == pytest.approx(0.0, abs=1e-9)
    assert separation(-rival, rival, [], signed=False) == pytest.approx(float(np.sqrt(np.mean(rival**2))))
    left = own - rival * (own * rival).sum() / (rival**2).sum()
    assert separation(own, rival, [], signed=True) == pytest.approx(float(np.sqrt(np.mean(left**2))))


def test_rivals_sit_where_they_may_and_sets_are_of_the_same_size() -> None:
    tilt = rivals(PLANTS["arm"], Given("gravity_tilt", 0, 2.0, HALF))
    assert {(r.name, r.joint) for r in tilt} == {(n, j) for n in ("actuator_offset", "sensor_offset") for j in (0, 1)}
    assert [r.name for r in rivals(PLANTS["cartpole"], Given("sensor_gain", 1, 2.0, HALF))] == ["armature", "payload"]
    assert instead([("a", ["b"]), ("c", ["b", "d"])]) == [["a", "b"], ["a", "d"], ["b", "c"], ["b", "d"]]
