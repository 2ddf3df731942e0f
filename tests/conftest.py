"""One torch thread per test process, GPU tests skipped where there is no GPU, and shared fixtures."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

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
