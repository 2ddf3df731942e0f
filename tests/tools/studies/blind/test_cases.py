"""Cases come from the seed alone, their sizes from the noise, and their labels cannot be changed unseen."""

from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tools.studies.blind import cases
from tools.studies.blind.detect import detectable
from tools.studies.blind.draw import SHARES, draw
from tools.studies.blind.library import LIBRARY, OUTSIDE, SITES, equivalents
from tools.studies.blind.make import make


def test_shares_of_300_cases_and_enough_without_effect() -> None:
    counts = Counter(c.group for c in draw(5, 300))
    assert {g: counts[g] for g in SHARES} == {"single": 135, "pair": 60, "none": 45, "outside": 36, "ambiguous": 24}
    assert Counter(c.group for c in draw(5, 300, 100))["none"] == 100
    wrong = [bool(c.wrong) for c in draw(5, 300) if c.group == "none"]
    assert sum(wrong) == len(wrong) // 2


def test_a_seed_gives_the_same_cases_and_another_gives_others() -> None:
    assert draw(5, 40) == draw(5, 40)
    assert draw(5, 40) != draw(6, 40)


def test_every_effect_and_everything_outside_occurs() -> None:
    drawn = draw(1, 400)
    used = {e.name for c in drawn for e in c.effects}
    assert used >= {name for sites in SITES.values() for name in sites} | set(OUTSIDE)
    assert not {e.name for c in drawn if c.group in ("single", "pair") for e in c.effects} - set(LIBRARY)


def test_equivalents_follow_the_equations_of_motion() -> None:
    assert equivalents("slide", {"payload": 0}, False) == [["armature"]]
    assert equivalents("slide", {"actuator_offset": 0}, True) == []
    assert equivalents("pendulum", {"actuator_delay": 0, "viscous_friction": 0}, False) == [
        ["sensor_delay", "viscous_friction"]
    ]
    assert equivalents("arm", {"armature": 0}, False) == []
    assert equivalents("arm", {"sensor_offset": 0}, False) == [["gravity_tilt"]]
    assert equivalents("arm", {"sensor_offset": 1}, False) == []


def test_the_search_finds_where_the_change_equals_the_noise() -> None:
    found = detectable(
        lambda s: np.array([3 * s[0], 0.2 * s[1] ** 2, 1e-4 * s[2]]),
        guess=np.array([5.0, 0.5, 1.0]),
        largest=np.array([10.0, 10.0, 10.0]),
        smallest=np.zeros(3),
    )
    assert np.allclose(found[:2], [1 / 3, np.sqrt(5)], rtol=1e-2)
    assert np.isnan(found[2])


def test_data_are_reproducible_and_labels_are_sealed(tmp_path: Path) -> None:
    few = [c._replace(seconds=0.6) for c in draw(3, 60) if c.plant == "slide" and c.group == "single"][:1]
    first, second = make(few), make(few)
    for a, b in zip(first, second, strict=True):
        assert all(np.array_equal(x, b.episodes[0][k]) for k, x in a.episodes[0].items())
    assert cases.write(tmp_path / "a", first, 3) == cases.write(tmp_path / "b", second, 3)
    folder = tmp_path / "a/cases" / first[0].case.name
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    assert [model.joint(i).name for i in range(model.njnt)] == ["slide"]
    assert (folder / "episode_0.csv").read_text().startswith("time,ctrl/motor,qpos/slide")
    hidden = cases.labels(tmp_path / "a")
    assert hidden[first[0].case.name]["effects"][0]["multiple"] > 0
    text = (tmp_path / "a/labels.json").read_text()
    (tmp_path / "a/labels.json").write_text(text.replace('"single"', '"none"'))
    with pytest.raises(ValueError, match="hash"):
        cases.labels(tmp_path / "a")


def test_labels_have_the_same_hash_on_processors_that_round_differently(tmp_path: Path) -> None:
    def seal(size: float) -> str:
        return cases.seal(tmp_path, {"seed": 3, "cases": {"a": {"effects": [{"size": size, "at": ("motor",)}]}}})

    assert seal(0.123456789) == seal(0.123456788) != seal(0.123556789)
    assert cases.labels(tmp_path)["a"]["effects"] == [{"size": 0.12356, "at": ["motor"]}]
