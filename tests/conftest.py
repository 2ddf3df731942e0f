"""One torch thread per test process, GPU tests skipped where there is no GPU, and shared fixtures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from ctypes.util import find_library
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from envs.tasks.push import Push

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: workers must not fight over the cores

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure() -> None:
    import torch

    torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    import torch

    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture
def command(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run `python -m mpc_sgft.<name> args...` in an empty folder, as a user would."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def run(name: str, *args: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", f"mpc_sgft.{name}", *args]
        return subprocess.run(line, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=timeout)

    return run


@pytest.fixture
def data_dir() -> Path:
    """Folder of measured data sets, named by MPC_SGFT_DATA or found beside the project; skips where there is none."""
    candidates = (
        [Path(os.environ["MPC_SGFT_DATA"])] if "MPC_SGFT_DATA" in os.environ else [ROOT.parent / "shared" / "data"]
    )
    for path in candidates:
        if path.is_dir():
            return path
    pytest.skip(f"no measured data in {candidates[0]}; set MPC_SGFT_DATA to the folder that holds them")


@pytest.fixture(scope="session")
def render(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """render(shots, ...): what a camera sees of a table with a tag and pucks (tests/render.py); color [n, H, W, 3],
    depth [n, H, W] m. Skips where nothing can draw without a screen."""
    pytest.importorskip("cv2", reason="needs the camera extra")
    found = {"egl": find_library("EGL"), "osmesa": find_library("OSMesa")}
    name = next((name for name, library in found.items() if library), None)
    if name is None:
        pytest.skip("needs libegl1 or libosmesa6 (make system)")

    def draw(shots: list[dict[str, Any]], **settings: Any) -> tuple[np.ndarray, np.ndarray]:
        path = tmp_path_factory.mktemp("render") / "shots.npz"
        order = json.dumps({"shots": shots, **settings}, default=np.ndarray.tolist)
        line, env = [sys.executable, str(ROOT / "tests/render.py"), str(path)], {**os.environ, "MUJOCO_GL": name}
        done = subprocess.run(line, input=order, env=env, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        with np.load(path) as pictures:
            return pictures["color"], pictures["depth"]

    return draw


@pytest.fixture(scope="session")
def robot_push() -> Push:
    """Push as it stands in front of a robot."""
    import yaml

    from envs.tasks.push import Push
    from mpc_sgft.command.choices import CONFIG_DIR

    settings = yaml.safe_load((CONFIG_DIR / "task" / "push.yaml").read_text())
    env = {**settings["env"], **settings["on_robot"]}
    env.pop("_target_")
    return Push(**env)
