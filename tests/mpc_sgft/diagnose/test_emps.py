"""A real machine with measured data: the screw axis EMPS, whose published friction is asymmetric."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.io import loadmat

from mpc_sgft.diagnose.fit import change_of, fit
from mpc_sgft.diagnose.library import make_term
from mpc_sgft.diagnose.nominal import nominal_terms
from mpc_sgft.diagnose.plant import Plant
from mpc_sgft.diagnose.prepare import prepare, scales
from mpc_sgft.diagnose.record import Episode

EMPS = """<mujoco><option timestep="0.001"/><worldbody><body name="carriage">
<joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="95"/></body></worldbody>
<actuator><motor name="motor" joint="x" gear="35.15"/></actuator></mujoco>"""
HALF = 12420  # samples, 12.42 s


def read(folder: Path, name: str, part: slice, called: str) -> Episode:
    data = loadmat(folder / "emps" / f"{name}.mat")
    q = np.asarray(data["qm"], float).ravel()[part]
    return Episode(called, 0.001, np.asarray(data["vir"], float).reshape(-1, 1)[part], {"qpos/x": q})


def thirds(folder: Path) -> list[Episode]:
    return [
        read(folder, "DATA_EMPS", slice(0, HALF), "first"),
        read(folder, "DATA_EMPS", slice(HALF, None), "second"),
        read(folder, "DATA_EMPS_PULSES", slice(None), "pulses"),
    ]


def test_asymmetric_viscous_and_coulomb_friction_predict_both_held_out_recordings(data_dir: Path) -> None:
    plant = Plant(mujoco.MjSpec.from_string(EMPS))
    nominal = nominal_terms(plant, {"mass": 0.3})
    setup = prepare(plant, thirds(data_dir), nominal, window=0.5, signals=None, held_out=["second", "pulses"])
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


def _verdict(folder: Path, episodes: list[Episode], spec: mujoco.MjSpec | None = None, **options: object) -> dict:
    from mpc_sgft.diagnose.run import run

    given = {"out": None, "effects": None, "signals": None, "window": None, "held_out": None, "seed": 0}
    given |= {"uncertain": {"mass": 0.3}, "max_effects": 3, "progress": False} | options
    return run(Plant(spec or mujoco.MjSpec.from_string(EMPS)), episodes, **given).as_dict()  # pyright: ignore


@pytest.mark.slow
def test_the_verdict_is_asymmetric_friction_with_coulomb(data_dir: Path) -> None:
    report = _verdict(data_dir, thirds(data_dir), held_out=["second", "pulses"], window=0.5)
    assert report["verdict"] == "effect", report["reason"]
    assert {"asymmetric_friction", "coulomb_friction"} <= {e["name"] for e in report["effects"]}
    wrong = {"stribeck_friction", "quadratic_drag", "actuator_delay"}
    assert not wrong & {e["name"] for e in report["effects"]}
    assert report["held_out"]["low"] > 0.9


@pytest.mark.slow
def test_two_seconds_are_too_little_for_a_confident_name(data_dir: Path) -> None:
    report = _verdict(data_dir, [read(data_dir, "DATA_EMPS", slice(0, 2000), "short")])
    known = {"viscous_friction", "coulomb_friction"}
    assert report["verdict"] == "not_identifiable" or {e["name"] for e in report["effects"]} <= known
    if report["verdict"] == "not_identifiable":
        assert report["ties"] and report["next_experiment"]


@pytest.mark.slow
def test_nothing_is_left_after_the_repair(data_dir: Path, tmp_path: Path) -> None:
    whole = [read(data_dir, "DATA_EMPS", slice(0, HALF), "first")]
    _verdict(data_dir, whole, out=tmp_path, effects=["asymmetric_friction", "coulomb_friction"])
    repaired = mujoco.MjSpec.from_file(str(tmp_path / "repaired.xml"))
    again = _verdict(data_dir, thirds(data_dir)[:2], repaired, held_out=["second"], uncertain={"mass": 0.05})
    assert again["verdict"] == "none", again["reason"]
