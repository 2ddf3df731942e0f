"""Cases of the FR3 come from the seed alone, their effects are as large as the noise says, and they join the others."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tools.studies import blind_benchmark
from tools.studies.blind import cases, fr3_draw, fr3_make
from tools.studies.blind.draw import SHARES, Case, Given
from tools.studies.blind.library import OUTSIDE_SITES, SITES
from tools.studies.blind.plots import power
from tools.studies.blind.score import table

DRAW = fr3_draw.draw  # one test replaces it


def short(**change: object) -> Case:
    """A case of half a second without effect, changed."""
    plain = next(c for c in DRAW(3, 60) if c.group == "none" and not c.wrong)
    return plain._replace(seconds=0.6, noise=0, **change)


def test_shares_names_and_places() -> None:
    drawn = fr3_draw.draw(5, 100, first=300)
    assert {g: sum(c.group == g for c in drawn) for g in SHARES} == {g: round(100 * x) for g, x in SHARES.items()}
    assert [c.name for c in drawn] == [f"case_{i:04d}" for i in range(300, 400)]
    assert {e.name for c in drawn for e in c.effects} == {*SITES["fr3"], *OUTSIDE_SITES["fr3"]}
    wrong = [bool(c.wrong) for c in drawn if c.group == "none"]
    assert abs(2 * sum(wrong) - len(wrong)) <= 1
    assert drawn == fr3_draw.draw(5, 100, first=300) != fr3_draw.draw(6, 100, first=300)


@pytest.mark.parametrize("name", ["viscous_friction", "actuator_offset"])
def test_an_effect_of_five_detectable_sizes_changes_windows_by_five_noise_floors(name: str) -> None:
    given = Given(name, 1, 5.0, {"sign": 1.0, "ratio": 0.5, "speed": 0.5})
    bench = fr3_make._Bench(short(effects=(given,), group="single"))
    calm = [bench.run(bench.nominal, u, u[0], np.zeros(7)) for u in bench.episodes]
    scale = bench._scales(calm, given.joint)
    unit = bench.detectable(given, calm, scale)
    assert 4.0 < bench.change(given, 5 * unit, calm, scale) < 6.0
    assert 0.9 < bench.change(given, unit, calm, scale) < 1.1


def test_the_same_seed_makes_the_same_cases_in_the_format_of_the_others(tmp_path: Path) -> None:
    given = Given("coulomb_friction", 2, 4.0, {"sign": 1.0, "ratio": 0.5, "speed": 0.5})
    few = [short(effects=(given,), group="single", force_channel=True, speed_channel=True, jitter=True)]
    first, second = fr3_make.make(few), fr3_make.make(few)
    assert cases.write(tmp_path / "a", first, 3) == cases.write(tmp_path / "b", second, 3)
    for name in ("model.xml", "episode_0.csv", "known.json"):
        a, b = ((tmp_path / x / "cases" / few[0].name / name).read_text() for x in "ab")
        assert a == b
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "a/cases" / few[0].name / "model.xml"))
    assert (model.nv, model.nu, model.opt.timestep) == (7, 7, 0.002)
    columns = first[0].episodes[0]
    assert set(columns) == {"time"} | {
        f"{kind}/{part}{i}" for i in range(1, 8) for kind, part in
        (("ctrl", "position"), ("qpos", "joint"), ("qvel", "joint"), ("force", "position"))
    }  # fmt: skip
    assert {len(x) for x in columns.values()} == {150}
    label = cases.labels(tmp_path / "a")[few[0].name]
    assert label["plant"] == "fr3" and label["effects"][0]["at"] == ["joint3"]
    assert np.isclose(label["effects"][0]["multiple"], 4.0, rtol=1e-6)


def test_more_of_the_fr3_leave_the_others_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Real cases of both kinds, few and short; score and plots read them."""
    whole = blind_benchmark.draw

    def slides(seed: int, count: int, least_none: int = 0) -> list:
        return [c._replace(seconds=0.6) for c in whole(seed, 300) if c.plant == "slide" and c.group == "none"][:count]

    monkeypatch.setattr(blind_benchmark, "draw", slides)
    monkeypatch.setattr(
        fr3_draw, "draw", lambda seed, count, first: [short(name=f"case_{first:04d}", group="none")][:count]
    )
    line = ["--seed", "4", "--cases", "1", "--only", "generate", "--out"]
    assert blind_benchmark.main([*line, str(tmp_path / "few")]) == 0
    assert blind_benchmark.main([*line, str(tmp_path / "more"), "--fr3", "1"]) == 0
    few, more = cases.labels(tmp_path / "few"), cases.labels(tmp_path / "more")
    assert few.items() < more.items() and [y["plant"] for y in more.values()] == ["slide", "fr3"]
    for name in few:
        for path in (tmp_path / "few/cases" / name).iterdir():
            assert path.read_bytes() == (tmp_path / "more/cases" / name / path.name).read_bytes()
    said = {n: {"verdict": "none", "effects": [], "candidates": []} for n in more}
    assert {s.name: s.count for s in table(said, more)}["no effect: false alarms"] == 2
    assert json.loads((tmp_path / "more/labels.json").read_text())["seed"] == 4
    assert power(said, more, "plant") == {}
    assert blind_benchmark.main([*line, str(tmp_path / "more"), "--fr3", "0"]) == 2  # that folder holds another number
