"""Whatever is recorded, on whatever small machine: a verdict, or one clear line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.data.measured import write_csv

VERDICTS = ("effect", "none", "unknown", "not_identifiable")
EVERY = 5  # steps of 2 ms in a sample
Columns = dict[str, np.ndarray]


def machine(rng: np.random.Generator) -> str:
    """A chain of one or two joints, driven by motors, servos or nothing, under gravity or not."""
    joints = [rng.choice(["slide", "hinge"]) for _ in range(rng.integers(1, 3))]
    bodies = ""
    for i, kind in reversed(list(enumerate(joints))):
        axis = rng.choice(["1 0 0", "0 1 0", "0 0 1"])
        damping = rng.choice([0.0, 0.1])
        bodies = (
            f'<body name="b{i}" pos="0 0 -0.3"><joint name="j{i}" type="{kind}" axis="{axis}" damping="{damping}"/>'
            f'<inertial pos="0 0 -0.2" mass="{rng.uniform(0.5, 3):.3g}" diaginertia="0.02 0.02 0.01"/>{bodies}</body>'
        )
    drives = ""
    for i in range(len(joints)):
        kind = rng.choice(["motor", "position", "none"])
        if kind != "none":
            drives += f'<{kind} name="a{i}" joint="j{i}" ' + (
                'kp="40" kv="3"/>' if kind == "position" else 'gear="2"/>'
            )
    gravity = rng.choice(["0 0 -9.81", "0 0 0"])
    return (
        f'<mujoco><option timestep="0.002" gravity="{gravity}"/><worldbody>{bodies}</worldbody>'
        f"<actuator>{drives}</actuator></mujoco>"
    )


def recorded(xml: str, seconds: float, rng: np.random.Generator) -> Columns:
    """An episode of the machine with a load and friction that its model lacks."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.dof_damping[:] += 0.3
    model.body_mass[-1] *= 1.1
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = rng.uniform(-0.5, 0.5, model.nq)
    frequency, size = rng.uniform(0.3, 2, model.nu), rng.uniform(0.2, 3, model.nu)
    for step in range(round(seconds / 0.002)):
        if step % EVERY == 0:
            data.ctrl[:] = size * np.sin(2 * np.pi * frequency * data.time)
            rows.append([data.time, *data.ctrl, *data.qpos + 1e-4 * rng.standard_normal(model.nq)])
        mujoco.mj_step(model, data)
    names = [f"ctrl/{model.actuator(i).name}" for i in range(model.nu)]
    names += [f"qpos/{model.joint(i).name}" for i in range(model.njnt)]
    return dict(zip(["time", *names], np.array(rows).T, strict=True))


def changed(columns: Columns, kind: str, change: Callable[[np.ndarray], np.ndarray]) -> Columns:
    return {name: change(x) if name.startswith(kind) else x for name, x in columns.items()}


ODD: dict[str, Callable[[Columns], Columns]] = {
    "as it is": lambda c: c,
    "commands of zero": lambda c: changed(c, "ctrl", np.zeros_like),
    "a constant command": lambda c: changed(c, "ctrl", lambda x: np.full_like(x, 0.7)),
    "saturated": lambda c: changed(c, "ctrl", lambda x: np.clip(x, -0.05, 0.05)),
    "a huge command": lambda c: changed(c, "ctrl", lambda x: 1e6 * x),
    "a tiny command": lambda c: changed(c, "ctrl", lambda x: 1e-12 * x),
    "positions that never move": lambda c: changed(c, "qpos", lambda x: np.full_like(x, x[0])),
    "one joint that never moves": lambda c: changed(c, "qpos/j0", lambda x: np.full_like(x, x[0])),
    "positions of zero": lambda c: changed(c, "qpos", np.zeros_like),
    "one step": lambda c: changed(c, "qpos", lambda x: np.where(np.arange(len(x)) < len(x) // 2, 0.0, 0.3)),
    "coarse positions": lambda c: changed(c, "qpos", lambda x: np.round(x, 1)),
    "without noise": lambda c: changed(c, "qpos", lambda x: np.sin(np.arange(len(x)) / 40)),
    "nothing but noise": lambda c: changed(c, "qpos", lambda x: 1e-3 * np.random.default_rng(0).normal(size=len(x))),
    "far away": lambda c: changed(c, "qpos", lambda x: x + 1e4),
    "short": lambda c: {name: x[:52] for name, x in c.items()},
    "too short": lambda c: {name: x[:20] for name, x in c.items()},
    "one sample late": lambda c: changed(c, "qpos", lambda x: np.r_[x[:1], x[:-1]]),
    "one sample lost": lambda c: {name: np.delete(x, 70) for name, x in c.items()},
}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("odd", ODD)
def test_a_verdict_or_one_clear_line(odd: str, seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng([seed, list(ODD).index(odd)])
    xml = machine(rng)
    (tmp_path / "scene.xml").write_text(xml)
    write_csv(tmp_path / "episode.csv", ODD[odd](recorded(xml, 2.0, rng)))
    few = None if seed else ["viscous_friction", "payload", "sensor_delay"]
    try:
        report = diagnose(
            tmp_path / "scene.xml", [tmp_path / "episode.csv"], out=tmp_path / "out", effects=few, max_effects=1
        ).as_dict()
    except UserError as error:
        assert str(error) and "\n" not in str(error)
        return
    assert report["verdict"] in VERDICTS and np.isfinite(report["held_out"]["nominal"])
