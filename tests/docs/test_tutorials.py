"""The blocks of the tutorials and of the Python page run as they are written, in order, in one folder each."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    "tutorials/first-gap.md",
    "tutorials/own-data.md",
    "tutorials/own-task.md",
    "tutorials/own-method.md",
    "tutorials/robot-rehearsal.md",
    "benchmark.md",
]
BLOCK = re.compile(r"^```(bash|python|yaml)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page: str) -> list[tuple[str, str]]:
    """(language, text) of each fenced block that is to be run; `text` blocks are shown only."""
    return BLOCK.findall((ROOT / "docs" / page).read_text())


def run(language: str, text: str, folder: Path) -> None:
    if text.startswith("# file: "):
        name, _, content = text.partition("\n")
        path = folder / name.removeprefix("# file: ")
        assert not path.exists(), path
        path.write_text(content)
        return
    env = {**os.environ, "PYTHONPATH": str(folder if (folder / "mpc_sgft").is_dir() else ROOT), "OMP_NUM_THREADS": "1"}
    env |= {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    line = [sys.executable, "-c", text] if language == "python" else ["bash", "-euo", "pipefail", "-c", text]
    done = subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_does_what_it_says(page: str, tmp_path: Path) -> None:
    if "robot" in page:
        pytest.importorskip("franky", reason="needs the robot's client")
        pytest.importorskip("franky_sim", reason="needs the robot's client")
    found = blocks(page)
    assert found
    if any(text.startswith("# file: ") for _, text in found):  # it adds to the project: to a copy of it
        for room in ("configs", "envs", "planners", "mpc_sgft"):
            shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
    for language, text in found:
        run(language, text, tmp_path)


def test_the_python_page_runs_in_ten_lines(tmp_path: Path) -> None:
    (language, text), *more = blocks("reference/python.md")
    assert language == "python" and not more
    assert len([line for line in text.splitlines() if line.strip()]) <= 10
    run(language, text, tmp_path)
