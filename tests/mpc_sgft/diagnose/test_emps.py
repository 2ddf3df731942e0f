"""A real machine with measured data: the screw axis EMPS, whose published friction is asymmetric."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.library import make_term
from mpc_sgft.diagnose.candidates.nominal import nominal_terms
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import change_of, fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import Setup, prepare, typical_sizes
from mpc_sgft.diagnose.simulation.plant import Plant
from tools.studies import emps


def _problem(data_dir: Path) -> tuple[Plant, Setup]:
    plant = Plant(mujoco.MjSpec.from_string(emps.SCENE))
    nominal = nominal_terms(plant, {"mass": 0.3})
    held_out = ["second", "pulses"]
    return plant, prepare(plant, emps.thirds(data_dir), nominal, window=0.5, signals=None, held_out=held_out)


def _fitted(plant: Plant, setup: Setup, *places: tuple[str, str, str]) -> Hypothesis:
    """Fit of the mass and of effects, each by name, kind of place and place."""
    at = typical_sizes(plant, setup.problem.replayer)
    terms = [make_term(plant, name, place, at[kind, place]) for name, kind, place in places]
    start = [*setup.baseline.values, *(t.starts[0] for t in terms)]
    return judge_fit(setup, fit(setup.problem, [*setup.baseline.terms, *terms], start, setup.fitted))


def test_asymmetric_viscous_and_coulomb_friction_predict_both_held_out_recordings(data_dir: Path) -> None:
    plant, setup = _problem(data_dir)
    f = _fitted(plant, setup, ("asymmetric_friction", "joint", "x"), ("coulomb_friction", "joint", "x")).fit
    replayer = setup.problem.replayer
    error = replayer.simulate([change_of(f.terms, f.values)])[0] - replayer.windows.measured
    first, second, pulses = (1e3 * np.sqrt((error[replayer.windows.episode == i] ** 2).mean()) for i in range(3))
    assert first < 0.30 and second < 0.30 and pulses < 0.56, (first, second, pulses)  # mm
    np.testing.assert_allclose(f.values[1], [166.7, 240.4], rtol=0.06)  # published, by another method
    np.testing.assert_allclose(f.values[2], 20.4, rtol=0.06)
    assert f.values[0][0] * 95 == pytest.approx(95.11, rel=0.03)


@pytest.mark.parametrize(("friction", "credible"), [("viscous_friction", True), ("asymmetric_friction", False)])
def test_an_offset_is_credible_only_where_the_asymmetry_is_left_out(
    data_dir: Path, friction: str, credible: bool
) -> None:
    plant, setup = _problem(data_dir)
    known = (friction, "joint", "x"), ("coulomb_friction", "joint", "x")
    without = _fitted(plant, setup, *known)
    beside = _fitted(plant, setup, *known, ("actuator_offset", "actuator", "motor"))
    rng = np.random.default_rng(0)
    assert judge.credible(without.errors, beside.errors, rng, setup.parts) == credible


@pytest.mark.slow
def test_the_verdict_is_asymmetric_friction_with_coulomb(data_dir: Path) -> None:
    report = emps.whole(data_dir)
    assert report.verdict == "effect", report.data["reason"]
    named = {e["name"] for e in report.data["effects"]}
    assert {"asymmetric_friction", "coulomb_friction"} <= named  # published, with an offset of a fortieth of Coulomb's
    assert named <= {"asymmetric_friction", "coulomb_friction", "actuator_offset"}  # no Stribeck, drag or delay
    left = emps.errors(report)
    assert left["second"] <= 0.30 and left["pulses"] <= 0.56, left  # mm
    assert report.data["held_out"]["low"] > 0.9


@pytest.mark.slow
def test_two_seconds_are_too_little_for_a_confident_name(data_dir: Path) -> None:
    report = emps.verdict([emps.read(data_dir, "DATA_EMPS", slice(0, emps.SHORT), "short")]).as_dict()
    weaker = {"viscous_friction", "coulomb_friction"}
    if report["verdict"] == "effect":
        named = {e["name"] for e in report["effects"]}
        assert named and named <= weaker
        assert all(p["low"] < p["value"] < p["high"] for e in report["effects"] for p in e["parameters"].values())
    else:
        assert report["verdict"] == "not_identifiable" and report["ties"] and report["next_experiment"]


@pytest.mark.slow
def test_nothing_is_left_after_the_repair(data_dir: Path, tmp_path: Path) -> None:
    emps.whole(data_dir, tmp_path)
    again = emps.split_after_repair(data_dir, tmp_path / "again", tmp_path / "repaired.xml").as_dict()
    assert again["verdict"] == "none", again["reason"]


@pytest.mark.slow
@pytest.mark.xfail(
    reason="the flexible model gains 7 % of the error with seed 0, 4 % with seeds 1 and 2; the bound is 5 %"
)
def test_nothing_is_left_after_a_repair_from_the_first_half_alone(data_dir: Path, tmp_path: Path) -> None:
    half = emps.thirds(data_dir)[:1]
    emps.verdict(half, out=tmp_path, effects=["asymmetric_friction", "coulomb_friction"])
    again = emps.split_after_repair(data_dir, tmp_path / "again", tmp_path / "repaired.xml").as_dict()
    assert again["verdict"] == "none", again["reason"]
