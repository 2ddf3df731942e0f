"""Fine fixed steps of fourth-order Runge-Kutta, with the switching of dry friction located as events.

State of R machines with n joints: y [5, R, n] = position, velocity, bristle (LuGre, Bouc-Wen), rotor position, rotor
velocity; and the direction of slip s [R, n] in {-1, 0, 1}, where 0 means held by dry friction. Within a step s does not
change, so the equations are smooth. A held joint has exactly zero velocity and acceleration until the force on it
exceeds the friction; a sliding joint whose velocity changes sign stops exactly there and is held or slides back for the
rest of the step. There is no smoothed sign function anywhere.
"""

from typing import NamedTuple

import numpy as np

from tools.studies.blind.plants import Array, Plant, Rows, prepare
from tools.studies.blind.truths import Forces, take

MAX_EVENTS = 8  # switchings of one machine within one step; the last one holds until the step's end


class State(NamedTuple):
    """y [5, R, n] and s [R, n], as above."""

    y: Array
    s: Array


def start(q: Array, v: Array) -> State:
    """Machines at q, v [R, n], bristles relaxed, transmissions untwisted."""
    return State(np.stack([q, v, np.zeros_like(q), q, v]).astype(float), np.sign(v))


class Integrator:
    """Steps a set of machines.

    Args:
        plant: Their kind.
        p: Their parameters.
        h: Step [s].
    """

    def __init__(self, plant: Plant, p: Rows, h: float) -> None:
        self.plant, self.p, self.h = plant, prepare(plant, p), h
        self.forces = Forces(plant, self.p)

    def step(self, state: State, command: tuple[Array, Array, Array], time: float) -> State:
        """One step of h.

        Args:
            state: Now.
            command: What reaches the drive at the start, in the middle and at the end of the step, [R, n] each.
            time: [s] since the rows' start.
        """
        f = self.forces
        if not f.any_dry:
            return State(self._rk4(f, state.y, state.s, command, time, self.h), state.s)
        s = self._release(f, state.y, state.s, command[0], time)
        y = self._rk4(f, state.y, s, command, time, self.h)
        crossed = f.dry & (s != 0) & (y[1] * s < 0)
        hit = np.flatnonzero(crossed.any(1))
        if len(hit):
            s = s.copy()
            y[:, hit], s[hit] = self._through_events(hit, state.y[:, hit], s[hit], command, time)
        return State(y, s)

    def _through_events(
        self, rows: Array, y: Array, s: Array, command: tuple[Array, Array, Array], time: float
    ) -> tuple[Array, Array]:
        """Repeat the step for some machines, stopping at each sign change of a velocity."""
        part = Forces(self.plant, take(self.p, rows))
        held = tuple(c[rows] for c in command)
        rest = np.full(len(rows), self.h)
        for _ in range(MAX_EVENTS):
            new = self._rk4(part, y, s, held, time, rest[:, None])
            crossed = part.dry & (s != 0) & (new[1] * s < 0)
            if not crossed.any():
                return new, s
            change = np.where(crossed, y[1] - new[1], 1.0)
            share = np.where(crossed, np.clip(y[1] / change, 0, 1), np.inf)  # of the step, [r, n]
            first = np.minimum(share.min(1), 1.0)
            short = (rest * first)[:, None]
            new = self._rk4(part, y, s, held, time, short)
            stops = crossed & (share <= first[:, None])
            new[1][stops] = 0.0
            new[4][stops & ~part.elastic] = 0.0
            s = np.where(stops, 0.0, s)
            y, rest = new, rest * (1 - first)
            s = self._release(part, y, s, held[0], time)
        return y, s

    def _release(self, f: Forces, y: Array, s: Array, command: Array, time: float) -> Array:
        """Let go of held joints on which more than the holding force acts, and mark which way they will slide."""
        held = f.dry & (s == 0)
        if not held.any():
            return s
        push, load = self._push(f, y, command, time)  # force on each joint if the held ones stay
        m = self._mass(f, y[0])
        free = np.where(held, 0.0, self._dry(f, y[0], s, load))
        a = _accelerate(m, push - free, held)
        needed = push - np.einsum("rij,rj->ri", m, a)
        level = f.dry_level(y[0], np.sign(needed), load)
        go = held & (np.abs(needed) > level)
        return np.where(go, np.sign(needed), s)

    def _push(self, f: Forces, y: Array, command: Array, time: float) -> tuple[Array, Array]:
        """Everything but dry friction and inertia: force on the links, and the force that the drive transmits."""
        q, v, z, rotor, speed = y
        drive = f.drive(command, rotor, speed, time)
        if f.any_elastic:
            drive = np.where(f.elastic, f.transmitted(rotor - q, speed - v), drive)
        return drive - self.plant.bias(q, v, f.p) - f.resistance(q, v, z), drive

    def _dry(self, f: Forces, q: Array, s: Array, load: Array) -> Array:
        return f.dry_level(q, s, load) * s

    def _mass(self, f: Forces, q: Array) -> Array:
        m = self.plant.mass(q, f.p)
        if f.any_elastic:
            i = np.arange(self.plant.n)
            m[:, i, i] -= np.where(f.elastic, f.p["armature"], 0.0)
        return m

    def _slope(self, f: Forces, y: Array, s: Array, command: Array, time: float) -> Array:
        """dy/dt, [5, R, n]."""
        push, load = self._push(f, y, command, time)
        held = None
        if f.any_dry:
            push = push - self._dry(f, y[0], s, load)
            held = f.dry & (s == 0)
        out = np.empty_like(y)
        out[0], out[1] = y[1], _accelerate(self._mass(f, y[0]), push, held)
        out[2] = f.bending(y[1], y[2]) if f.bends else 0.0
        out[3], out[4] = y[4], out[1]
        if f.any_elastic:
            drive = f.drive(command, y[3], y[4], time)
            inertia = np.where(f.elastic, f.p["armature"], 1.0)
            out[4] = np.where(f.elastic, (drive - load) / inertia, out[1])
        return out

    def _rk4(self, f: Forces, y: Array, s: Array, command: tuple[Array, ...], time: float, h: Array | float) -> Array:
        """One classical Runge-Kutta step; h is one number, or one each row [R, 1]."""
        k1 = self._slope(f, y, s, command[0], time)
        k2 = self._slope(f, y + (0.5 * h) * k1, s, command[1], time)
        k3 = self._slope(f, y + (0.5 * h) * k2, s, command[1], time)
        k4 = self._slope(f, y + h * k3, s, command[2], time)
        return y + (h / 6.0) * (k1 + 2 * (k2 + k3) + k4)


def _accelerate(m: Array, force: Array, held: Array | None) -> Array:
    """a with M a = force, [R, n]; held joints have a = 0 exactly and their rows of the equation do not count."""
    if m.shape[1] == 1:
        a = force / m[:, 0]
        return a if held is None else np.where(held, 0.0, a)
    if held is not None:
        m = np.where(held[:, :, None] | held[:, None, :], 0.0, m)
        m[:, 0, 0] += held[:, 0]
        m[:, 1, 1] += held[:, 1]
        force = np.where(held, 0.0, force)
    det = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 0, 1]
    a = np.empty_like(force)
    a[:, 0] = (m[:, 1, 1] * force[:, 0] - m[:, 0, 1] * force[:, 1]) / det
    a[:, 1] = (m[:, 0, 0] * force[:, 1] - m[:, 0, 1] * force[:, 0]) / det
    return a
