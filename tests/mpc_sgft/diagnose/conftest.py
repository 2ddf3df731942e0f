"""A slide with known truth, simulated here with an integrator of the tests' own; and recorded deployments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra.utils import instantiate

from envs.backends.sim import SimBackend
from envs.effects import load
from mpc_sgft.diagnose.data.measured import write_csv
from mpc_sgft.storage.episode_file import EpisodeWriter

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
def moved() -> Callable[..., dict[str, np.ndarray]]:
    """`slide_data`: columns of an episode of the slide."""
    return slide_data


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


TASKS = Path(__file__).parents[3] / "configs" / "task"
HELD_OUT = {
    "signal": str,
    "unit": str,
    "windows": int,
    "nominal": float,
    "repaired": float,
    "reduction": float,
    "low": float,
    "high": float,
}
REPORT = {  # key of report.json -> type, or {key: type} of each item
    "verdict": str,
    "reason": str,
    "effects": {"name": str, "at": list, "parameters": dict, "probability": float, "share": dict, "changes": list},
    "traces": {"name": str, "at": list, "parameters": dict, "share": dict, "changes": list},
    "candidates": {"effects": list, "held_out_error": float, "low": float, "high": float, "probability": float},
    "waterfall": {"what": str, "signal": str, "unit": str, "rms": float},
    "ties": {"effects": list, "probability": float, "held_out_error": float, "reason": str},
    "next_experiment": str,
    "nominal_refit": dict,
    "where": {"signal": str, "regime": str, "share_of_error": float, "share_of_time": float},
    "held_out": dict,
    "signals": HELD_OUT,
    "noise_floor": dict,
    "residual_model_error": (float, type(None)),
    "seconds": float,
    "repaired_model": (str, type(None)),
    "effects_file": (str, type(None)),
    "notes": list,
}


@pytest.fixture
def check_report() -> Callable[[dict], None]:
    """Every key of report.json is there, no other, and each holds what the README says."""

    def check(report: dict) -> None:
        assert set(report) == set(REPORT)
        for key, kind in REPORT.items():
            if isinstance(kind, dict):
                for item in report[key]:
                    assert set(item) == set(kind), key
                    assert all(isinstance(item[k], t) for k, t in kind.items()), (key, item)
            else:
                assert isinstance(report[key], kind), (key, report[key])
        assert report["verdict"] in ("effect", "none", "unknown", "not_identifiable")
        assert report["held_out"] == report["signals"][0]
        assert {s["signal"] for s in report["signals"]} <= set(report["noise_floor"])
        for effect in report["effects"]:
            for parameter in effect["parameters"].values():
                assert set(parameter) == {"value", "unit", "low", "high"}
                assert parameter["low"] <= parameter["value"] <= parameter["high"]
        for effect in report["effects"] + report["traces"]:
            assert set(effect["share"]) == {"value", "low", "high"}
            assert all(set(c) == {"signal", "unit", "rms"} and c["rms"] >= 0 for c in effect["changes"])
        for floor in report["noise_floor"].values():
            assert set(floor) == {"noise", "simulator"}

    return check


@pytest.fixture
def deployed(tmp_path: Path) -> Callable[..., Path]:
    """Drive a task with its scripted policy in a gap and record it as deploy does; returns the run folder.

    With `against`, the policy counters a drift that it knows. Its config.yaml tells a gap that was never there: who
    reads it is found out.
    """

    def make(
        effects: dict, episodes: int = 4, steps: int = 40, task_name: str = "push", against: float | list = 0.0
    ) -> Path:
        folder = tmp_path / "run"
        (folder / "episodes").mkdir(parents=True)
        task_cfg = yaml.safe_load((TASKS / f"{task_name}.yaml").read_text())
        config = {"command": "deploy", "chosen": {"task": task_name, "gap": "lie"}, "task": task_cfg}
        config["gap"] = {"effects": {"actuator_gain": {"gain": 0.1}}}
        (folder / "config.yaml").write_text(yaml.safe_dump(config))
        task = instantiate(task_cfg["env"], _convert_="all")
        backend, rng = SimBackend(task, 1, effects=load(effects)), np.random.default_rng(0)
        for number in range(1, episodes + 1):
            backend.seed(number)
            seen = backend.reset(np.arange(1))
            meta = {"task": task_name, **backend.describe()}
            with EpisodeWriter(folder / "episodes" / f"{number:04d}.mcap", meta) as writer:
                for t in range(steps):
                    noise = 0.3 * rng.standard_normal((1, task.action_dim))
                    action = np.clip(task.scripted(seen) - against + noise, -1, 1)
                    out = backend.send(action)
                    row = {"step": t, "time": (t + 1) * task.control_dt, "observation": seen[0], "action": action[0]}
                    row |= {"next_observation": out.observation[0], "action_sent": out.action_sent[0]}
                    row |= {"reward": 0.0, "terminated": False, "truncated": t == steps - 1, "success": False}
                    writer.step(row | {"invalid": False}, backend.samples())
                    seen = out.observation
                writer.close({"success": False})
        return folder

    return make
