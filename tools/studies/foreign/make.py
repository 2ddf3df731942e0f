"""Turns drawn cases of a foreign engine into data: flaws below what matters, effects above it, what encoders read.

An effect is *detectable* here at the size at which it changes measured trajectories within windows (see blind/detect)
by the noise floor or by what matters, whichever is more, on the joint where it shows most.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from tools.studies.blind.alike import SAME, left_of, rivals_leave
from tools.studies.blind.detect import LEAD, WINDOW, detectable, window_starts
from tools.studies.blind.draw import COUNT, NOISE, Given
from tools.studies.blind.flaws import WINDOW as LONG
from tools.studies.blind.flaws import Flaw, as_label, below, beside, draw_flaws, put
from tools.studies.blind.library import EVERYTHING
from tools.studies.blind.made import WILD, Ground
from tools.studies.blind.made import label as label_of
from tools.studies.blind.plants import Array
from tools.studies.blind.score import CLEAR
from tools.studies.foreign.control import Tracking, left_alone, motion
from tools.studies.foreign.draw import Case, redraw
from tools.studies.foreign.loop import Engine, Record, Sensor, Unable, simulate
from tools.studies.foreign.scenes import SCENES, Scene, build, parameters

ATTEMPTS = 40  # to draw a case whose effects matter
EQUAL = 0.1  # detectable sizes: names that leave no more of a trace than this are one name to these equations
FELT = 0.01  # noise of a measured force, of the typical force
SWING = (0.4, 1.3)  # [rad] from which machines are let go
Rows = dict[str, Array]
Engines = Callable[[Scene, Mapping[str, Array]], Engine]


class Made(NamedTuple):
    """A finished case: what was asked for, columns [T] of each file, model, and what the label says of it."""

    case: Case
    episodes: list[dict[str, Array]]
    model: str
    truth: list[dict[str, Any]]
    more: dict[str, Any]


class Ways(NamedTuple):
    """How cases are made: in which engine, on which scenes (name -> how often), on what ground."""

    engine: Engines
    scenes: Mapping[str, float]
    ground: Ground


def make(cases: list[Case], progress: Callable[[float], object] = lambda n: None, *, ways: Ways) -> list[Made]:
    """All cases, in their order; another is drawn in place of one whose effects cannot be made to matter.

    Args:
        cases: As `draw.draw` gives them.
        progress: Called with 1 for each that is finished.
        ways: How.

    Raises:
        ValueError: If a case fails in all attempts.
    """
    out = []
    for case in cases:
        for attempt in range(1, ATTEMPTS + 1):
            made = _Maker(case, ways).finish()
            if made is not None:
                out.append(made)
                break
            case = redraw(case.entropy, case.group, ways.scenes, ways.ground.mix, attempt)
        else:
            raise ValueError(f"{case.name}: no effect matters in {ATTEMPTS} attempts")
        progress(1)
    return out


class _Maker:
    """One case on its way."""

    def __init__(self, case: Case, ways: Ways) -> None:
        self.case, self.ways, self.scene = case, ways, SCENES[case.scene]
        self.xml = build(self.scene, case.nominal)
        self.model = mujoco.MjModel.from_xml_string(self.xml)
        self.nominal = parameters(self.scene, case.nominal)
        self.ticks = [round(s / case.dt) for s in case.seconds]
        rng = np.random.default_rng((*case.entropy, 12))
        self.motions = [motion(self.scene, n, case.dt, rng) for n in self.ticks]
        if case.swings:
            for followed in self.motions:
                side = rng.choice([-1.0, 1.0], self.scene.n)
                followed.position[0] = side * rng.uniform(*SWING, self.scene.n) / np.arange(1, self.scene.n + 1)
                followed.velocity[0] = 0.0
        sd = np.array([NOISE[k][case.noise] for k in self.scene.kinds])
        self.count = np.array([COUNT[k][case.noise] for k in self.scene.kinds])
        self.sensors = [Sensor(sd * rng.standard_normal((n, self.scene.n)), self.count) for n in self.ticks]
        self.floor = np.sqrt(sd**2 + self.count**2 / 12)

    def finish(self) -> Made | None:
        """The case; None where an effect cannot be made to matter, or the machine runs wild."""
        case = self.case
        calm = self._run(self.nominal)
        if calm is None:
            return None
        scales = self._scales(calm)
        flaws = self._add_flaws(calm, scales)
        calm = self._run(self.nominal)
        if calm is None:
            return None
        sizes, units = [], []
        for given in case.effects:
            entry, scale = EVERYTHING[given.name], scales[given.joint]
            unit = self._detectable(given, calm, scale)
            size = max(unit * given.multiple, entry.smallest)
            if not size <= entry.largest(scale):  # or not a number
                return None
            step = self.ways.engine(self.scene, self.nominal).step
            if given.name == "actuator_delay" and step:
                size = float(np.ceil(size / step - 1e-9) * step)  # as it acts
            sizes.append(size)
            units.append(unit)
        truth = self._truth(calm, scales, sizes, units)
        record = self._run(self._hide(zip(case.effects, sizes, strict=True), scales))
        if record is None or any(t["left"] < CLEAR for t in truth):
            return None
        return Made(case, self._columns(record, scales), self.xml, truth, {"flaws": flaws})

    def _hide(self, effects: Any, scales: list[dict[str, float]]) -> Rows:
        """Parameters of reality with these (effect, size) pairs."""
        p = {k: v.copy() for k, v in self.nominal.items()}
        for given, size in effects:
            EVERYTHING[given.name].apply(p, np.array([0]), given.joint, size, given.shape, scales[given.joint])
        return p

    def _run(self, p: Rows) -> list[Record] | None:
        """All episodes; None if the machine runs wild."""
        out = []
        for ticks, followed, sensor in zip(self.ticks, self.motions, self.sensors, strict=True):
            control = left_alone(len(self.scene.actuators))
            if not self.case.swings:
                control = Tracking(self.scene, self.model, followed, self.case.dt)
            first = followed.position[0].copy(), followed.velocity[0].copy()
            record = simulate(self.ways.engine(self.scene, p), p, first, ticks, self.case.dt, control, sensor)
            bounds = np.array([WILD[k] for k in self.scene.kinds])
            if not np.isfinite(record.read).all() or (np.abs(record.read) > bounds).any():
                return None
            out.append(record)
        return out

    def _scales(self, calm: list[Record]) -> list[dict[str, float]]:
        """Typical force, speed, … of each joint in the runs without effects (see blind/library)."""
        q, v = (np.concatenate([getattr(r, k) for r in calm]) for k in ("q", "v"))
        a = np.concatenate([np.gradient(r.v, self.case.dt, axis=0) for r in calm])
        driven = np.concatenate([r.force for r in calm])
        data, mass = mujoco.MjData(self.model), np.zeros((self.scene.n, self.scene.n))
        data.qpos[:] = q[len(q) // 2]
        mujoco.mj_forward(self.model, data)
        mujoco.mj_fullM(self.model, data, mass)
        out = []
        for j in range(self.scene.n):
            has = j < len(self.scene.actuators)
            force = float(np.sqrt(np.mean(driven[:, j] ** 2))) if has and not self.case.swings else 0.0
            force = force or float(mass[j, j] * np.sqrt(np.mean(a[:, j] ** 2)))
            gain = float(self.nominal["kp" if self.scene.servo else "gear"][0, j]) if has else 1.0
            peak = float(np.abs(driven[:, j]).max()) if has else force
            numbers = {"F": force, "V": float(np.sqrt(np.mean(v[:, j] ** 2))), "top": float(np.abs(v[:, j]).max())}
            numbers |= {"Q": float(np.ptp(q[:, j])), "J": float(mass[j, j]), "U": force / gain if has else 0.0}
            numbers |= {
                "M": float(self.nominal["m"][0, -1]),
                "peak": max(peak, 1e-6),
                "seconds": sum(self.case.seconds),
            }
            out.append({k: max(x, 1e-6) for k, x in numbers.items()} | {"gear": 1.0 if self.scene.servo else gain})
        return out

    def _add_flaws(self, calm: list[Record], scales: list[dict[str, float]]) -> list[dict[str, Any]]:
        """Put small imperfections into reality; what the label says of them."""
        border = self.ways.ground.border
        spread = np.concatenate([r.q for r in calm]).std(0)
        self.asked = np.maximum(self.floor, border * spread)
        rng = np.random.default_rng((*self.case.entropy, 13))
        force = self.case.force_channel
        drawn = draw_flaws(self.scene, scales, rng, late="actuator_delay", force=force)
        flaws = beside(drawn, self.case.effects)
        felt = border * np.concatenate([r.force for r in calm]).std(0) if force else None
        if self.case.swings:
            flaws = [f for f in flaws if not f.name.startswith("actuator")]

        def moves(chosen: list[list[Flaw]]) -> Array:
            p = {k: v.copy() for k, v in self.nominal.items()}
            put(chosen[0], p, np.array([0]), scales)
            return np.array([rms(self._trace(p, calm, border * spread, LONG, felt, every=2))])

        (flaws,), (moved,) = below([flaws], moves)
        put(flaws, self.nominal, np.array([0]), scales)
        return as_label(flaws, moved)

    def _trace(
        self,
        p: Rows,
        calm: list[Record],
        floor: Array,
        window: float = WINDOW,
        force_floor: Array | None = None,
        every: int = 1,
    ) -> Array:
        """What these parameters change in what is measured, as `blind.detect.trace` says it, [W, T, n + a].

        Reality begins where its encoders read what they read in the run without effects: names are compared on the same
        data, and by how little dry friction holds shows a turned encoder to be a tilt. Of `every` windows one is
        looked at.
        """
        dt = self.case.dt
        lead, total = round(LEAD / dt), round((LEAD + window) / dt)
        seconds, owner = np.array(self.case.seconds), np.zeros(len(calm), int)
        real, model = self.ways.engine(self.scene, p), self.ways.engine(self.scene, self.nominal)
        out = []
        for row, k in zip(*(x[::every] for x in window_starts(seconds, owner, dt, window)), strict=True):
            ctrl = calm[row].ctrl[k : k + total]
            first = _read_as(p, calm[row].clean[k], calm[row].clean_speed[k])
            one = simulate(real, p, first, len(ctrl), dt, ctrl)
            begin = one.clean[lead], one.clean_speed[lead]
            two = simulate(model, self.nominal, begin, len(ctrl) - lead, dt, ctrl[lead:])
            apart = (one.clean[lead:] - two.clean) / floor
            if force_floor is not None:
                apart = np.concatenate([apart, (one.force[lead:] - two.force) / force_floor], 1)
            out.append(np.where(np.isfinite(apart), apart, 1e6))
        least = min(len(x) for x in out)
        return np.stack([x[:least] for x in out])

    def _detectable(self, given: Given, calm: list[Record], scale: dict[str, float]) -> float:
        entry = EVERYTHING[given.name]
        scales = [scale] * self.scene.n
        guess, largest, smallest = (np.array([x]) for x in (entry.guess(scale), entry.largest(scale), entry.smallest))

        def ratio(sizes: Array) -> Array:
            return np.array([rms(self._trace(self._hide([(given, float(sizes[0]))], scales), calm, self.asked))])

        found = detectable(ratio, guess, largest, smallest)
        return float(found[0])

    def _truth(
        self, calm: list[Record], scales: list[dict[str, float]], sizes: list[float], units: list[float]
    ) -> list[dict[str, Any]]:
        """For the labels: each effect with its weight, what others cannot make up for, and names that are as good."""
        a = len(self.scene.actuators)
        felt = np.array([FELT * s["F"] if self.case.force_channel else np.inf for s in scales[:a]])

        def traces(jobs: list[tuple[int, Given | None, float]]) -> list[Array]:
            out = []
            for _, given, size in jobs:
                try:
                    out.append(self._trace(self._hide([(given, size)], scales), calm, self.asked, force_floor=felt))
                except Unable:  # a rival that this reality cannot have
                    out.append(np.zeros_like(own[0]))
            return out

        effects, own = self.case.effects, []
        own = traces([(0, g, x) for g, x in zip(effects, sizes, strict=True)])
        lefts = [left_of(t, own[:k] + own[k + 1 :]) for k, t in enumerate(own)]
        if any(x < CLEAR for x in lefts):  # another case will be drawn
            return [{"left": x} for x in lefts]
        left = rivals_leave(self.scene, [self.case], [sizes], [scales], traces)[0] if effects else []
        out = []
        for g, size, unit, rivals, t, mine in zip(effects, sizes, units, left, own, lefts, strict=True):
            names, same = ([n for n, x in rivals.items() if x < limit] for limit in (SAME, EQUAL))
            said = label_of(g, size, unit, scales[g.joint], names)
            out.append({**said, "equal": same, "weight": rms(t), "left": mine})
        return out

    def _columns(self, record: list[Record], scales: list[dict[str, float]]) -> list[dict[str, Array]]:
        """What is in the files."""
        case, scene, rng = self.case, self.scene, np.random.default_rng((*self.case.entropy, 14))
        out = []
        for r in record:
            columns = {"time": np.arange(len(r.q)) * case.dt}
            columns |= {f"ctrl/{name}": r.ctrl[:, j] for j, name in enumerate(scene.actuators)}
            columns |= {f"qpos/{name}": r.read[:, j] for j, name in enumerate(scene.joints)}
            for j, name in enumerate(scene.joints if case.speed_channel else ()):
                noise = 100.0 * self.floor[j] * rng.standard_normal(len(r.q))  # as a differentiated encoder has it
                columns[f"qvel/{name}"] = r.clean_speed[:, j] + noise
            for j, name in enumerate(scene.actuators if case.force_channel else ()):
                noise = FELT * scales[j]["F"] * rng.standard_normal(len(r.q))
                columns[f"force/{name}"] = r.force[:, j] + noise
            out.append(columns)
        return out


def _read_as(p: Rows, position: Array, speed: Array) -> tuple[Array, Array]:
    """Where links are, and how fast, whose encoders read this at once, [n] each."""
    gain = p["sensor_gain"][0]
    return (position - p["sensor_offset"][0]) / gain, speed / gain


def rms(traces: Array) -> float:
    """Root mean square in the channel where it is largest."""
    return float(np.sqrt(np.mean(traces**2, (0, 1))).max())
