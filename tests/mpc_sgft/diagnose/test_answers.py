"""Whole answers on a slide with known truth: each verdict, ties, vetoes, refits, and what the files hold."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.measured import write_csv

GEAR = 10.0  # of the slide's motor
Record = Callable[..., Path]
Check = Callable[[dict], None]


def names(report: dict) -> set[str]:
    """All names that a report gives or ties."""
    every = [n for tie in report["ties"] for n in tie["effects"]] + [e["name"] for e in report["effects"]]
    return {name.split("@")[0] for name in every}


def test_the_command_line_writes_a_whole_report(
    slide: Path, record: Record, tmp_path: Path, check_report: Check, capsys: pytest.CaptureFixture
) -> None:
    out, data = tmp_path / "out", record(coulomb=2.0, viscous=6.0)
    given = ["--model", str(slide), "--data", str(data), "--out", str(out)]
    assert main([*given, "--effects", "coulomb_friction,viscous_friction,quadratic_drag"]) == 0
    said = capsys.readouterr()
    assert "verdict: effect" in said.out and "report.html" in said.out and "100%" in said.err
    report = json.loads((out / "report.json").read_text())
    check_report(report)
    assert names(report) == {"coulomb_friction", "viscous_friction"}
    assert any("one episode only" in note for note in report["notes"])
    shares = {w["regime"]: w["share_of_error"] for w in report["where"]}
    assert shares["all"] == 1.0 and shares["fast"] > shares["slow"]  # what is viscous shows where it is fast
    again = diagnose(out / "repaired.xml", [data], effects=["viscous_friction", "quadratic_drag"]).as_dict()
    assert again["verdict"] == "none", again["reason"]
    assert abs(again["held_out"]["nominal"] / report["held_out"]["repaired"] - 1) < 0.02  # plain MJCF carries it


def test_one_term_of_the_equations_ties_and_a_measured_force_vetoes(
    slide: Path, moved: Callable, tmp_path: Path, check_report: Check
) -> None:
    columns, rng = moved(5.0, mass=6.0), np.random.default_rng(0)
    write_csv(tmp_path / "blind.csv", columns)
    force = GEAR * columns["ctrl/motor"] + 0.01 * rng.standard_normal(len(columns["time"]))
    write_csv(tmp_path / "felt.csv", columns | {"force/motor": force})
    few = ["payload", "armature", "actuator_gain", "viscous_friction"]
    blind, felt = (diagnose(slide, [tmp_path / f"{n}.csv"], effects=few).as_dict() for n in ("blind", "felt"))
    for report in (blind, felt):
        check_report(report)
        assert report["verdict"] == "not_identifiable" and report["next_experiment"], report["reason"]
    assert names(blind) == {"payload", "armature", "actuator_gain"}
    assert names(felt) == {"payload", "armature"} and "weigh the load" in felt["ties"][0]["reason"]


def test_of_names_for_one_term_the_usual_one_is_given(slide: Path, record: Record) -> None:
    few = ["gravity_tilt", "actuator_offset", "viscous_friction"]
    report = diagnose(slide, [record(extra=lambda q, v: -1.0)], effects=few).as_dict()
    assert report["verdict"] == "effect" and [e["name"] for e in report["effects"]] == ["actuator_offset"]
    (tie,) = report["ties"]
    assert tie["effects"] == ["gravity_tilt"] and "spirit level" in tie["reason"]
    offset = report["effects"][0]["parameters"]["offset"]
    assert offset["low"] <= -0.1 <= offset["high"] and offset["unit"] == "of the control"


@pytest.mark.parametrize(("what", "factor"), [("mass", 1.2), ("gain", 1 / 1.2)])
def test_what_the_user_calls_uncertain_is_no_effect(what: str, factor: float, slide: Path, record: Record) -> None:
    few = ["viscous_friction", "actuator_offset"]
    report = diagnose(slide, [record(mass=6.0)], effects=few, uncertain={what: 0.3}).as_dict()
    assert report["verdict"] == "none" and not report["effects"], report["reason"]
    (refit,) = report["nominal_refit"].values()
    assert refit["factor"] == pytest.approx(factor, rel=0.01)


@pytest.mark.parametrize("waves", [8.0, 20.0])  # rad/m, along a way of a metre
def test_what_no_name_covers_is_unknown(waves: float, slide: Path, record: Record, check_report: Check) -> None:
    data = record(seconds=8.0, extra=lambda q, v: 3.0 * np.sin(waves * q))
    report = diagnose(slide, [data], effects=["viscous_friction", "coulomb_friction"]).as_dict()
    check_report(report)
    assert report["verdict"] == "unknown" and report["effects"] == []
    assert "flexible residual model" in report["reason"]
    assert report["residual_model_error"] < report["candidates"][0]["held_out_error"] - 1


def test_one_window_held_out_is_said(slide: Path, record: Record) -> None:
    data = [record("long", seconds=4.0, viscous=6.0), record("short", seconds=0.8, viscous=6.0, seed=1)]
    told = {"effects": ["viscous_friction"], "window": 0.4}
    short, long = (diagnose(slide, data, held_out=[name], **told).as_dict() for name in ("short", "long"))
    assert short["held_out"]["windows"] == 1 and short["held_out"]["low"] == short["held_out"]["high"]
    said = [any("one window only is held out" in note for note in r["notes"]) for r in (short, long)]
    assert said == [True, False] and long["held_out"]["low"] < long["held_out"]["high"]
