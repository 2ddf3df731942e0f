"""Imperfections stay below what matters, and effects are hidden above it."""

import numpy as np
import pytest

from tools.studies.blind.cases import label
from tools.studies.blind.draw import Case, Given, Mix, draw
from tools.studies.blind.flaws import SMALL, Flaw, below, beside, draw_flaws, put
from tools.studies.blind.made import Ground, Made
from tools.studies.blind.make import make
from tools.studies.blind.plants import PLANTS
from tools.studies.blind.truths import rows

SLIDE = PLANTS["slide"]
SCALES = [{"F": 10.0, "V": 0.5, "Q": 0.2, "U": 1.0}]
SIZES = (3.0, 20.0)


def test_flaws_are_of_everything_everywhere_and_in_its_units() -> None:
    drawn = draw_flaws(PLANTS["cartpole"], SCALES * 2, np.random.default_rng(0))
    assert {f.name for f in drawn} == {"actuator_lag" if k == "late" else k for k in SMALL}
    assert [f.joint for f in drawn if f.name == "viscous_friction"] == [0, 1]
    assert [f.joint for f in drawn if f.name == "actuator_gain"] == [0]
    many = [
        f.size for k in range(50) for f in draw_flaws(SLIDE, SCALES, np.random.default_rng(k)) if "viscous" in f.name
    ]
    assert 0.02 <= min(many) and 0.05 < max(many) <= 0.06  # 0.1 to 0.3 % of 10 N at 0.5 m/s


def test_commands_are_not_late_where_forces_are_read_at_the_instant_they_change() -> None:
    late = [f.size for f in draw_flaws(SLIDE, SCALES, np.random.default_rng(0), force=True) if "lag" in f.name]
    assert late == [0.0]


def test_a_heavier_body_and_a_weaker_drive() -> None:
    p = rows(SLIDE, {"m": 3.0, "armature": [1.0], "damping": [2.0], "dry": [0.0], "gear": [10.0], "limit": [1e9]}, 2)
    more, less = {"sign": 1.0}, {"sign": 0.0}
    put([Flaw("mass", 0, 0.003, more), Flaw("actuator_gain", 0, 0.002, less)], p, np.array([1]), SCALES)
    assert p["m"].tolist() == [3.0, pytest.approx(3.009)]
    assert p["gain"][:, 0].tolist() == [1.0, pytest.approx(0.998)]


def test_nothing_adds_to_what_the_label_gives_a_size() -> None:
    hidden = (Given("asymmetric_friction", 1, 4.0, {}), Given("actuator_offset", 0, 4.0, {}))
    drawn = draw_flaws(PLANTS["cartpole"], SCALES * 2, np.random.default_rng(0))
    gone = {(f.name, f.joint) for f in beside(drawn, hidden) if f.size == 0.0}
    assert gone == {("viscous_friction", 1), ("actuator_offset", 0)}


def test_flaws_shrink_until_each_and_all_are_small() -> None:
    def flaws(*sizes: float) -> list[Flaw]:
        return [Flaw("viscous_friction", 0, x, {}) for x in sizes]

    def moves(chosen: list[list[Flaw]]) -> np.ndarray:
        return np.array([sum(f.size for f in case) for case in chosen])

    found, moved = below([flaws(0.1, 0.2, 0.1), flaws(0.5, 0.25, 0.5)], moves)
    assert [f.size for f in found[0]] == pytest.approx([0.1, 0.2, 0.1])
    assert [f.size for f in found[1]] == pytest.approx([0.5 / 3] * 3)  # a quarter each, then half together
    assert moved.tolist() == [pytest.approx([f.size for f in case]) for case in found]


@pytest.fixture(scope="module")
def made() -> list[Made]:
    first: Case = next(c for c in draw(3, 60) if c.group == "single" and c.plant == "slide" and not c.wrong)
    hidden = (Given("viscous_friction", 0, 4.0, {"sign": 0.7, "ratio": 0.5, "speed": 0.5}),)
    first = first._replace(effects=hidden, seconds=2.0, noise=0, force_channel=False)
    return make([first], ground=Ground(Mix({"single": 1.0}, SIZES, SIZES, SIZES), 0.01))


def test_each_flaw_moves_predictions_by_less_than_a_quarter_of_what_matters(made: list[Made]) -> None:
    moves = [f["moves"] for f in label(made[0])["flaws"]]
    assert len(moves) == len(SMALL) and 0.02 < max(moves) <= 0.25 + 1e-9


def test_what_is_hidden_moves_them_by_several_times_as_much(made: list[Made]) -> None:
    effect = label(made[0])["effects"][0]
    assert effect["multiple"] == pytest.approx(4.0)
    assert effect["weight"] == pytest.approx(4.0, rel=0.15)  # of 1 % of the motion, or of the noise if that is more
    assert effect["left"] == pytest.approx(effect["weight"])
