"""One torch thread per test process, GPU tests skipped where there is no GPU, and shared fixtures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from envs.tasks.push import Push

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: workers must not fight over the cores

pytest_plugins = ["tests.left_out", "tests.probes"]

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
            item.add_marker(pytest.mark.skip(reason="needs a GPU"))


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
    pytest.skip(f"needs measured data: none in {candidates[0]}")


def _draws(line: list[str], folder: Path, seconds: float, **environment: str) -> str:
    """Run a command that draws; why it could not, or nothing."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    try:
        done = subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return f"nothing was drawn in {seconds:.0f} s"
    return "" if done.returncode == 0 else (done.stderr.strip() or "it failed").splitlines()[-1]


DRAW = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.3' rgba='1 0 0 1'/></worldbody></mujoco>")
data, renderer = mujoco.MjData(model), mujoco.Renderer(model, 32, 32)
mujoco.mj_forward(model, data)
renderer.update_scene(data)
assert renderer.render().max() > 50, "the picture is black"
"""

VIEW = """
import sys
from pathlib import Path
import numpy as np
import rerun as rr
from tools.screenshot import screenshot
recording = rr.RecordingStream("probe")
recording.save("probe.rrd")
recording.log("image", rr.Image(np.zeros((8, 8, 3), np.uint8)))
recording.disconnect()
screenshot(Path("probe.rrd"), Path("probe.png"), settle=0.0)
"""


@pytest.fixture(scope="session")
def mujoco_gl(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A value of MUJOCO_GL with which MuJoCo draws here without a screen: it was tried. Skips where there is none."""
    why = _draws([sys.executable, "-c", DRAW], tmp_path_factory.mktemp("probe"), 60, MUJOCO_GL="egl")
    if why:
        pytest.skip(f"needs a renderer: {why}")
    return "egl"


@pytest.fixture(scope="session")
def viewer_draws(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The rerun viewer draws here without a screen: it was tried. Skips where it cannot."""
    why = _draws([sys.executable, "-c", VIEW], tmp_path_factory.mktemp("probe"), 180)
    if why:
        pytest.skip(f"needs a renderer: {why}")


@pytest.fixture(scope="session")
def render(mujoco_gl: str, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """render(shots, ...): what a camera sees of a table with a tag and pucks (tests/render.py); color [n, H, W, 3],
    depth [n, H, W] m."""
    pytest.importorskip("cv2", reason="needs the camera's packages")
    name = mujoco_gl

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
