"""A slide and a pendulum with known truth, simulated here with an integrator of the tests' own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mpc_sgft.diagnose.record import write_csv

SLIDE = """<mujoco><option timestep="0.002"/><worldbody><body name="cart">
<joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="5"/></body></worldbody>
<actuator><motor name="motor" joint="x" gear="10"/></actuator></mujoco>"""
DT, FINE = 0.004, 20  # [s] between samples; integration steps in one
MASS, GEAR = 5.0, 10.0


def drive(seconds: float, seed: int = 0) -> np.ndarray:
    """A smooth command that moves the cart back and forth, held for each sample, [T]."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds / DT)) * DT
    return sum(0.8 / k * np.cos(2 * np.pi * k * 0.6 * t + rng.uniform(0, 6.3)) * 2 for k in (1, 2, 3))


def slide_data(
    seconds: float,
    *,
    viscous: float = 0.0,
    coulomb: float = 0.0,
    extra: Callable[[float, float], float] | None = None,
    mass: float = MASS,
    noise: float = 2e-5,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Columns of one episode: m q'' = gear u - viscous q' - coulomb sign(q') + extra(q, q'), with true sticking."""
    u, rng = drive(seconds, seed), np.random.default_rng(seed + 100)
    q, v, h, positions = 0.0, 0.0, DT / FINE, []
    for command in u:
        positions.append(q)
        for _ in range(FINE):
            force = GEAR * command - viscous * v + (extra(q, v) if extra else 0.0)
            if v == 0.0 and abs(force) <= coulomb:
                continue
            direction = np.sign(v) if v else np.sign(force)
            new = v + h * (force - coulomb * direction) / mass
            new = 0.0 if v and coulomb and new * v < 0 else new
            q, v = q + h * (v + new) / 2, new
    measured = np.array(positions) + noise * rng.standard_normal(len(u))
    return {"time": np.arange(len(u)) * DT, "ctrl/motor": u, "qpos/x": measured}


@pytest.fixture
def slide(tmp_path: Path) -> Path:
    path = tmp_path / "slide.xml"
    path.write_text(SLIDE)
    return path


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Write one episode of the slide; returns its file."""

    def write(name: str = "episode", seconds: float = 5.0, **truth: object) -> Path:
        path = tmp_path / f"{name}.csv"
        write_csv(path, slide_data(seconds, **truth))  # pyright: ignore[reportArgumentType]
        return path

    return write
