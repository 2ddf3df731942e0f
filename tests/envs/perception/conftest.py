"""A table seen by a camera, and recordings of it by the SDK's software camera."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from envs.perception.calibration import Calibration
from envs.perception.intrinsics import Intrinsics

WIDTH, HEIGHT, FOVY, TAG_SIZE, NUMBER = 640, 480, 45.0, 0.04, 7
PUCKS = np.array([[0.45, -0.1, 0.015], [0.5, 0.05, 0.015], [0.62, 0.12, 0.015]])  # [m] centres, base frame
TESTS = Path(__file__).resolve().parents[2]


class Table(NamedTuple):
    """Pictures of a puck that carries a tag, at `PUCKS`, of the empty table, and of the bare puck; two cameras."""

    lens: Intrinsics
    cameras: list[np.ndarray]  # base_T_camera of each
    color: list[np.ndarray]  # [7, H, W, 3]
    depth: list[np.ndarray]  # [7, H, W] m
    pucks: np.ndarray


def looking(at: list[float], position: list[float]) -> np.ndarray:
    """Pose [4, 4] of a camera that looks at a point, the picture's x level."""
    z = np.subtract(at, position) / np.linalg.norm(np.subtract(at, position))
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), position
    return pose


def lens() -> Intrinsics:
    focal = HEIGHT / 2 / np.tan(np.radians(FOVY) / 2)
    return Intrinsics(width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2)


@pytest.fixture(scope="session")
def table(render: Callable) -> Table:
    cameras = [looking([0.5, 0, 0], [0.9, -0.4, 0.5]), looking([0.5, 0, 0], [0.4, 0.5, 0.6])]
    shots: list[dict[str, Any]] = []
    for camera in cameras:
        for puck in PUCKS:
            pose, tag = np.eye(4), np.eye(4)
            pose[:3, 3], tag[:3, 3] = puck, puck + [0, 0, 0.0155]
            shots.append({"camera": camera, "puck": pose, "tag": tag})
        shots.append({"camera": camera})
        shots += [{"camera": camera, "puck": shot["puck"]} for shot in shots[-4:-1]]
    color, depth = render(shots, size=[WIDTH, HEIGHT], fovy=FOVY, tag_size=TAG_SIZE, number=NUMBER)
    return Table(lens(), cameras, [color[:7], color[7:]], [depth[:7], depth[7:]], PUCKS)


@pytest.fixture
def calibration(tmp_path: Path) -> Callable[..., str]:
    """calibration(serial, base_T_camera): path of a file."""

    def write(serial: str, pose: np.ndarray) -> str:
        path = tmp_path / f"{serial}.json"
        made = Calibration(serial=serial, intrinsics=lens(), base_T_camera=pose, residual_mm=0.0, pairs=20)
        path.write_text(made.to_json())
        return str(path)

    return write


@pytest.fixture
def film(tmp_path: Path) -> Callable[..., str]:
    """film(serial, color [n, H, W, 3], depth [n, H, W] m or None, late_ms=0): path of a .db3 recording by librealsense,
    30 frames a second, the depth taken `late_ms` after the picture (tests/film.py)."""
    pytest.importorskip("pyrealsense2", reason="needs the camera's packages", exc_type=ImportError)

    def record(serial: str, color: np.ndarray, depth: np.ndarray | None, late_ms: float = 0.0) -> str:
        path, pictures = tmp_path / f"{serial}.db3", {"color": color}
        if depth is not None:
            pictures["depth"] = np.round(depth * 1000).astype(np.uint16)
        np.savez(tmp_path / "film.npz", **pictures)  # type: ignore[arg-type]
        order = json.dumps({"path": str(path), "serial": serial, "lens": asdict(lens()), "late_ms": late_ms})
        line = [sys.executable, str(TESTS / "film.py"), str(tmp_path / "film.npz")]
        done = subprocess.run(line, input=order, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        return str(path)

    return record
