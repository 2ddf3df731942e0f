"""A planar chain of one or two bodies by LSODA, on equations of motion in absolute angles.

With phi_k the angle of rod k from hanging down (not from the rod before), x the carriage, J the armatures on relative
joints, and every rod a mass m at c with inertia i and, at its end l, all that comes after it,

    T = 1/2 sum_kj A_kj cos(phi_k - phi_j) phi_k' phi_j' + 1/2 sum_k J_k (phi_k' - phi_k-1')^2
    V = - g sum_k S_k cos(phi_k - tilt).

Lagrange's equations in phi, with torques tau_k - tau_k+1, are solved for phi''. Dry friction is a stiff law,
level * tanh(v / CREEP): it holds but for a creep of at most CREEP. Stribeck's curve is Gaussian. A transmission with
play or elasticity has a rotor of its own. Commands that lag decay exactly.

Source of the integrator: LSODA, A. C. Hindmarsh, ODEPACK, 1983, which switches to a stiff method by itself.
"""

from collections.abc import Callable, Mapping
from math import cos, exp, pi, sin, tanh

import numpy as np
from scipy.integrate import odeint

from tools.studies.blind.plants import Array, G
from tools.studies.foreign.scenes import Scene

CREEP = {"slide": 1e-5, "hinge": 1e-4}  # [m/s or rad/s] to which dry friction holds
RTOL, ATOL = 1e-7, 1e-9
Accelerate = Callable[[list[float], list[float], list[float]], list[float]]


class Stiff:
    """See loop.Engine.

    Args:
        scene: Of one or two joints; a carriage stands alone.
        p: One row of parameters (see scenes.parameters).
    """

    step = 0.0

    def __init__(self, scene: Scene, p: Mapping[str, Array]) -> None:
        self.scene, self.drives, self.n = scene, len(scene.actuators), scene.n
        self.p = {k: [float(x) for x in np.atleast_1d(v[0])] for k, v in p.items()}
        self.creep = [CREEP[kind] for kind in scene.kinds]
        self.elastic = self.p["elastic"][0] > 0  # only the first joint may be
        inertia = [0.0 if self.elastic and j == 0 else x for j, x in enumerate(self.p["armature"])]
        self.accelerate = _slide(self.p, inertia) if scene.kinds[0] == "slide" else _rods(self.p, inertia)
        self.time, self.y = 0.0, np.zeros(2 * self.n)
        self.lagged = self.target = [0.0] * self.drives

    @property
    def q(self) -> Array:
        return self.y[: self.n].copy()

    @property
    def v(self) -> Array:
        return self.y[self.n : 2 * self.n].copy()

    def force(self, command: Array) -> Array:
        reached = [old if lag else new for new, old, lag in zip(command, self.lagged, self.p["lag"], strict=False)]
        y = self.y.tolist()
        return np.array([self._drive(j, reached[j], *self._rotor(y, j), self.time) for j in range(self.drives)])

    def reset(self, q: Array, v: Array, command: Array) -> None:
        self.y = np.concatenate([q, v, *([q[:1], v[:1]] if self.elastic else [])]).astype(float)
        self.lagged, self.time = [float(x) for x in command], 0.0

    def advance(self, command: Array, seconds: float) -> None:
        self.target = [float(x) for x in command]
        out = odeint(self._slope, self.y, [0.0, seconds], tfirst=True, rtol=RTOL, atol=ATOL, mxstep=20000)
        self.y = out[1]
        self.lagged = self._reached(seconds)
        self.time += seconds

    def _reached(self, t: float) -> list[float]:
        """Commands after their lag."""
        lag = self.p["lag"]
        return [u if not lag[j] else u + (self.lagged[j] - u) * exp(-t / lag[j]) for j, u in enumerate(self.target)]

    def _rotor(self, y: list[float], j: int) -> tuple[float, float]:
        """Position and speed of what a drive turns."""
        return (y[2 * self.n], y[2 * self.n + 1]) if self.elastic and j == 0 else (y[j], y[self.n + j])

    def _drive(self, j: int, command: float, q: float, v: float, time: float) -> float:
        p = self.p
        force = p["kp"][j] * (command - q) - p["kv"][j] * v if self.scene.servo else p["gear"][j] * command
        if p["warmth"][0]:
            force *= 1 + p["warmth"][0] * (exp(-(p["clock"][0] + time) / p["warmth_time"][0]) - p["warmth_mean"][0])
        return min(max(force, -p["limit"][j]), p["limit"][j])

    def _slope(self, t: float, y: Array) -> list[float]:
        n, state = self.n, y.tolist()
        q, v, command = state[:n], state[n : 2 * n], self._reached(t)
        tau = [0.0] * n
        for j in range(self.drives):
            tau[j] = self._drive(j, command[j], *self._rotor(state, j), self.time + t)
        more: list[float] = []
        if self.elastic:
            rotor, speed = state[2 * n :]
            load = self._transmitted(rotor - q[0], speed - v[0])
            more = [speed, (tau[0] - load) / self.p["armature"][0]]
            tau[0] = load
        push = [tau[j] - self._resistance(j, q[j], v[j], tau[j]) for j in range(n)]
        return [*v, *self.accelerate(q, v, push), *more]

    def _transmitted(self, twist: float, rate: float) -> float:
        """Force through spring and play; it never pulls back across the play."""
        p = self.p
        beyond = twist - min(max(twist, -p["gap"][0]), p["gap"][0])
        if not beyond:
            return 0.0
        force = p["stiffness"][0] * beyond + p["twist_damping"][0] * rate
        return 0.0 if p["gap"][0] and force * beyond < 0 else force

    def _resistance(self, j: int, q: float, v: float, load: float) -> float:
        """All that resists at a joint."""
        p = self.p
        force = (p["b_pos"][j] if v > 0 else p["b_neg"][j]) * v + p["quad"][j] * v * abs(v)
        if p["spring"][j]:
            force += p["spring"][j] * (q - p["rest"][j])
        if p["cog"][j]:
            force += p["cog"][j] * sin(2 * pi * q / p["cog_period"][j])
        level = p["c_pos"][j] if v > 0 else p["c_neg"][j]
        if p["wave"][j]:
            level *= 1 + p["wave"][j] * sin(2 * pi * q / p["wave_period"][j])
        level += p["load"][j] * abs(load)
        if p["static"][j]:
            ratio = v / p["stribeck_speed"][j]
            level += p["kinetic"][j] + (p["static"][j] - p["kinetic"][j]) * exp(-min(ratio * ratio, 700.0))
        return force + level * tanh(v / self.creep[j]) if level else force


def _slide(p: Mapping[str, list[float]], armature: list[float]) -> Accelerate:
    """A carriage on a rail that may be tilted."""
    weight = p["m"][0] + p["payload"][0]
    total, down = weight + armature[0], weight * G * sin(p["tilt"][0])
    return lambda q, v, push: [(push[0] + down) / total]


def _rods(p: Mapping[str, list[float]], armature: list[float]) -> Accelerate:
    """One or two rods; relative joint angles and torques in, relative accelerations out."""
    m, c, i, end, load, tilt = p["m"], p["c"], p["i"], p["l"], p["payload"][0], p["tilt"][0]
    last = len(m) - 1
    about = [i[k] + m[k] * c[k] ** 2 for k in range(last + 1)]  # A_kk and S_k, to which comes what hangs at the end
    first = [m[k] * c[k] for k in range(last + 1)]
    about[last] += load * end[last] ** 2
    first[last] += load * end[last]
    if not last:
        total, moment = about[0] + armature[0], first[0] * G
        return lambda q, v, push: [(push[0] - moment * sin(q[0] - tilt)) / total]
    beyond = m[1] + load
    about[0] += beyond * end[0] ** 2
    first[0] += beyond * end[0]
    across, j0, j1 = end[0] * first[1], armature[0], armature[1]

    def accelerate(q: list[float], v: list[float], push: list[float]) -> list[float]:
        one, two, w1, w2 = q[0], q[0] + q[1], v[0], v[0] + v[1]
        coupled, turned = across * cos(one - two) - j1, across * sin(one - two)
        m11, m22 = about[0] + j0 + j1, about[1] + j1
        f1 = push[0] - push[1] - turned * w2 * w2 - G * first[0] * sin(one - tilt)
        f2 = push[1] + turned * w1 * w1 - G * first[1] * sin(two - tilt)
        det = m11 * m22 - coupled * coupled
        a1, a2 = (m22 * f1 - coupled * f2) / det, (m11 * f2 - coupled * f1) / det
        return [a1, a2 - a1]

    return accelerate
