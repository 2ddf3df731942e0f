"""The built wheel, in an environment of its own and another folder: all yaml inside, help answers, configs compose."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("configs", "envs", "planners", "mpc_sgft")


def run(*line: str | Path, cwd: Path) -> str:
    """Run a command without this checkout on its path; its output, or a failure with both streams."""
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run([str(word) for word in line], cwd=cwd, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that the checkout stays clean."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", out, source, cwd=out)
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an empty environment with the wheel; the dependencies are this environment's, linked by a .pth."""
    place = tmp_path_factory.mktemp("env")
    run(sys.executable, "-m", "venv", "--without-pip", place, cwd=place)
    inner = place / "bin" / "python"
    site = Path(run(inner, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])", cwd=place).strip())
    run(sys.executable, "-m", "pip", "--python", inner, "install", "-q", "--no-deps", "--no-index", wheel, cwd=place)
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    return inner


def test_every_yaml_asset_and_module_is_in_the_wheel(wheel: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    folders = [
        *(ROOT / "configs").rglob("*.yaml"),
        *(ROOT / "envs" / "assets").glob("*"),
        *(ROOT / "mpc_sgft" / "assets").glob("*"),
    ]
    folders += [path for name in PACKAGES for path in (ROOT / name).rglob("*.py")]
    expected = {
        path.relative_to(ROOT).as_posix() for path in folders if path.is_file() and "__pycache__" not in path.parts
    }
    assert len(expected) > 30
    assert expected <= inside, sorted(expected - inside)
    assert not [name for name in inside if name.startswith(("tests/", "tools/"))]


@pytest.mark.parametrize("name", ["pretrain", "deploy", "evaluate"])
def test_help_answers_from_any_folder(name: str, python: Path, tmp_path: Path) -> None:
    out = run(python, "-m", f"mpc_sgft.{name}", "--help", cwd=tmp_path)
    assert "push" in out and "gap=" in out


def test_configs_compose_from_a_folder_with_configs_of_its_own(python: Path, tmp_path: Path) -> None:
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "deploy.yaml").write_text("wrong: true\n")
    out = run(
        python,
        "-m",
        "mpc_sgft.deploy",
        "--config",
        "task=pendulum",
        "+gap.effects.actuator_gain.gain=0.6",
        cwd=tmp_path,
    )
    assert "task: pendulum" in out and "gain: 0.6" in out


def test_the_environment_uses_the_wheel_and_not_this_checkout(python: Path, tmp_path: Path) -> None:
    code = "import mpc_sgft, envs, planners, configs; print(*(m.__file__ for m in (mpc_sgft, envs, planners, configs)))"
    paths = run(python, "-c", code, cwd=tmp_path).split()
    assert len(paths) == 4 and all(path.startswith(str(python.parents[1])) for path in paths)
