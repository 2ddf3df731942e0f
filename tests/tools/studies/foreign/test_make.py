"""Data of a foreign engine: flaws below what matters, what is hidden above it, labels sealed and the same again."""

import json
from pathlib import Path

import numpy as np
import pytest

from tools.studies.blind.cases import labels
from tools.studies.blind.draw import Given
from tools.studies.foreign import cases, make
from tools.studies.foreign.draw import Case, draw
from tools.studies.foreign.grounds import GROUND, MIX, TOLERANCE
from tools.studies.foreign.stiff import Stiff

WAYS = make.Ways(Stiff, {"slide": 1.0}, GROUND)
HALF = {"sign": 0.7, "ratio": 0.5, "speed": 0.5}


def case(effect: str, multiple: float = 5.0) -> Case:
    """A short recording of one effect on the slide."""
    first = next(c for c in draw(3, 40, {"slide": 1.0}, MIX) if c.group == "single")
    return first._replace(
        seconds=(1.5, 1.5), dt=0.005, noise=0, force_channel=False, effects=(Given(effect, 0, multiple, HALF),)
    )


@pytest.fixture(scope="module")
def made() -> make.Made:
    return make.make([case("payload")], ways=WAYS)[0]


def test_what_is_hidden_matters_and_no_flaw_does(made: make.Made) -> None:
    effect, flaws = made.truth[0], made.more["flaws"]
    assert effect["name"] == "payload" and effect["multiple"] == pytest.approx(5.0)
    assert effect["weight"] == pytest.approx(5.0, rel=0.2) and effect["left"] == pytest.approx(effect["weight"])
    assert 0.02 < max(f["moves"] for f in flaws) <= 0.25 + 1e-9
    assert {f["name"] for f in flaws} >= {"mass", "actuator_gain", "coulomb_friction", "actuator_delay"}


def test_names_that_are_one_term_of_the_equations_are_found_by_simulation(made: make.Made) -> None:
    assert "armature" in made.truth[0]["equal"]
    assert ["armature"] in cases.label(made)["equivalents"]


def test_a_turned_encoder_is_a_tilt_also_where_dry_friction_holds() -> None:
    """Where friction holds or does not is decided by little: both must be asked on the same data."""
    first = next(c for c in draw(4, 40, {"arm": 1.0}, MIX) if c.group == "single" and not c.swings)
    dry = first.nominal | {"dry": [1.3, 0.0]}
    turned = first._replace(seconds=(3.0,), dt=0.005, noise=1, force_channel=False, nominal=dry)
    turned = turned._replace(effects=(Given("sensor_offset", 0, 4.0, HALF),))
    assert make.make([turned], ways=WAYS)[0].truth[0]["equal"] == ["gravity_tilt"]


def test_where_forces_are_recorded_no_command_is_late_and_flaws_stay_below_the_border_there() -> None:
    """A force that is read as a command changes would show 50 us as a whole sample."""
    swung = make.make([case("payload")._replace(force_channel=True)], ways=WAYS)[0]
    late = [f for f in swung.more["flaws"] if f["name"] == "actuator_delay"]
    assert [f["size"] for f in late] == [0.0] and max(f["moves"] for f in swung.more["flaws"]) <= 0.25 + 1e-9
    assert "force/motor" in swung.episodes[0]


def test_a_flaw_that_shows_in_a_servos_force_is_smaller_where_that_is_recorded() -> None:
    first = next(c for c in draw(3, 40, {"servo": 1.0}, MIX) if c.group == "none")
    first = first._replace(seconds=(1.5,), dt=0.005, noise=0)

    def stretched(force: bool) -> float:
        made = make.make([first._replace(force_channel=force)], ways=WAYS)[0]
        return next(f["size"] for f in made.more["flaws"] if f["name"] == "sensor_gain")

    assert stretched(True) < 0.9 * stretched(False)


def test_another_effect_is_not_equal() -> None:
    assert make.make([case("coulomb_friction", 10.0)], ways=WAYS)[0].truth[0]["equal"] == []


def test_files_hold_what_a_user_has_and_the_label_is_sealed(made: make.Made, tmp_path: Path) -> None:
    cases.write(tmp_path, [made], 3, TOLERANCE)
    folder = tmp_path / "cases" / made.case.name
    assert json.loads((folder / "known.json").read_text()) == {"uncertain": {}, "tolerance": TOLERANCE}
    head, *rows = (folder / "episode_0.csv").read_text().splitlines()
    assert head.startswith("time,ctrl/motor,qpos/carriage") and len(rows) == 300
    assert "payload" not in (folder / "model.xml").read_text()
    text = (tmp_path / "labels.json").read_text()
    (tmp_path / "labels.json").write_text(text.replace('"single"', '"none"'))
    with pytest.raises(ValueError, match="hash"):
        labels(tmp_path)


def test_a_seed_reproduces_the_hash(made: make.Made, tmp_path: Path) -> None:
    again = make.make([case("payload")], ways=WAYS)
    assert all(np.array_equal(x, again[0].episodes[0][k]) for k, x in made.episodes[0].items())
    assert cases.write(tmp_path / "a", [made], 3, 0.01) == cases.write(tmp_path / "b", again, 3, 0.01)


def test_what_cannot_be_made_to_matter_is_drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = []

    def same(entropy: tuple[int, ...], group: str, scenes: dict, mix: object, attempt: int) -> Case:
        attempts.append(attempt)
        return case("payload")

    monkeypatch.setattr(make, "redraw", same)
    assert make.make([case("payload", 1e6)], ways=WAYS)[0].truth[0]["multiple"] == pytest.approx(5.0)
    assert attempts == [1]
