"""Whoever opens a tool reads first what it makes, then the command."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted(p for room in ("studies", "benchmarks") for p in (ROOT / "tools" / room).glob("*.py"))


@pytest.mark.parametrize(
    "path", [p for p in SCRIPTS if p.name not in ("__init__.py", "runner.py")], ids=lambda p: p.stem
)
def test_a_study_says_what_it_makes_and_its_command(path: Path) -> None:
    first, empty, *rest = path.read_text().removeprefix('"""').splitlines()
    assert re.search(r"[.?]$|: .*\.$", first) and not empty
    module = f"tools.{path.parent.name}.{path.stem}"
    assert any(line.startswith(f"    python -m {module}") for line in rest[:4]), module


def test_an_old_name_ends_with_the_new_one() -> None:
    done = subprocess.run([sys.executable, "-m", "tools.relearn"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode != 0 and "tools.relearn is tools.studies.relearn now" in done.stderr
    done = subprocess.run([sys.executable, "-m", "tools.nonsense"], cwd=ROOT, capture_output=True, text=True)
    assert "now" not in done.stderr and "No module named tools.nonsense" in done.stderr


def test_every_moved_tool_is_where_it_is_said_to_be() -> None:
    from tools import MOVED

    for room, names in MOVED.items():
        for name in names:
            assert (ROOT / "tools" / room / f"{name}.py").is_file(), name
