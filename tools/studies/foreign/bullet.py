"""A planar chain in PyBullet: its solver, joint damping, motors as dry friction, gravity, links, limits of joints.

The chain is written as URDF. What the engine does itself: damping of joints (`changeDynamics`); dry friction, as a
velocity motor that wants rest and has no more force than the friction, so that it truly holds (the `friction` of a URDF
does nothing once the motors that PyBullet starts with are off); a payload, as a link that is fixed to the last one;
tilted gravity; the play of a gear, as the limits of a joint. A drive is a torque before each step; what the engine has
no law for (drag, cogging, a spring) is added to it from the speed and position of the step before. The step is first
order in time, and STEP is short enough that this is an imperfection like others: see the tests.

Source: E. Coumans, Y. Bai, PyBullet, a Python module for physics simulation, 2016-2025.
"""

import tempfile
from collections.abc import Mapping
from functools import cache
from math import cos, exp, pi, sin
from pathlib import Path
from typing import Any

import numpy as np

from tools.studies.blind.plants import Array, G
from tools.studies.foreign.loop import Unable
from tools.studies.foreign.scenes import Scene

STEP = 5e-5  # [s]
SPECK = 1e-6  # [kg], [kg m^2] PyBullet wants every link to have a mass and an inertia
FASTEST = 1e4  # [rad/s or m/s] to which PyBullet would clip


@cache
def client() -> Any:
    """The engine, connected once a process.

    Raises:
        ValueError: If it is not installed.
    """
    try:
        import pybullet  # type: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError("the ground pybullet needs PyBullet: pip install 'mpc_sgft[foreign]'") from error
    pybullet.connect(pybullet.DIRECT)
    return pybullet


class Bullet:
    """See loop.Engine. One machine at a time is in the engine: the one that was reset last.

    Args:
        scene: The kind of machine; only its first joint may have an armature, a play or a spring behind its drive.
        p: One row of parameters (see scenes.parameters).
    """

    step = STEP

    def __init__(self, scene: Scene, p: Mapping[str, Array]) -> None:
        self.scene, self.drives, self.n = scene, len(scene.actuators), scene.n
        self.p = {k: [float(x) for x in np.atleast_1d(v[0])] for k, v in p.items()}
        if any(self.p["armature"][1:]):
            raise Unable(
                f"{scene.name}: an armature of {self.p['armature'][1:]} behind the first joint; only 0 is possible"
            )
        self.elastic = self.p["elastic"][0] > 0
        self.engine = client()
        self.text = urdf(scene, self.p, self.elastic)
        self.smooth = all(a == b for a, b in zip(self.p["b_pos"], self.p["b_neg"], strict=True))
        self.smooth &= not any(any(self.p[k]) for k in ("quad", "spring", "cog"))
        self.varying = [
            j for j in range(self.n) if any(self.p[k][j] for k in ("load", "static", "wave")) or not self._same(j)
        ]
        self.time, self.lagged = 0.0, [0.0] * self.drives
        self.states: list[tuple[float, float]] = [(0.0, 0.0)] * (self.n + self.elastic)

    def _same(self, j: int) -> bool:
        return self.p["c_pos"][j] == self.p["c_neg"][j]

    @property
    def q(self) -> Array:
        return np.array([q for q, _ in self._links()])

    @property
    def v(self) -> Array:
        return np.array([v for _, v in self._links()])

    def _links(self) -> list[tuple[float, float]]:
        """Position and speed of each joint; of the first one behind its transmission."""
        if not self.elastic:
            return self.states
        (rotor, speed), (twist, rate), *rest = self.states
        return [(rotor + twist, speed + rate), *rest]

    def force(self, command: Array) -> Array:
        lag = self.p["lag"]
        reached = [old if lag[j] else float(new) for j, (new, old) in enumerate(zip(command, self.lagged, strict=True))]
        return np.array([self._drive(j, reached[j]) for j in range(self.drives)])

    def reset(self, q: Array, v: Array, command: Array) -> None:
        b = self.engine
        b.resetSimulation()
        b.setPhysicsEngineParameter(enableFileCaching=0, numSolverIterations=100, numSubSteps=0)
        b.setTimeStep(STEP)
        tilt = self.p["tilt"][0]
        b.setGravity(G * sin(tilt), 0, -G * cos(tilt))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "machine.urdf"
            path.write_text(self.text)
            self.body = b.loadURDF(str(path), useFixedBase=True, flags=b.URDF_USE_INERTIA_FROM_FILE)
        count = b.getNumJoints(self.body)
        for link in range(-1, count):
            b.changeDynamics(self.body, link, linearDamping=0, angularDamping=0, jointDamping=0)
        self.joints = [k for k in range(count) if b.getJointInfo(self.body, k)[2] != b.JOINT_FIXED]
        places = [0.0] if self.elastic else []
        for k, joint in enumerate(self.joints):
            b.changeDynamics(self.body, joint, maxJointVelocity=FASTEST)
            mine = k if not self.elastic else max(k - 1, 0)  # the joint of ours that this one belongs to
            if not (self.elastic and k < 2):
                b.changeDynamics(self.body, joint, jointDamping=min(self.p["b_pos"][mine], self.p["b_neg"][mine]))
            hold = 0.0 if self.elastic and k == 1 else self.p["c_pos"][mine]
            b.setJointMotorControl2(self.body, joint, b.VELOCITY_CONTROL, targetVelocity=0, force=hold)
        positions = [float(q[0]), *places, *(float(x) for x in q[1:])]
        speeds = [float(v[0]), *places, *(float(x) for x in v[1:])]
        for joint, x, w in zip(self.joints, positions, speeds, strict=True):
            b.resetJointState(self.body, joint, x, w)
        self.states = list(zip(positions, speeds, strict=True))
        self.lagged, self.time = [float(x) for x in command], 0.0

    def advance(self, command: Array, seconds: float) -> None:
        b, lag = self.engine, self.p["lag"]
        target = [float(x) for x in command]
        keep = [exp(-STEP / x) if x else 0.0 for x in lag]
        for _ in range(round(seconds / STEP)):
            self.lagged = [u + (old - u) * k for u, old, k in zip(target, self.lagged, keep, strict=False)]
            loads = [self._drive(j, u) for j, u in enumerate(self.lagged)] + [0.0] * (self.n - self.drives)
            push = loads if self.smooth else [x - self._extra(j) for j, x in enumerate(loads)]
            if self.varying:
                self._vary(loads)
            if self.elastic:
                push = [push[0], self._spring(), *push[1:]]
                self._damp()
            b.setJointMotorControlArray(self.body, self.joints, b.TORQUE_CONTROL, forces=push)
            b.stepSimulation()
            self.states = [s[:2] for s in b.getJointStates(self.body, self.joints)]
            self.time += STEP

    def _drive(self, j: int, command: float) -> float:
        p, (q, v) = self.p, self.states[j + (self.elastic and j > 0)]
        force = p["kp"][j] * (command - q) - p["kv"][j] * v if self.scene.servo else p["gear"][j] * command
        if p["warmth"][0]:
            force *= 1 + p["warmth"][0] * (
                exp(-(p["clock"][0] + self.time) / p["warmth_time"][0]) - p["warmth_mean"][0]
            )
        return min(max(force, -p["limit"][j]), p["limit"][j])

    def _spring(self) -> float:
        """What drives the link behind an elastic transmission; in a play nothing does but its limits."""
        twist, rate = self.states[1]
        return 0.0 if self.p["gap"][0] else -self.p["stiffness"][0] * twist - self.p["twist_damping"][0] * rate

    def _damp(self) -> None:
        """Damping of the first joint behind its transmission: the link moves against the world, not the rotor."""
        b, force = self.engine, -min(self.p["b_pos"][0], self.p["b_neg"][0]) * self._links()[0][1]
        if self.scene.kinds[0] == "slide":
            b.applyExternalForce(self.body, self.joints[1], [force, 0, 0], [0, 0, 0], b.LINK_FRAME)
        else:
            b.applyExternalTorque(self.body, self.joints[1], [0, -force, 0], b.WORLD_FRAME)

    def _extra(self, j: int) -> float:
        """What resists beside damping and dry friction."""
        p, (q, v) = self.p, self._links()[j]
        more = (p["b_pos"][j] if v > 0 else p["b_neg"][j]) - min(p["b_pos"][j], p["b_neg"][j])
        force = more * v + p["quad"][j] * v * abs(v) + p["spring"][j] * (q - p["rest"][j])
        return force + (p["cog"][j] * sin(2 * pi * q / p["cog_period"][j]) if p["cog"][j] else 0.0)

    def _vary(self, loads: list[float]) -> None:
        """Set the motors that are dry friction to a level that depends on load, position or speed."""
        p, links, b = self.p, self._links(), self.engine
        for j in self.varying:
            q, v = links[j]
            level = p["c_pos"][j] if v > 0 else p["c_neg"][j]
            if p["wave"][j]:
                level *= 1 + p["wave"][j] * sin(2 * pi * q / p["wave_period"][j])
            level += p["load"][j] * abs(loads[j])
            if p["static"][j]:
                ratio = v / p["stribeck_speed"][j]
                level += p["kinetic"][j] + (p["static"][j] - p["kinetic"][j]) * exp(-min(ratio * ratio, 700.0))
            joint = self.joints[j + (self.elastic and j > 0)]
            b.setJointMotorControl2(self.body, joint, b.VELOCITY_CONTROL, targetVelocity=0, force=level)


def urdf(scene: Scene, p: Mapping[str, list[float]], elastic: bool) -> str:
    """The machine as PyBullet gets it. The first joint's armature is part of its body, or a rotor before it."""
    links, joints, before, up = [_link("base", 1.0, 0.0, 1.0)], [], "base", 0.0
    for j in range(scene.n):
        mass, centre, inertia = p["m"][j], p["c"][j], p["i"][j]
        sliding, extra = scene.kinds[j] == "slide", p["armature"][j]
        if extra and elastic:
            links.append(_link("rotor", extra if sliding else SPECK, 0.0, 1.0 if sliding else extra))
            joints.append(_joint("rotor", before, "rotor", sliding, up))
            before, up = "rotor", 0.0
        elif extra:
            mass, inertia = (mass + extra, inertia) if sliding else (mass, inertia + extra)
        name, gap = f"body{j}", p["gap"][0] if elastic and j == 0 else 0.0
        links.append(_link(name, mass, -centre, inertia))
        joints.append(_joint(scene.joints[j], before, name, sliding, up, gap))
        before, up = name, p["l"][j]
    if p["payload"][0]:
        links.append(_link("payload", p["payload"][0], 0.0, 1e-12))
        at = f'<origin xyz="0 0 {-up:.9g}"/><parent link="{before}"/><child link="payload"/>'
        joints.append(f'<joint name="payload" type="fixed">{at}</joint>')
    return f'<robot name="{scene.name}">\n' + "\n".join([*links, *joints]) + "\n</robot>\n"


def _link(name: str, mass: float, height: float, inertia: float) -> str:
    turn = " ".join(f'i{a}{b}="{inertia if a == b else 0.0:.12g}"' for a, b in ("xx", "yy", "zz", "xy", "xz", "yz"))
    body = f'<origin xyz="0 0 {height:.9g}"/><mass value="{mass:.9g}"/><inertia {turn}/>'
    return f'<link name="{name}"><inertial>{body}</inertial></link>'


def _joint(name: str, parent: str, child: str, sliding: bool, up: float, gap: float = 0.0) -> str:
    kind, axis = ("prismatic", "1 0 0") if sliding else ("revolute" if gap else "continuous", "0 -1 0")
    low, high = (-gap, gap) if gap else (1.0, -1.0)  # turned round: without limits
    limits = f'<limit lower="{low:.9g}" upper="{high:.9g}" effort="1e9" velocity="{FASTEST:g}"/>'
    at = f'<origin xyz="0 0 {-up:.9g}"/><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
    return f'<joint name="{name}" type="{kind}">{at}{limits}</joint>'
