"""The nominal model, and what one simulation of it with changed physics needs."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from envs.effects.passive import stiffen_dry_friction
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.matching import Drive, Machine
from mpc_sgft.diagnose.data.measured import Array, Index, Table
from mpc_sgft.diagnose.data.units import Axis
from mpc_sgft.diagnose.simulation.urdf import is_urdf, read_urdf

SHARP = 5e-4  # [s] longest step of a fit that is judged
FORCE = "diagnose/force/"  # sensors that are added for the comparison
SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
KEEPING = [int(getattr(mujoco.mjtDyn, f"mjDYN_{name}")) for name in ("INTEGRATOR", "MUSCLE", "USER")]


@dataclass(frozen=True)
class Change:
    """What a set of effects changes in one simulation.

    Attributes:
        edits: Applied to a copy of the scene, in order.
        commands: f(ctrl [T, nu], dt) -> [T, nu], applied to the recorded commands, in order.
        delay: Seconds by which each actuator's command is late, [nu] or a number.
        lag: Time constant of the low pass that each actuator's command goes through [s], [nu] or a number.
        frictions: f(load [M, nj]) -> level of dry friction [M, nj], set again and again while a simulation runs.
        late: Joint -> seconds by which what is read of it is old.
        reads: f(true signal [M], name) -> what is read of it; affine.
    """

    edits: tuple[Callable[[mujoco.MjSpec], None], ...] = ()
    commands: tuple[Callable[[Array, float], Array], ...] = ()
    delay: Array | float = 0.0
    lag: Array | float = 0.0
    frictions: tuple[Callable[[Array], Array], ...] = ()
    late: Mapping[str, float] = field(default_factory=dict)
    reads: tuple[Callable[[Array, str], Array], ...] = ()

    def __add__(self, other: Change) -> Change:
        return Change(
            self.edits + other.edits,
            self.commands + other.commands,
            self.delay + other.delay,
            self.lag + other.lag,
            self.frictions + other.frictions,
            {j: self.late.get(j, 0.0) + other.late.get(j, 0.0) for j in {**self.late, **other.late}},
            self.reads + other.reads,
        )

    def read(self, values: Array, name: str) -> Array:
        for read in self.reads:
            values = read(values, name)
        return values

    def unread(self, values: Array, name: str) -> Array:
        """The true signal behind a reading: the reads are affine."""
        if not self.reads:
            return values
        zero, one = self.read(np.array([0.0, 1.0]), name)
        return (values - zero) / (one - zero)


@dataclass
class Plant:
    """A scene whose moving joints are all hinges and slides.

    Attributes:
        spec: The nominal scene; never changed, only copied.
        notes: What was decided while loading, in words.
        bare: Whether its format names no actuators, so that joints whose efforts were recorded get motors.
        said: Joints that it says are driven nevertheless.
        model: Compiled from it.
        joints: Names in the model's order.
        actuators: Names in the model's order.
        histories: Lengths of command histories that the scene has and no delay needs, by actuator.
    """

    spec: mujoco.MjSpec
    notes: tuple[str, ...] = ()
    bare: bool = False
    said: tuple[str, ...] = ()
    model: mujoco.MjModel = field(init=False)
    joints: list[str] = field(init=False)
    actuators: list[str] = field(init=False)
    histories: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.spec = self.spec.copy()
        _name_all(self.spec)
        idle = [actuator for actuator in self.spec.actuators if actuator.nsample and not actuator.delay]
        self.histories = {actuator.name: actuator.nsample for actuator in idle}
        for actuator in idle:  # every state of every simulated step would hold it
            actuator.nsample = 0
        there = {sensor.name for sensor in self.spec.sensors}
        for actuator in self.spec.actuators:  # so that a measured force can be compared
            if f"{FORCE}{actuator.name}" in there:
                continue
            self.spec.add_sensor(
                name=f"{FORCE}{actuator.name}",
                type=mujoco.mjtSensor.mjSENS_ACTUATORFRC,
                objtype=mujoco.mjtObj.mjOBJ_ACTUATOR,
                objname=actuator.name,
            )
        self.model = self.spec.compile()
        if not self.model.nv:
            raise UserError("the model has no joint: there is nothing to compare with measurements.")
        if any(t not in SCALAR for t in self.model.jnt_type):
            free = [self.model.joint(i).name for i in range(self.model.njnt) if self.model.jnt_type[i] not in SCALAR]
            raise UserError(f"joint {free[0]!r} is free or a ball: only hinges and slides can be compared with --data.")
        keeping = np.flatnonzero(np.isin(self.model.actuator_dyntype, KEEPING))
        if len(keeping):
            raise UserError(
                f"actuator {self.model.actuator(int(keeping[0])).name!r} keeps an activation that a recording "
                "does not tell (dyntype integrator, muscle or user). Describe what it does at once: for intvelocity a "
                "position servo, with the commands integrated."
            )
        self.joints = [self.model.joint(i).name for i in range(self.model.njnt)]
        self.actuators = [self.model.actuator(i).name for i in range(self.model.nu)]

    @property
    def bodies(self) -> list[str]:
        """Bodies that move and have a mass."""
        m = self.model
        return [m.body(i).name for i in range(1, m.nbody) if m.body_weldid[i] and m.body_mass[i] > 0]

    def axes(self) -> dict[str, Axis]:
        """Joint -> its limits and kind."""
        m, slide = self.model, int(mujoco.mjtJoint.mjJNT_SLIDE)
        limits = np.where(m.jnt_limited[:, None], m.jnt_range, [-np.inf, np.inf])
        return {
            j: Axis(float(low), float(high), m.jnt_type[i] == slide)
            for i, (j, (low, high)) in enumerate(zip(self.joints, limits, strict=True))
        }

    def servos(self) -> dict[str, str]:
        """Actuators whose command is where their joint shall be -> that joint."""
        m = self.model
        found = {a: joint_of(self, a) for i, a in enumerate(self.actuators) if m.actuator_biasprm[i, 1] < 0}
        return {a: j for a, j in found.items() if j and m.actuator(a).gear[0] > 0}

    def machine(self) -> Machine:
        """The names that a recording is matched with."""
        m = self.model
        asks = [
            "position" if bias[1] < 0 else "velocity" if bias[2] < 0 else "effort"
            for bias in m.actuator_biasprm[: m.nu]
        ]
        return Machine(
            self.joints, {a: Drive(joint_of(self, a), q) for a, q in zip(self.actuators, asks, strict=True)}, self.bare
        )

    def notes_of_delays(self) -> list[str]:
        """What must be said of actuators with a delay of their own."""
        late = [a for i, a in enumerate(self.actuators) if self.model.actuator_delay[i] > 0]
        if not late:
            return []
        return [
            f"{', '.join(late)}: the model delays its command, and what is on its way at the start of a window is not "
            "simulated. Leave the delay out of the model (delay=0), and it is found as actuator_delay"
        ]

    def sensors(self) -> list[str]:
        """Sensors of the scene itself that give one number."""
        m = self.model
        names = [m.sensor(i).name for i in range(m.nsensor) if m.sensor_dim[i] == 1]
        return [n for n in names if n and not n.startswith(FORCE)]

    def sharper(self, longest: float = SHARP) -> Plant:
        """The same scene in steps no longer than this [s], with joint friction as dry as these allow.

        MuJoCo's friction of a joint is viscous below a speed that its solref sets, at least twice the step. That is the
        simulator's own error wherever a motion reverses, and larger than an encoder's noise at the usual steps of 2 ms.
        """
        spec = self.spec.copy()
        spec.option.timestep /= max(1, np.ceil(spec.option.timestep / longest - 1e-3))
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # a few joints need none
        if not (self.model.npair or np.any(self.model.geom_contype) or np.any(self.model.geom_conaffinity)):
            spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        for joint in spec.joints:
            stiffen_dry_friction(joint)
        return Plant(spec)

    def compile(self, change: Change) -> mujoco.MjModel:
        """The scene with the changes in it."""
        if not change.edits:
            return self.model
        spec = self.spec.copy()
        for edit in change.edits:
            edit(spec)
        return spec.compile()

    def addresses(self, model: mujoco.MjModel) -> tuple[Index, Index]:
        """Where the measured joints are in qpos and qvel of a (changed) model."""
        ids = [model.joint(name).id for name in self.joints]
        return model.jnt_qposadr[ids], model.jnt_dofadr[ids]


def load_plant(model: str | Path | mujoco.MjModel | mujoco.MjSpec) -> Plant:
    """A plant from an MJCF or URDF file, a spec or the model that was compiled last.

    Raises:
        UserError: If the file is absent or does not load, or the scene cannot be diagnosed.
    """
    if isinstance(model, mujoco.MjSpec):
        return Plant(_rooted(model.copy(), [Path(model.modelfiledir)]))
    try:
        if isinstance(model, mujoco.MjModel):
            return Plant(_decompile(model))
        path = Path(model)
        if not path.is_file():
            raise UserError(f"{path}: no such model file. Give an MJCF or URDF file (--model scene.xml).")
        if is_urdf(path):
            found = read_urdf(path)
            return Plant(found.spec, found.notes, bare=True, said=found.driven)
        return Plant(_rooted(mujoco.MjSpec.from_file(str(path)), _folders(path)))
    except ValueError as error:
        raise UserError(f"{model}: MuJoCo cannot load this scene: {error}") from error


def _rooted(spec: mujoco.MjSpec, folders: Sequence[Path]) -> mujoco.MjSpec:
    """The scene with absolute names of its files, so that a repaired one elsewhere finds them.

    Args:
        spec: Is changed.
        folders: Of the models that it is made of. MuJoCo does not tell of which one a file is: a name stays as it is
            where it is in none of them, or in several.
    """

    def find(folder: str, name: str) -> str:
        name = Path(name).name if spec.strippath else name
        there = {str((f / folder / name).resolve()) for f in folders if name and (f / folder / name).is_file()}
        return there.pop() if len(there) == 1 else name

    for element in (*spec.meshes, *spec.hfields, *spec.skins):
        element.file = find(element.compiler.meshdir, element.file)
    for texture in spec.textures:
        texture.file = find(texture.compiler.texturedir, texture.file)
        texture.cubefiles = [find(texture.compiler.texturedir, name) for name in texture.cubefiles]
    spec.strippath = False
    return spec


def _folders(path: Path) -> list[Path]:
    """The folder of an MJCF file, and those of the models that it attaches."""
    attached = re.findall(r"""<model\s[^>]*?file\s*=\s*["']([^"']+)""", path.read_text(errors="replace"))
    files = [path.parent / name for name in attached]
    return [path.parent, *(folder for file in files if file.is_file() for folder in _folders(file))]


def driven(plant: Plant, tables: Sequence[Table]) -> Plant:
    """A bare plant with motors at the joints whose efforts were recorded as `ctrl/<joint>`; any other as it is."""
    if not plant.bare:
        return plant
    joints = [j for j in plant.joints if any(f"ctrl/{j}" in table.columns for table in tables)]
    if not joints:
        idle = [j for j in plant.said if j in plant.joints]
        note = f"the URDF says that {', '.join(idle)} are driven, and no command was recorded: taken for passive"
        return replace(plant, notes=(*plant.notes, note)) if idle else plant
    spec = plant.spec.copy()
    for joint in joints:
        spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    note = f"a URDF has no actuators: commands are efforts [N m or N] of motors at {', '.join(joints)}"
    return Plant(spec, (*plant.notes, note))


def _decompile(model: mujoco.MjModel) -> mujoco.MjSpec:
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/model.xml"
        try:
            mujoco.mj_saveLastXML(path, model)
            spec = mujoco.MjSpec.from_file(path)
            same = spec.copy().compile()
        except (mujoco.FatalError, ValueError) as error:
            raise UserError(f"this MjModel cannot be turned into MJCF ({error}); pass its file or MjSpec.") from error
    if (same.nq, same.nu, same.nbody) != (model.nq, model.nu, model.nbody):
        raise UserError("this MjModel is not the one that was compiled last; pass its file or MjSpec instead.")
    return spec


def _name_all(spec: mujoco.MjSpec) -> None:
    """Effects sit at names: give one to what has none."""
    named = {"joint": spec.joints, "actuator": spec.actuators, "body": spec.bodies, "geom": spec.geoms}
    for kind, elements in named.items():
        for i, element in enumerate(elements):
            if not element.name:
                element.name = f"{kind}{i}"


def joint_of(plant: Plant, actuator: str) -> str | None:
    """The joint that an actuator drives, None if it drives something else."""
    m = plant.model
    i = m.actuator(actuator).id
    kinds: Sequence[int] = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    return m.joint(m.actuator_trnid[i, 0]).name if m.actuator_trntype[i] in [int(k) for k in kinds] else None
