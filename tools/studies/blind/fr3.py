"""The FR3 as it might be in reality: MuJoCo at another time step, integrator and solver, with what the model lacks.

Rotors, loads and link masses are written into the model of reality. Everything else is Python: a callback for what
resists the joints, one for what becomes of a command on its way to the servo, and dry friction by events. A joint that
turns round stops; it stays where it is for as long as its friction can hold it; then it breaks loose.

The parameters of reality are those of `truths.rows`, one machine.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import mujoco
import numpy as np

from envs.fr3 import FLANGE, JOINTS, add_fr3
from tools.studies.blind.fr3_friction import DryFriction
from tools.studies.blind.plants import Array, Rows
from tools.studies.blind.truths import rows

TIMESTEP = 0.002  # [s] the solver's
TOOL = {"tool_length": 0.12, "tool_radius": 0.012}  # [m]
Hook = Callable[[mujoco.MjModel, mujoco.MjData], None]


class Arm(NamedTuple):
    """What the benchmark calls the parts of the FR3; see `plants.Plant`."""

    name: str = "fr3"
    joints: tuple[str, ...] = JOINTS
    kinds: tuple[str, ...] = ("hinge",) * 7
    actuators: tuple[str, ...] = tuple(f"position{i}" for i in range(1, 8))
    tip: str = "link7"

    @property
    def n(self) -> int:
        return len(self.joints)


class Numerics(NamedTuple):
    """How reality is computed: step [s], names of MuJoCo's integrator and constraint solver."""

    step: float
    integrator: str
    solver: str


# Errors are a twentieth of the best encoder's; a tick of 4 ms is a whole number of each step. (Euler and the implicit
# integrators are of first order in the servos' damping: at 0.2 ms they are as far off as that encoder.)
NUMERICS = (Numerics(0.0005, "RK4", "CG"), Numerics(0.0004, "RK4", "PGS"), Numerics(0.00025, "RK4", "PGS"))


class Run(NamedTuple):
    """What happened at T ticks: time [T], all else [T, 7].

    `clean` and `clean_speed` are what ideal encoders read at `time`, q and v the truth at the ticks. `force` [N m] is
    what the servos do at the ticks: they report it with the command that they have just got.
    """

    time: Array
    clean: Array
    clean_speed: Array
    force: Array
    q: Array
    v: Array


def build() -> str:
    """The MJCF of the nominal arm with a peg as its tool: what the solver gets, and where reality starts from."""
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = "fr3", False
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    add_fr3(spec, base=(0.0, 0.0, 0.0), **TOOL)
    spec.compile()
    return spec.to_xml()


def nominal(model: mujoco.MjModel) -> dict[str, Array]:
    """Parameters without any effect; the friction that the model knows of is in c_pos and c_neg, the rest in it."""
    return rows(Arm(), {"dry": model.dof_frictionloss.copy()})


def reality(xml: str, p: Rows, numerics: Numerics, masses: dict[str, float] | None = None) -> mujoco.MjModel:
    """MuJoCo's model of reality, without dry friction: `simulate` adds that.

    Args:
        xml: The nominal model.
        p: Parameters; `armature` and `payload` are used here.
        numerics: Step, integrator and solver.
        masses: Link -> factor by which it is heavier than the model says. The arm's gravity compensation knows it.
    """
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.timestep = numerics.step
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{numerics.integrator}")
    spec.option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{numerics.solver}")
    for joint, rotor in zip(spec.joints, p["armature"][0], strict=True):
        joint.frictionloss, joint.armature = 0.0, joint.armature + rotor
    if p["payload"][0]:  # held by the end of the tool, and not gravity compensated
        load = spec.body(Arm().tip).add_body(pos=[0, 0, FLANGE + TOOL["tool_length"] - TOOL["tool_radius"]])
        load.mass, load.inertia, load.explicitinertial = float(p["payload"][0]), [1e-6] * 3, True
        load.ipos = [0, 0, 0]  # MuJoCo takes `pos` otherwise
    model = spec.compile()
    for link, factor in (masses or {}).items():
        i = model.body(link).id
        model.body_mass[i] *= factor
        model.body_inertia[i] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@contextmanager
def callbacks(passive: Hook, control: Hook) -> Iterator[None]:
    """MuJoCo calls these two in every simulation of this process until the block ends, however it ends."""
    before = mujoco.get_mjcb_passive(), mujoco.get_mjcb_control()
    mujoco.set_mjcb_passive(passive)
    mujoco.set_mjcb_control(control)
    try:
        yield
    finally:
        mujoco.set_mjcb_passive(before[0])
        mujoco.set_mjcb_control(before[1])


def simulate(
    model: mujoco.MjModel, p: Rows, q: Array, v: Array, ctrl: Array, tick: float, late: Array | None = None
) -> Run:
    """Drive the arm by commands that hold for a tick each.

    Args:
        model: Of `reality`.
        p: Its parameters.
        q, v: Where it starts, [7] each.
        ctrl: Commands [rad], [T, 7].
        tick: [s], a whole number of the model's steps.
        late: Steps by which each sample comes late (negative: early), [T]; on the tick if None.
    """
    one = {k: x[0] for k, x in p.items()}
    h, ticks = float(model.opt.timestep), len(ctrl)
    per_tick = round(tick / h)
    shift = np.zeros(ticks, int) if late is None else late
    sampled = dict(zip((np.arange(ticks) * per_tick + shift).tolist(), range(ticks), strict=True))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    queue = _arriving(one, ctrl, per_tick, h)
    friction = DryFriction(model, data, one)
    resist = _resistance(one)
    qs, vs, clean, speed, force = (np.zeros((ticks, model.nv)) for _ in range(5))

    def passive(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        d.qfrc_passive[:] += friction.force
        for part in resist:
            d.qfrc_passive[:] -= part(d.qpos, d.qvel)

    def control(m: mujoco.MjModel, d: mujoco.MjData) -> None:
        d.ctrl[:] = command

    with callbacks(passive, control):
        for i in range((ticks - 1) * per_tick + max(int(shift[-1]), 0) + 1):
            command = queue[i]
            k, phase = divmod(i, per_tick)
            if phase == 0 and k < ticks:
                qs[k], vs[k] = data.qpos, data.qvel
            if i in sampled:
                n = sampled[i]
                mujoco.mj_forward(model, data)
                force[n] = data.actuator_force
                clean[n] = data.qpos * one["sensor_gain"] + one["sensor_offset"]
                speed[n] = data.qvel * one["sensor_gain"]
            friction.step()
    return Run((np.arange(ticks) * per_tick + shift) * h, clean, speed, force, qs, vs)


def _arriving(p: Rows, ctrl: Array, per_tick: int, h: float) -> Array:
    """What reaches the servos at each step, [steps, 7]: late by whole steps, then scaled and shifted."""
    steps = np.arange((len(ctrl) + 1) * per_tick)[:, None] - np.round(p["delay"] / h).astype(int)
    k = np.clip(steps // per_tick, 0, len(ctrl) - 1)
    return ctrl[k, np.arange(ctrl.shape[1])] * p["gain"] + p["offset"]


def _resistance(p: Rows) -> list[Callable[[Array, Array], Array]]:
    """Smooth resistances of the joints to (q, v), leaving out what none has."""
    parts: list[Callable[[Array, Array], Array]] = []
    if np.any(p["b_pos"]) or np.any(p["b_neg"]):
        parts.append(lambda q, v: np.where(v > 0, p["b_pos"], p["b_neg"]) * v)
    if np.any(p["spring"]):
        parts.append(lambda q, v: p["spring"] * (q - p["rest"]))
    if np.any(p["cog"]):
        parts.append(lambda q, v: p["cog"] * np.sin(2 * np.pi * q / p["cog_period"]))
    return parts
