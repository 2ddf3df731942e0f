"""Data of the FR3's cases, one after the other; as `make` does for the other machines.

The arm follows smooth joint references within its limits. A servo of this arm takes its command at its word, so
commands do not depend on what is measured.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from envs.fr3 import DQ_MAX, JOINTS, KP, Q_MAX, Q_MIN, TORQUE_MAX
from tools.studies.blind.detect import LEAD, WINDOW, detectable, window_starts
from tools.studies.blind.draw import COUNT, EPISODE, MULTIPLE, NOISE, Case, Given
from tools.studies.blind.excite import plan, reference
from tools.studies.blind.fr3 import NUMERICS, Arm, Run, build, nominal, reality, simulate
from tools.studies.blind.fr3_draw import LEAST, redraw
from tools.studies.blind.library import EVERYTHING
from tools.studies.blind.made import TIMESTAMP_SD, Made, label
from tools.studies.blind.plants import Array

TICK = 0.004  # [s]
REACH, PACE = 0.85, 0.8  # share of the joints' ranges and speeds that references use
ROUNDS = 4  # of the search for the detectable size
ATTEMPTS = 6  # to draw a case whose effect can be made large enough
LOAD = 3.0  # [kg] that the arm is rated for
EASE = 0.5  # share of the torque limits that what is hidden may take


def make(cases: list[Case], progress: Callable[[float], object] = lambda n: None) -> list[Made]:
    """All cases, in their order.

    Args:
        cases: As `draw` gives them.
        progress: Called with 1 for each that is finished.
    """
    done = []
    for case in cases:
        made = None
        for attempt in range(1, ATTEMPTS + 1):
            made = _Bench(case).finish(last=attempt == ATTEMPTS)
            if made is not None:
                break
            case = redraw(case, attempt)
        assert made is not None, case.name
        done.append(made)
        progress(1)
    return done


class _Bench:
    """One case: its references, and reality with and without what is hidden."""

    def __init__(self, case: Case) -> None:
        self.case, self.xml = case, build()
        model = mujoco.MjModel.from_xml_string(self.xml)
        self.nominal = nominal(model)
        self.numerics = NUMERICS[case.nominal["numerics"]]
        self.masses = {case.nominal["link"]: case.wrong["mass"]} if case.wrong else {}
        self.count = round(EPISODE[case.seconds] / TICK)  # samples of an episode
        self.episodes = self._references(round(case.seconds / EPISODE[case.seconds]))
        sd, step = NOISE["hinge"][case.noise], COUNT["hinge"][case.noise]
        self.sd, self.step, self.floor = sd, step, float(np.sqrt(sd**2 + step**2 / 12))

    def finish(self, last: bool) -> Made | None:
        """The case; None where an effect cannot be made large enough (never if `last`)."""
        calm = [self.run(self.nominal, u, u[0], np.zeros(7)) for u in self.episodes]
        scales = [self._scales(calm, j) for j in range(7)]
        truth, fits = [], True
        for given in self.case.effects:
            entry, scale = EVERYTHING[given.name], scales[given.joint]
            unit, top = self.detectable(given, calm, scale), entry.largest(scale)
            least = LEAST[self.case.group]
            fits &= bool(least * unit <= top)
            # log-uniform between the smallest multiple and the largest that this arm can have
            share = np.log(given.multiple / least) / np.log(MULTIPLE[1] / least)
            size = least * unit * min(MULTIPLE[1] / least, max(top / (least * unit), 1.0)) ** share
            size = float(max(min(size, top), entry.smallest)) if np.isfinite(unit) else top
            if given.name == "actuator_delay":
                size = float(np.ceil(size / self.numerics.step - 1e-9) * self.numerics.step)  # as it acts
            truth.append(label(given, size, unit, scale, []))
        if not fits and not last:
            return None
        p = self.nominal
        for given, said in zip(self.case.effects, truth, strict=True):
            p = self.hide(p, given, said["size"], scales[given.joint])
        rng = np.random.default_rng((*self.case.entropy, 3))
        columns = [self._measure(p, u, scales, rng) for u in self.episodes]
        inside = all(np.isfinite(q).all() and (q > Q_MIN).all() and (q < Q_MAX).all() for _, q in columns)
        if not inside:  # an arm at its stops, or out of control
            assert not last, f"{self.case.name}: left its joints' ranges in {ATTEMPTS} attempts"
            return None
        return Made(self.case, [c for c, _ in columns], truth, [self.floor] * 7)

    def hide(self, p: dict[str, Array], given: Given, size: float, scale: dict[str, float]) -> dict[str, Array]:
        """Parameters with the effect at this size."""
        p = {k: x.copy() for k, x in p.items()}
        EVERYTHING[given.name].apply(p, np.array([0]), given.joint, size, given.shape, scale)
        return p

    def run(self, p: dict[str, Array], ctrl: Array, q: Array, v: Array, late: Array | None = None) -> Run:
        """Reality under these commands."""
        return simulate(reality(self.xml, p, self.numerics, self.masses), p, q, v, ctrl, TICK, late)

    def detectable(self, given: Given, calm: list[Run], scale: dict[str, float]) -> float:
        """Size at which the effect changes as much as the encoders' noise floor, as `detect` defines it [floors]."""
        entry = EVERYTHING[given.name]
        found = detectable(
            lambda sizes: np.array([self.change(given, float(sizes[0]), calm, scale)]),
            *(np.array([x]) for x in (entry.guess(scale), entry.largest(scale), entry.smallest)),
            rounds=ROUNDS,
        )
        return float(found[0])

    def change(self, given: Given, size: float, calm: list[Run], scale: dict[str, float]) -> float:
        """What the effect changes within windows, root mean square, on the joint where it shows most [noise floors]."""
        lead, total = round(LEAD / TICK), round((LEAD + WINDOW) / TICK)
        seconds = np.full(len(calm), EPISODE[self.case.seconds])
        p, moved = self.hide(self.nominal, given, size, scale), []
        for row, k in zip(*window_starts(seconds, np.zeros(len(calm), int), TICK), strict=True):
            ctrl = self.episodes[row][k : k + total]
            real = self.run(p, ctrl, calm[row].q[k], calm[row].v[k])
            model = self.run(self.nominal, ctrl[lead:], real.clean[lead], real.clean_speed[lead])
            moved.append(np.mean(((real.clean[lead:] - model.clean) / self.floor) ** 2, 0))
        ratio = float(np.sqrt(np.mean(moved, 0)).max())
        return ratio if np.isfinite(ratio) else 1e6

    def _references(self, count: int) -> list[Array]:
        """Commands of each episode within the joints' limits, [T, 7]; the last is held to fill a window."""
        rng = np.random.default_rng((*self.case.entropy, 2))
        made = []
        for kinds in plan(rng, count):
            ref = reference(("slow",) if self.case.kind == "short" else kinds, Arm().kinds, self.count, TICK, rng)
            reach = REACH * (Q_MAX - Q_MIN) / 2 / np.maximum(np.abs(ref.position).max(0), 1e-9)
            speed = PACE * np.minimum(DQ_MAX, TORQUE_MAX / (KP * TICK))  # a step of the command stays within the torque
            pace = speed / np.maximum(np.abs(ref.velocity).max(0), 1e-9)
            q = (Q_MIN + Q_MAX) / 2 + np.minimum(1.0, np.minimum(reach, pace)) * ref.position
            more = round((LEAD + WINDOW) / TICK) - len(q)
            made.append(np.concatenate([q, np.repeat(q[-1:], max(more, 0), 0)]))
        return made

    def _scales(self, calm: list[Run], joint: int) -> dict[str, float]:
        """Typical force, speed, … of a joint (see library); forces in shares of what its servo can do."""
        q, v, f = (np.concatenate([getattr(r, k)[: self.count, joint] for r in calm]) for k in ("q", "v", "force"))
        data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(self.xml))
        data.qpos[:] = calm[0].q[self.count // 2]
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        force = EASE * float(TORQUE_MAX[joint])
        return {
            "F": force,
            "V": max(float(np.sqrt(np.mean(v**2))), 1e-4),
            "Q": max(float(np.ptp(q)), 1e-4),
            "J": float(mass[joint, joint]),
            "U": force / float(KP[joint]),
            "M": LOAD,
            "felt": float(np.sqrt(np.mean(f**2))),
        }

    def _measure(
        self, p: dict[str, Array], ctrl: Array, scales: list[dict[str, float]], rng: np.random.Generator
    ) -> tuple[dict[str, Any], Array]:
        """Columns of one file, [T] each, and the true positions, [T, 7]."""
        case, n = self.case, self.count
        late = rng.integers(-1, 2, len(ctrl)) * (np.arange(len(ctrl)) > 0) if case.jitter else None
        run = self.run(p, ctrl, ctrl[0], np.zeros(7), late)
        read = np.round((run.clean + self.sd * rng.standard_normal(run.clean.shape)) / self.step) * self.step
        stamps = run.time[:n] + (TIMESTAMP_SD * rng.standard_normal(n) if case.jitter else 0.0)
        columns = {"time": stamps - stamps[0]}
        columns |= {f"ctrl/{a}": ctrl[:n, j] for j, a in enumerate(Arm().actuators)}
        columns |= {f"qpos/{a}": read[:n, j] for j, a in enumerate(JOINTS)}
        if case.speed_channel:  # as a differentiated encoder has it
            speed = run.clean_speed + 100.0 * self.floor * rng.standard_normal(run.clean_speed.shape)
            columns |= {f"qvel/{a}": speed[:n, j] for j, a in enumerate(JOINTS)}
        if case.force_channel:
            force = run.force + 0.01 * np.array([s["felt"] for s in scales]) * rng.standard_normal(run.force.shape)
            columns |= {f"force/{a}": force[:n, j] for j, a in enumerate(Arm().actuators)}
        return columns, run.q
