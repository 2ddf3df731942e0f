"""Machines of the foreign grounds, run in an engine, and what MuJoCo makes of the same."""

import mujoco
import numpy as np

from tools.studies.blind.plants import Array
from tools.studies.foreign.loop import Record, simulate
from tools.studies.foreign.make import Engines
from tools.studies.foreign.scenes import SCENES, Scene, build, draw_nominal, parameters

DT = 0.002
START = [0.2, -0.3, 0.1]


def machine(name: str, **change: list[float]) -> tuple[Scene, dict]:
    """A scene, and numbers of a machine without dry friction."""
    scene = SCENES[name]
    return scene, draw_nominal(scene, np.random.default_rng(1)) | {"dry": [0.0] * scene.n} | change


def run(
    engine: Engines,
    scene: Scene,
    numbers: dict,
    q: list[float],
    v: list[float],
    ticks: int,
    commands: Array | None = None,
    **effects: float,
) -> Record:
    """From (q, v) on, with these effects at the first joint."""
    p = parameters(scene, numbers)
    for name, value in effects.items():
        p[name][..., 0] = value
    made = engine(scene, p)
    commands = np.zeros((ticks, made.drives)) if commands is None else commands
    return simulate(made, p, (np.array(q), np.array(v)), ticks, DT, commands)


def beside_mujoco(engine: Engines, name: str, ticks: int) -> tuple[Record, Array]:
    """A driven machine, and how far MuJoCo's positions are off at most, [n]."""
    scene, numbers = machine(name)
    model = mujoco.MjModel.from_xml_string(build(scene, numbers))
    model.opt.timestep = DT / 10
    data = mujoco.MjData(model)
    data.qpos[:] = START[: scene.n]
    commands = np.array([[0.3 * np.sin(0.02 * k + j) for j in range(model.nu)] for k in range(ticks)])
    record = run(engine, scene, numbers, START[: scene.n], [0.0] * scene.n, ticks, commands)
    worst = np.zeros(scene.n)
    for k, command in enumerate(commands):
        worst = np.maximum(worst, np.abs(data.qpos - record.q[k]))
        data.ctrl[:] = command
        mujoco.mj_step(model, data, nstep=10)
    return record, worst


def energies(scene: Scene, numbers: dict, record: Record, at: tuple[int, ...]) -> Array:
    """Potential and kinetic energy at these ticks, as MuJoCo has them, [k, 2]."""
    model = mujoco.MjModel.from_xml_string(build(scene, numbers))
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data, out = mujoco.MjData(model), []
    for k in at:
        data.qpos[:], data.qvel[:] = record.q[k], record.v[k]
        mujoco.mj_forward(model, data)
        out.append(data.energy.copy())
    return np.array(out)
