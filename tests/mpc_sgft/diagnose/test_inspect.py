"""What is said of recordings before anything runs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest

from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.measured import write_csv
from mpc_sgft.diagnose.inspect import inspect, reversals
from mpc_sgft.diagnose.simulation.plant import load_plant


def test_reversals_are_counted_above_the_noise() -> None:
    t = np.linspace(0, 10, 1000)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(1000)
    assert reversals(np.sin(2 * np.pi * 0.5 * t) + noise, 1e-3) == 10  # five periods, two each
    assert reversals(t + noise, 1e-3) == 0 and reversals(noise, 1e-3) == 0


@pytest.fixture
def foreign(moved: Callable, tmp_path: Path) -> Path:
    """A recording in milliseconds and millimetres, the command in amperes, with a pause."""
    c = moved(4.0, coulomb=2.0)
    late = np.where(np.arange(len(c["time"])) > 600, 1.0, 0.0)
    columns = {"t": 1e3 * (c["time"] + late), "x_enc": -1e3 * c["qpos/x"], "amps": c["ctrl/motor"] / 0.5}
    path = tmp_path / "data" / "drive.csv"
    path.parent.mkdir()
    write_csv(path, columns | {"temperature": np.full(len(late), 31.0)})
    return path


MAP = "time=t ms,qpos/x=-1*x_enc mm,ctrl/motor=0.5*amps A"


def test_a_foreign_recording_is_described_mapped_and_diagnosed(
    foreign: Path, slide: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["--inspect", str(foreign.parent), "--model", str(slide)]) == 0
    said = capsys.readouterr().out
    assert "no column `time`" in said and "missing: ctrl/motor" in said and "diagnose would stop" in said
    assert main(["--inspect", str(foreign), "--model", str(slide), "--map", MAP]) == 0
    said = capsys.readouterr().out
    assert "250 Hz" in said and "1 pauses, the longest 1" in said and "diagnose can use it in 2 pieces" in said
    assert "temperature  not used     constant, 31" in said and "reversals" in said
    out, few = tmp_path / "out", "coulomb_friction,viscous_friction"
    given = ["--model", str(slide), "--data", str(foreign), "--out", str(out), "--effects", few]
    assert main([*given, "--map", MAP]) == 0
    said = capsys.readouterr().out
    assert "verdict: effect" in said and "joint x has 2 N more dry friction" in said
    assert main(given) == 2
    assert "columns missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    "other", ["--data a.csv", "--run runs/push/latest", "--out out", "--max-effects 2", "--traces"]
)
def test_looking_goes_with_nothing_that_runs(
    other: str, foreign: Path, slide: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["--inspect", str(foreign), "--model", str(slide), *other.split()]) == 2
    said = capsys.readouterr()
    assert f"{other.split()[0]} does not go with --inspect" in said.err and not said.out


def test_little_motion_is_said(moved: Callable, slide: Path, tmp_path: Path) -> None:
    columns = moved(2.0)
    columns["qpos/x"] = 1e-4 * np.random.default_rng(0).standard_normal(len(columns["time"]))
    write_csv(tmp_path / "still.csv", columns)
    assert "too little for small effects" in inspect([tmp_path / "still.csv"], load_plant(slide))
    columns["time"][5] = columns["time"][4]
    write_csv(tmp_path / "still.csv", columns)
    assert "time does not always increase" in inspect([tmp_path / "still.csv"])


def test_a_reader_that_left_is_no_traceback(foreign: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "mpc_sgft.diagnose", "--inspect", str(foreign)], stdout=PIPE, stderr=PIPE, text=True
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == "" and process.wait(60) == 141
