"""Cases of one plant on their way to data: sizes from the noise, closed-loop runs, what the encoders read."""

from collections.abc import Callable

import numpy as np

from tools.studies.blind.alike import HEAVIER, Job, Traces, alike, left_of
from tools.studies.blind.detect import LEAD, WINDOW, detectable, size_of, trace, window_starts
from tools.studies.blind.draw import COUNT, EPISODE, NOISE, TICK, Case
from tools.studies.blind.excite import Reference, plan, reference
from tools.studies.blind.flaws import WINDOW as LONG
from tools.studies.blind.flaws import Flaw, as_label, below, beside, draw_flaws, put, weigh
from tools.studies.blind.library import EVERYTHING
from tools.studies.blind.loop import JITTER_STEPS, H, Record, Sensor, Tracking, simulate, start
from tools.studies.blind.made import TIMESTAMP_SD, WILD, Ground, Made, label
from tools.studies.blind.plants import PLANTS, Array, Plant
from tools.studies.blind.score import CLEAR
from tools.studies.blind.truths import join, rows, take


class Batch:
    """Cases of one plant; every episode is a row. Shorter episodes are cut from rows as long as the longest."""

    def __init__(self, cases: list[Case], ground: Ground) -> None:
        self.cases, self.ground = cases, ground
        self.plant: Plant = PLANTS[cases[0].plant]
        self.dt = TICK[self.plant.name]
        counts = [round(c.seconds / EPISODE[c.seconds]) for c in cases]
        self.owner = np.repeat(np.arange(len(cases)), counts)
        self.of = [np.flatnonzero(self.owner == i) for i in range(len(cases))]
        self.length = np.array([EPISODE[cases[i].seconds] for i in self.owner])  # [s], [R]
        self.ticks = round(max(self.length.max(), LEAD + WINDOW) / self.dt)
        self.believed = join([rows(self.plant, c.nominal, n) for c, n in zip(cases, counts, strict=True)])
        self.nominal = {k: v.copy() for k, v in self.believed.items()}
        for case, mine in zip(cases, self.of, strict=True):
            self.nominal["clock"][mine] = np.arange(len(mine)) * EPISODE[case.seconds]
            weigh(self.nominal, mine, case.wrong.get("mass", 1.0))
            self.nominal["gear"][mine] *= case.wrong.get("gain", 1.0)
        self.motion = self._motion()
        self.floor, self.sensor = self._sensor()
        self.asked = self.floor  # change that makes an effect detectable, [R, n]
        self.flaws: list[list[Flaw]] = [[] for _ in cases]

    def count(self, i: int) -> int:
        """Samples in each episode of case i."""
        return round(EPISODE[self.cases[i].seconds] / self.dt)

    def finish(self, last: bool, progress: Callable[[float], object]) -> list[Made | None]:
        """The cases; None where an effect cannot be made as large as drawn (never in the last attempt).

        Args:
            last: Whether this is the last attempt.
            progress: Called with shares of the work that sum to 1.
        """
        quiet = self.sensor._replace(noise=np.zeros_like(self.sensor.noise), early=np.zeros_like(self.sensor.early))
        calm = self._run(self.nominal, quiet)
        scales = [self._scales(calm, i) for i in range(len(self.cases))]
        if self.ground.border:
            self._add_flaws(calm, scales)
            calm = self._run(self.nominal, quiet)
        progress(0.3)
        unit = self._detectable(calm, scales)
        progress(0.4)
        sizes: list[list[float]] = []
        fits = np.ones(len(self.cases), bool)
        for i, case in enumerate(self.cases):
            mine = []
            for k, given in enumerate(case.effects):
                entry, scale = EVERYTHING[given.name], scales[i][given.joint]
                wanted = unit[i][k] * given.multiple
                top = entry.largest(scale)
                size = float(min(wanted, top)) if np.isfinite(wanted) else top
                if not np.isfinite(wanted) or wanted > top:
                    fits[i] = False
                size = max(size, entry.smallest)
                mine.append(np.ceil(size / H - 1e-9) * H if given.name == "actuator_delay" else size)  # as it acts
            sizes.append(mine)
        sane = np.zeros(len(self.cases), bool)
        record = calm
        for _ in range(4):
            with np.errstate(all="ignore"):  # a machine that diverges is found below
                record = self._run(self._truth(sizes, scales), self.sensor)
            bounds = np.array([WILD[k] for k in self.plant.kinds])
            wild = np.asarray(~np.isfinite(record.qpos).all((1, 2)) | (np.abs(record.qpos) > bounds).any((1, 2)))
            sane = np.array([not wild[mine].any() for mine in self.of])
            if sane.all():
                break
            sizes = [s if ok else [0.5 * x for x in s] for s, ok in zip(sizes, sane, strict=True)]
        progress(0.1)
        traces = self._tracer(calm, scales)
        same = alike(self.plant, self.cases, sizes, scales, traces)
        made = [self._made(i, record, sizes[i], unit[i], scales[i], same[i]) for i in range(len(self.cases))]
        if self.ground.border:
            own = self._own(traces, sizes)
            made = [self._weighed(one, i, own[i]) for i, one in enumerate(made)]
            fits &= np.array([all(e["left"] >= CLEAR for e in one.truth) for one in made])
        progress(0.2)
        return [one if (fits[i] and sane[i]) or last else None for i, one in enumerate(made)]

    def _add_flaws(self, calm: Record, scales: list[list[dict[str, float]]]) -> None:
        """Put small imperfections into all machines, below what matters, and ask that effects matter."""
        border, before = self.ground.border, self.nominal
        spread = np.zeros_like(self.floor)  # standard deviation of each position, [R, n], and of each measured force
        felt = np.zeros_like(spread)
        for i, mine in enumerate(self.of):
            spread[mine] = calm.state.y[: self.count(i), 0, mine].std((0, 1))
            force = calm.force[mine, : self.count(i)].std((0, 1))
            felt[mine] = np.where((force > 0) & self.cases[i].force_channel, force, np.inf)
            rng = np.random.default_rng((*self.cases[i].entropy, 5))
            drawn = draw_flaws(self.plant, scales[i], rng, force=self.cases[i].force_channel)
            self.flaws[i] = beside(drawn, self.cases[i].effects)
        self.asked = np.maximum(self.floor, border * spread)
        row, tick = window_starts(self.length, self.owner, self.dt, LONG)

        def moves(chosen: list[list[Flaw]]) -> Array:
            """By how much these flaws of each case move predictions [borders], [C]."""
            p = {k: v.copy() for k, v in take(before, row).items()}
            for i, flaws in enumerate(chosen):
                put(flaws, p, self.owner[row] == i, scales[i])
            without, limits = take(before, row), (border * spread[row], border * felt[row])
            moved = size_of(trace(self.plant, p, without, calm, row, tick, self.dt, *limits, window=LONG))
            return np.array([np.sqrt(np.mean(moved[self.owner[row] == i] ** 2, 0)).max() for i in range(len(chosen))])

        self.flaws, self.moved = below(self.flaws, moves)
        self.nominal = {k: v.copy() for k, v in before.items()}
        for i, mine in enumerate(self.of):
            put(self.flaws[i], self.nominal, mine, scales[i])

    def _own(self, traces: Traces, sizes: list[list[float]]) -> list[list[tuple[float, float]]]:
        """Of each effect of each case: what it changes, and what of that the others cannot make up for [detectable]."""
        found = traces([(i, g, x) for i, c in enumerate(self.cases) for g, x in zip(c.effects, sizes[i], strict=True)])
        unsure = [i for i, c in enumerate(self.cases) if c.effects and c.uncertain]
        heavier = dict(zip(unsure, traces([(i, None, HEAVIER) for i in unsure]), strict=True))
        out, queue = [], iter(found)
        for i, case in enumerate(self.cases):
            mine = [next(queue) for _ in case.effects]
            held = [heavier[i]] if i in heavier else []
            others = [[x for m, x in enumerate(mine) if m != k] + held for k in range(len(mine))]
            out.append(
                [
                    (float(size_of(t[None].reshape(1, -1, t.shape[-1])).max()), left_of(t, rest))
                    for t, rest in zip(mine, others, strict=True)
                ]
            )
        return out

    def _weighed(self, made: Made, i: int, own: list[tuple[float, float]]) -> Made:
        truth = [{**t, "weight": w, "left": left} for t, (w, left) in zip(made.truth, own, strict=True)]
        return made._replace(truth=truth, more={"flaws": as_label(self.flaws[i], self.moved[i])})

    def _truth(self, sizes: list[list[float]], scales: list[list[dict[str, float]]]) -> dict[str, Array]:
        p = {k: v.copy() for k, v in self.nominal.items()}
        for i, case in enumerate(self.cases):
            for given, size in zip(case.effects, sizes[i], strict=True):
                scale = scales[i][given.joint]
                EVERYTHING[given.name].apply(p, self.of[i], given.joint, size, given.shape, scale)
        return p

    def _run(self, p: dict[str, Array], sensor: Sensor) -> Record:
        motion = self.motion
        control = Tracking(self.plant, self.believed, motion.position, motion.velocity, motion.acceleration, self.dt)
        first = start(motion.position[:, 0], motion.velocity[:, 0])
        return simulate(self.plant, p, first, self.ticks, round(self.dt / H), commands=control, sensor=sensor)

    def _motion(self) -> Reference:
        """References of all rows, [R, T, n]."""
        parts = []
        for case, mine in zip(self.cases, self.of, strict=True):
            rng = np.random.default_rng((*case.entropy, 2))
            for kinds in plan(rng, len(mine)):
                if case.kind == "short":
                    kinds = ("slow",)
                ref = reference(kinds, self.plant.kinds, round(EPISODE[case.seconds] / self.dt), self.dt, rng)
                ref = _hold_on(ref, self.ticks)
                if case.kind == "one_speed":
                    speed = float(rng.uniform(0.05, 0.15))
                    t = np.arange(self.ticks)[:, None] * self.dt
                    ref = Reference(speed * t - 0.2, np.full_like(t, speed), np.zeros_like(t))
                parts.append(ref)
        motion = Reference(*(np.stack([p[i] for p in parts]) for i in range(3)))
        for joint in range(len(self.plant.actuators), self.plant.n):
            for array in motion:
                array[:, :, joint] = 0.0
        return motion

    def _sensor(self) -> tuple[Array, Sensor]:
        """Noise floor of each row [R, n], and what the encoders add."""
        noise, count, early = [], [], []
        for case, mine in zip(self.cases, self.of, strict=True):
            rng = np.random.default_rng((*case.entropy, 3))
            sd = np.array([NOISE[k][case.noise] for k in self.plant.kinds])
            noise.append(sd * rng.standard_normal((len(mine), self.ticks, self.plant.n)))
            count.append(np.tile([COUNT[k][case.noise] for k in self.plant.kinds], (len(mine), 1)))
            shift = rng.integers(-JITTER_STEPS, JITTER_STEPS + 1, (len(mine), self.ticks))
            early.append(shift if case.jitter else np.zeros_like(shift))
        sd = np.concatenate(
            [np.tile([NOISE[k][c.noise] for k in self.plant.kinds], (len(m), 1)) for c, m in self._each()]
        )
        steps = np.concatenate(count)
        return np.sqrt(sd**2 + steps**2 / 12), Sensor(np.concatenate(noise), steps, np.concatenate(early))

    def _each(self) -> list[tuple[Case, Array]]:
        return list(zip(self.cases, self.of, strict=True))

    def _scales(self, calm: Record, i: int) -> list[dict[str, float]]:
        """Typical force, speed, … of each joint in the run without effects (see library)."""
        mine = self.of[i]
        ticks, n = self.count(i), self.plant.n
        out = []
        q, v = calm.state.y[:ticks, 0, mine], calm.state.y[:ticks, 1, mine]
        p = take(self.nominal, mine)
        inertia = np.einsum("rii->ri", self.plant.mass(q[ticks // 2], p)).mean(0)
        for j in range(n):
            driven = j < len(self.plant.actuators)
            speed = float(np.sqrt(np.mean(v[:, :, j] ** 2)))
            travel = float(np.ptp(q[:, :, j]))
            force = float(np.sqrt(np.mean(calm.force[mine, :ticks, j] ** 2)))
            if not driven:
                force = float(inertia[j] * np.sqrt(np.mean(np.gradient(v[:, :, j], self.dt, axis=0) ** 2)))
            per_command = float((p["kp"] if self.plant.servo else p["gear"])[0, j])
            out.append(
                {
                    "F": max(force, 1e-6),
                    "V": max(speed, 1e-4),
                    "top": max(float(np.abs(v[:, :, j]).max()), 1e-3),
                    "Q": max(travel, 1e-4),
                    "J": float(inertia[j]),
                    "U": max(force, 1e-6) / per_command if driven else 0.0,
                    "M": float(p.get("m2", p.get("m"))[0]),  # type: ignore[index]
                    "peak": max(float(np.abs(calm.force[mine, :ticks, j]).max()), 1e-6),
                    "gear": 1.0 if self.plant.servo or not driven else per_command,
                    "seconds": float(self.cases[i].seconds),
                }
            )
        return out

    def _detectable(self, calm: Record, scales: list[list[dict[str, float]]]) -> list[list[float]]:
        """Detectable size of each effect of each case; all are searched together."""
        units: list[list[float]] = [[] for _ in self.cases]
        hidden = [(i, given) for i, case in enumerate(self.cases) for given in case.effects]
        if not hidden:
            return units
        row, tick = window_starts(self.length, self.owner, self.dt)
        windows = [np.flatnonzero(self.owner[row] == i) for i, _ in hidden]
        mine = np.concatenate(windows)
        ends = np.cumsum([len(w) for w in windows])
        spans = [np.arange(end - len(w), end) for w, end in zip(windows, ends, strict=True)]
        nominal, floor = take(self.nominal, row[mine]), self.asked[row[mine]]
        entries = [EVERYTHING[given.name] for _, given in hidden]
        place = [scales[i][given.joint] for i, given in hidden]

        def ratio(sizes: Array) -> Array:
            p = {key: v.copy() for key, v in nominal.items()}
            for (_, given), entry, scale, size, span in zip(hidden, entries, place, sizes, spans, strict=True):
                entry.apply(p, span, given.joint, float(size), given.shape, scale)
            moved = size_of(trace(self.plant, p, nominal, calm, row[mine], tick[mine], self.dt, floor))
            moved = np.where(np.isfinite(moved), moved, 1e6)
            return np.array([np.sqrt(np.mean(moved[span] ** 2, 0)).max() for span in spans])

        found = detectable(
            ratio,
            np.array([e.guess(s) for e, s in zip(entries, place, strict=True)]),
            np.array([e.largest(s) for e, s in zip(entries, place, strict=True)]),
            np.array([e.smallest for e in entries]),
        )
        for (i, _), size in zip(hidden, found, strict=True):
            units[i].append(float(size))
        return units

    def _tracer(self, calm: Record, scales: list[list[dict[str, float]]]) -> Traces:
        """What effects change in these data (see alike)."""
        row, tick = window_starts(self.length, self.owner, self.dt)
        windows = {i: np.flatnonzero(self.owner[row] == i) for i, case in enumerate(self.cases) if case.effects}

        def traces(jobs: list[Job]) -> list[Array]:
            """Of an effect at a size, or of a heavier machine (None, share), in a case: [W, T, channels] each."""
            if not jobs:
                return []
            mine = np.concatenate([windows[i] for i, _, _ in jobs])
            ends = np.cumsum([len(windows[i]) for i, _, _ in jobs])
            nominal = take(self.nominal, row[mine])
            p, felt = {k: v.copy() for k, v in nominal.items()}, []
            for (i, given, size), end in zip(jobs, ends, strict=True):
                span = np.arange(end - len(windows[i]), end)
                if given is None:
                    weigh(p, span, 1 + size)
                else:
                    EVERYTHING[given.name].apply(p, span, given.joint, size, given.shape, scales[i][given.joint])
                sd = [0.01 * s["F"] if self.cases[i].force_channel else np.inf for s in scales[i]]
                felt += [sd[: len(self.plant.actuators)]] * len(span)
            found = trace(
                self.plant, p, nominal, calm, row[mine], tick[mine], self.dt, self.asked[row[mine]], np.array(felt)
            )
            return np.split(np.where(np.isfinite(found), found, 1e6), ends[:-1])

        return traces

    def _made(
        self,
        i: int,
        record: Record,
        sizes: list[float],
        unit: list[float],
        scales: list[dict[str, float]],
        same: list[list[str]],
    ) -> Made:
        case, mine = self.cases[i], self.of[i]
        rng = np.random.default_rng((*case.entropy, 4))
        episodes, count = [], self.count(i)
        for r in mine:
            stamps = record.time[r, :count] + (TIMESTAMP_SD * rng.standard_normal(count) if case.jitter else 0.0)
            columns = {"time": stamps - stamps[0]}
            for j, name in enumerate(self.plant.actuators):
                columns[f"ctrl/{name}"] = record.ctrl[r, :count, j]
            for j, name in enumerate(self.plant.joints):
                columns[f"qpos/{name}"] = record.qpos[r, :count, j]
            for j, name in enumerate(self.plant.joints if case.speed_channel else ()):
                sd = 100.0 * self.floor[r, j]  # as a differentiated encoder has it
                columns[f"qvel/{name}"] = record.clean_speed[r, :count, j] + sd * rng.standard_normal(count)
            for j, name in enumerate(self.plant.actuators if case.force_channel else ()):
                sd = 0.01 * scales[j]["F"]
                columns[f"force/{name}"] = record.force[r, :count, j] + sd * rng.standard_normal(count)
            episodes.append(columns)
        truth = [
            label(given, size, one, scales[given.joint], others)
            for given, size, one, others in zip(case.effects, sizes, unit, same, strict=True)
        ]
        return Made(case, episodes, truth, [float(x) for x in self.floor[mine[0]]])


def _hold_on(ref: Reference, ticks: int) -> Reference:
    """The motion, and standing still at its end until there are so many ticks."""
    more = ticks - len(ref.position)
    return Reference(
        np.concatenate([ref.position, np.repeat(ref.position[-1:], more, 0)]),
        *(np.concatenate([x, np.zeros((more, x.shape[1]))]) for x in (ref.velocity, ref.acceleration)),
    )
