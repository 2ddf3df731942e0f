"""What is there and does not matter is a trace: it is no name, no tie, no repair."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.verdict.relevance import Repairs, repairs
from mpc_sgft.diagnose.verdict.repair import into
from mpc_sgft.diagnose.verdict.tolerance import Tolerance, limits_of, parse_tolerance, spread_of

FEW = ["viscous_friction", "coulomb_friction", "quadratic_drag", "actuator_offset"]
Record = Callable[..., Path]


def test_a_trace_beside_the_cause_is_listed_and_not_named(
    slide: Path, record: Record, tmp_path: Path, check_report: Callable[[dict], None]
) -> None:
    data = record(coulomb=2.0, viscous=0.01, extra=lambda q, v: 0.01)
    report = diagnose(slide, [data], effects=FEW, out=tmp_path / "plain").as_dict()
    check_report(report)
    (effect,) = report["effects"]
    assert report["verdict"] == "effect" and effect["name"] == "coulomb_friction", report["reason"]
    assert effect["share"]["value"] > 0.9 and effect["changes"][0]["signal"] == "qpos/x"
    assert report["traces"] and {t["name"] for t in report["traces"]} <= {"viscous_friction", "actuator_offset"}
    assert all(t["share"]["value"] < 0.01 for t in report["traces"])
    assert list(yaml.safe_load((tmp_path / "plain" / "effects.yaml").read_text())["effects"]) == ["coulomb_friction"]
    whole = diagnose(slide, [data], effects=FEW, out=tmp_path / "whole", traces=True).as_dict()
    held = yaml.safe_load((tmp_path / "whole" / "effects.yaml").read_text())["effects"]
    assert set(held) == {"coulomb_friction", *(t["name"] for t in report["traces"])}
    assert whole["held_out"]["repaired"] < report["held_out"]["repaired"]


def test_within_the_tolerance_nothing_is_missing(slide: Path, record: Record, tmp_path: Path) -> None:
    out, data = tmp_path / "out", record(coulomb=0.1)
    given = ["--model", str(slide), "--data", str(data), "--out", str(out), "--effects", ",".join(FEW)]
    assert main(given) == 0
    strict = json.loads((out / "report.json").read_text())
    assert strict["verdict"] == "effect" and strict["effects_file"] == "effects.yaml", strict["reason"]
    off = strict["held_out"]["nominal"]
    assert main([*given, "--tolerance", f"qpos/x={4 * 1000 * off:g}mm"]) == 0
    loose = json.loads((out / "report.json").read_text())
    assert loose["verdict"] == "none" and "within the tolerance" in loose["reason"] and not loose["effects"]
    assert [t["name"] for t in loose["traces"]] == ["coulomb_friction"]
    assert loose["effects_file"] is None and not (out / "repaired.xml").exists() and not (out / "effects.yaml").exists()


def test_a_simpler_effect_stands_in_within_the_tolerance_alone(slide: Path, record: Record) -> None:
    """Friction that falls as it starts to slide: Coulomb's alone leaves 3 of 47 mm, 0.4 % of the squared error."""
    data = record(seconds=8.0, coulomb=3.0, extra=lambda q, v: -2.0 * np.exp(-((v / 0.1) ** 2)) * np.sign(v))
    for tolerance, name in ((0.002, "stribeck_friction"), (0.01, "coulomb_friction")):  # 1.3 and 6.4 mm
        effects = ["coulomb_friction", "stribeck_friction"]
        report = diagnose(slide, [data], effects=effects, tolerance=tolerance).as_dict()
        assert [e["name"] for e in report["effects"]] == [name], (tolerance, report["reason"])


def test_what_is_tolerated_is_little_evidence_between_names(slide: Path, record: Record) -> None:
    """A load, more friction than the model knows, and a force that nobody names: the first two look like a weak motor.

    What tells load and motor apart is less than what is tolerated, and what neither explains is as much.
    """
    slide.write_text(slide.read_text().replace('axis="1 0 0"/>', 'axis="1 0 0" damping="2"/>'))
    data = record(seconds=8.0, mass=5.5, viscous=2.16, extra=lambda q, v: 0.3 * np.sin(5 * np.pi * q))
    effects = ["payload", "actuator_gain"]
    strict, loose = (diagnose(slide, [data], effects=effects, tolerance=t).as_dict() for t in (None, 0.01))
    assert strict["verdict"] == "effect" and strict["effects"][0]["name"] == "actuator_gain", strict["reason"]
    assert loose["verdict"] == "not_identifiable" and loose["ties"][0]["effects"] == ["payload@cart"], loose["reason"]


@pytest.mark.parametrize(("tolerance", "verdict"), [("40mm", "unknown"), ("50mm", "none")])
def test_an_error_that_nothing_explains_is_unknown_from_the_tolerance_on(
    slide: Path, record: Record, tolerance: str, verdict: str
) -> None:
    """A force that nobody names moves the slide by 46 mm, root mean square."""
    data = record(seconds=8.0, extra=lambda q, v: 3.0 * np.sin(5 * np.pi * q))
    report = diagnose(slide, [data], effects=["actuator_offset"], tolerance={"qpos/x": tolerance}).as_dict()
    assert report["verdict"] == verdict, report["reason"]


def test_noise_beyond_a_tolerance_is_nothing_unknown(slide: Path, record: Record) -> None:
    """Ten times the tolerance; what windows scatter around it is no sign of something that is missing."""
    for seed in range(4):
        data = record(name=f"seed{seed}", seconds=4.0, noise=1e-3, seed=seed)
        report = diagnose(slide, [data], effects=["actuator_offset"], tolerance={"qpos/x": "0.1mm"}).as_dict()
        assert report["verdict"] == "none", (seed, report["reason"])


def test_a_repair_that_does_not_repair_is_not_written(slide: Path, record: Record, tmp_path: Path) -> None:
    """Friction that came only after what is held out cannot be seen there."""
    still = record(name="b", seconds=2.0)
    rubbed = record(name="a", seconds=10.0, coulomb=2.0)
    report = diagnose(
        slide, [rubbed, still], effects=["coulomb_friction"], held_out=["b"], out=tmp_path / "out"
    ).as_dict()
    assert report["effects_file"] is None and not (tmp_path / "out" / "repaired.xml").exists()
    told = f"errors on the {report['held_out']['windows']} windows that were never fitted do not credibly fall"
    assert any("no repaired.xml" in n and told in n for n in report["notes"]), report["notes"]


def test_a_repair_that_does_not_load_is_a_note(tmp_path: Path) -> None:
    held = SimpleNamespace(names=["a"], fit=SimpleNamespace(terms=[object()]))
    row = {"signal": "qpos/x", "nominal": 1.0, "repaired": 0.1, "unit": "m"}
    data: dict[str, Any] = {"held_out": row, "verdict": "effect", "notes": [], "repaired_model": None}

    def write() -> list[str]:
        (tmp_path / "repaired.xml").write_text("<mujoco>")
        raise ValueError("Error opening file 'gone.obj'")

    into(tmp_path, data, held, Repairs(True, "all"), write)  # type: ignore[arg-type]
    assert data["repaired_model"] is None and not list(tmp_path.iterdir())
    (note,) = data["notes"]
    assert note.startswith("no repaired.xml: the scene with a in it does not load") and "gone.obj" in note


def test_no_repair_that_runs_away_in_the_scenes_own_steps(slide: Path, record: Record, tmp_path: Path) -> None:
    """A spring of 60 N/mm on 5 kg: stable in steps of less than 2 sqrt(m / k) = 18 ms."""
    slide.write_text(slide.read_text().replace('timestep="0.002"', 'timestep="0.03"'))
    data, out = record(extra=lambda q, v: -6e4 * q - 300 * v, noise=1e-7), tmp_path / "out"
    report = diagnose(slide, [data], effects=["joint_stiffness", "viscous_friction"], out=out).as_dict()
    assert [e["name"] for e in report["effects"]] == ["joint_stiffness"] and report["held_out"]["reduction"] > 0.9
    assert report["repaired_model"] is None and not (out / "repaired.xml").exists()
    told = "runs away in its own timestep of 30 ms. In one of 0.5 ms it does not"
    assert any(n.startswith("no repaired.xml") and told in n for n in report["notes"]), report["notes"]


@pytest.mark.parametrize(
    ("held_drops", "fitted_drop", "lowers", "on"),
    [
        ([0.1, 4.0, 0.2, 0.1, 0.1], 0.5, True, "all 20 windows, each foretold by the others"),
        ([0.1, 4.0, 0.2, 0.1, 0.1], -0.5, False, "all 20 windows, each foretold by the others"),
        ([-0.1, -4.0, -0.2, -0.1, -0.1], 2.0, False, "the 5 windows that were never fitted"),
        ([0.5, 0.6] * 6, -9.0, True, "the 12 windows that were never fitted"),
    ],
)
def test_few_windows_apart_leave_the_word_to_all(
    held_drops: list[float], fitted_drop: float, lowers: bool, on: str
) -> None:
    """Five windows, one of which tells far more than the others, show nothing for certain by themselves."""
    held, fitted = len(held_drops), 15
    setup: Any = SimpleNamespace(fitted=np.arange(fitted), held=np.arange(held), parts=1, squared=np.expm1)
    drops = np.array([fitted_drop] * fitted + held_drops)
    base, better = (judged(np.full(fitted + held, 10.0) - d) for d in (0.0, drops))
    assert repairs(setup, better, better, base, np.random.default_rng(0)) == Repairs(lowers, on)


def test_parts_of_few_windows_are_few_windows() -> None:
    """Two windows apart, each cut into twelve parts that fall alike, while those that were fitted rise."""
    setup: Any = SimpleNamespace(fitted=np.arange(15), held=np.arange(2), parts=12, squared=np.expm1)
    base, better = (judged(np.full(17 * 12, 10.0) - d) for d in (0.0, np.repeat([-9.0, 0.5], [15 * 12, 2 * 12])))
    told = Repairs(False, "all 17 windows, each foretold by the others")
    assert repairs(setup, better, better, base, np.random.default_rng(0)) == told


def judged(errors: Array) -> Hypothesis:
    return Hypothesis(fit=None, effects=1, errors=errors, fitted=errors, complexity=1)  # type: ignore[arg-type]


def test_tolerances_have_units_of_their_signals() -> None:
    signals, units, spread = ["qpos/a", "qpos/b"], ["m", "rad"], np.array([2.0, 0.5])
    assert limits_of(parse_tolerance("1%"), signals, units, spread) == pytest.approx([0.02, 0.005])
    assert limits_of(parse_tolerance("0.1"), signals, units, spread) == pytest.approx([0.2, 0.05])
    assert limits_of(None, signals, units, spread) == pytest.approx([0.02, 0.005])
    assert limits_of(parse_tolerance("qpos/a=0.5mm"), signals, units, spread) == pytest.approx([5e-4, np.inf])
    both = limits_of(parse_tolerance("qpos/b=0.1deg, qpos/a=3"), signals, units, spread)
    assert both == pytest.approx([3.0, 0.1 * np.pi / 180])


def test_a_signal_that_stands_still_is_tolerated_as_those_that_move() -> None:
    units, t = ["m", "m", "rad"], np.linspace(0, 1, 101)
    measured = np.stack([t, 0 * t, 0 * t], -1)[None]
    falls = np.stack([t, 0 * t, 2 * t], -1)[None]
    assert spread_of(measured, falls, units) == pytest.approx([t.std(), t.std(), 2 * t.std()])
    assert spread_of(measured, measured, units) == pytest.approx([t.std(), t.std(), 0])


def test_where_nothing_is_tolerated_equal_predictions_are_alike() -> None:
    y = np.zeros((3, 1, 10, 1))
    y[2] = 1e-9
    strict = Tolerance(np.zeros(1), lambda fits: y[: len(fits)], y[0], np.ones(1), False)
    with np.errstate(divide="ignore"):
        assert list(strict.shares([None] * 3, np.ones(1))) == [0, np.inf]  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("much", "write a share of the motion"),
        ("120%", "between 0 and 1"),
        ("0", "between 0 and 1"),
        ("nan", "between 0 and 1"),
        ("qpos/c=1mm", "no compared signal. There are: qpos/a, qpos/b"),
        ("qpos/a=1deg", "Units that fit: m, cm, mm, um"),
        ("qpos/a=-1mm", "a number above 0"),
        ("qpos/a=", "no size of this signal"),
        ("qpos/a=1e999", "a number above 0"),
        ("qpos/a=1-2", "write a share of the motion"),
    ],
)
def test_tolerances_that_cannot_be(text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        limits_of(parse_tolerance(text), ["qpos/a", "qpos/b"], ["m", "rad"], np.ones(2))
