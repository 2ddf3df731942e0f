"""A real machine with measured data: the screw axis EMPS, whose published friction is asymmetric."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.fit import change_of, fit
from mpc_sgft.diagnose.library import make_term
from mpc_sgft.diagnose.nominal import nominal_terms
from mpc_sgft.diagnose.plant import Plant
from mpc_sgft.diagnose.prepare import prepare, scales
from tools import emps


def test_asymmetric_viscous_and_coulomb_friction_predict_both_held_out_recordings(data_dir: Path) -> None:
    plant = Plant(mujoco.MjSpec.from_string(emps.SCENE))
    nominal = nominal_terms(plant, {"mass": 0.3})
    setup = prepare(plant, emps.thirds(data_dir), nominal, window=0.5, signals=None, held_out=["second", "pulses"])
    at = scales(plant, setup.problem.replayer)["joint", "x"]
    terms = [*nominal, *(make_term(plant, n, "x", at) for n in ("asymmetric_friction", "coulomb_friction"))]
    f = fit(setup.problem, terms, [*setup.baseline.values, *(t.starts[0] for t in terms[1:])], setup.fitted)
    replayer = setup.problem.replayer
    error = replayer.simulate([change_of(f.terms, f.values)])[0] - replayer.windows.measured
    first, second, pulses = (1e3 * np.sqrt((error[replayer.windows.episode == i] ** 2).mean()) for i in range(3))
    assert first < 0.30 and second < 0.30 and pulses < 0.56, (first, second, pulses)  # mm
    np.testing.assert_allclose(f.values[1], [166.7, 240.4], rtol=0.06)  # published, by another method
    np.testing.assert_allclose(f.values[2], 20.4, rtol=0.06)
    assert f.values[0][0] * 95 == pytest.approx(95.11, rel=0.03)


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
    half = emps.thirds(data_dir)[:1]
    emps.verdict(half, out=tmp_path, effects=["asymmetric_friction", "coulomb_friction"])
    again = emps.split_after_repair(data_dir, tmp_path / "again", tmp_path / "repaired.xml").as_dict()
    assert again["verdict"] == "none", again["reason"]
