"""A skip is named, and cannot hide a missing part where nothing may be missing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.left_out import NEEDS, left_out

ROOT = Path(__file__).resolve().parents[1]
SKIPS = """
import pytest
def test_runs(): pass
def test_draws(): pytest.skip("needs a renderer: no driver")
def test_computes(): pytest.skip("needs a GPU")
"""


def test_the_line_counts_by_need() -> None:
    line, unknown = left_out(["Skipped: needs a GPU", "Skipped: needs a GPU", "needs the robot's client", "tired"])
    assert line == (
        "left out: 2 that need a GPU (a machine with CUDA), 1 that need the robot's client (make robot), tired"
    )
    assert unknown == ["tired"] and left_out([]) == ("", [])


@pytest.mark.parametrize("workers", ["0", "2"])
@pytest.mark.parametrize(("allowed", "code"), [(None, 0), ("a GPU, a renderer", 0), ("a GPU", 1)])
def test_what_may_not_be_missing_fails_the_run(tmp_path: Path, allowed: str | None, code: int, workers: str) -> None:
    (tmp_path / "test_it.py").write_text(SKIPS)
    env = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "MPC_SGFT_MAY_SKIP"))}
    env |= {"PYTHONPATH": str(ROOT)} | ({"MPC_SGFT_MAY_SKIP": allowed} if allowed else {})
    line = [sys.executable, "-m", "pytest", "-q", "-p", "tests.left_out", "-n", workers, "--rootdir", str(tmp_path)]
    done = subprocess.run([*line, str(tmp_path)], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == code, done.stdout + done.stderr
    assert "left out: 1 that need a renderer (make system), 1 that need a GPU" in done.stdout.replace("\n", "") or (
        "1 that need a GPU (a machine with CUDA), 1 that need a renderer" in done.stdout
    )
    assert ("only a GPU may be missing here: Skipped: needs a renderer: no driver" in done.stdout) == bool(code)


def test_every_skip_of_the_project_names_a_need() -> None:
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")) + sorted((ROOT / "tests").rglob("conftest.py")):
        if path.name != Path(__file__).name:
            text = re.sub(r"xfail\([^)]*\)", "", path.read_text())  # these run
            found += re.findall(r'(?:reason=|pytest\.skip\()f?"([^"]*)"', text)
    assert len(found) > 20
    assert not [reason for reason in found if not reason.startswith(tuple(f"needs {need}" for need in NEEDS))]
