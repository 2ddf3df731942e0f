"""The FR3 as a backend: five actions a second, measured, gated, held and stopped at the first doubt."""

import logging
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from envs.backends.base import BackendError, Outcome
from envs.backends.pace import Pace
from envs.backends.rig import Rig
from envs.backends.route import reset_route
from envs.backends.safety import NotSafe, Unseen
from envs.backends.stream import Sample
from envs.perception.base import Detection
from envs.task import AbstractTask, Array

log = logging.getLogger(__name__)
ARRIVED = 0.05  # [rad] from the start posture that counts as being there
SETTLE = 0.4  # [s] for the arm to come to rest before an episode


class FrankaBackend:
    """One FR3, one object, one episode at a time.

    The task's controller says which joint angles a command means; the gate cuts the way there; the stream plays it in
    the period, as the simulator ramps its actuators. On any doubt the target freezes, the arm is stopped, the period
    is marked invalid (which ends the episode), and `note` says why. The next reset recovers, up to a number of times.

    Args:
        task: What is done; it must command an FR3 that moves one object.
        rig: The arm and what sees the object, not yet open.
        safe_tip: Where the tip is in the safe posture between episodes, base frame, [3] m.
        reset_speed: Share of the joints' greatest speed on the way to a start.

    Raises:
        ValueError: If the task is not for this robot, or its start is outside the limits.
    """

    num_envs = 1

    def __init__(self, task: AbstractTask, rig: Rig, *, safe_tip: tuple[float, float, float], reset_speed: float):
        if task.arm is None:
            raise ValueError(f"task {task.name} has no FR3: it can run on backend sim alone")
        speed = rig.gate.limits.speed
        if not 0 < reset_speed <= speed / 1.1:
            raise ValueError(f"reset_speed={reset_speed}; it must be above 0 and at most {speed / 1.1:.2f} here")
        if np.shape(safe_tip) != (3,) or not np.isfinite(safe_tip).all():
            raise ValueError(f"safe_tip={safe_tip}; it must be three numbers: x, y and z in the base frame [m]")
        self.task, self.rig, self.gate = task, rig, rig.gate
        self.way = {
            "safe_tip": np.array(safe_tip, float),
            "rest": task.arm.rest,
            "tool_length": task.arm.tool_length,
            "speed": reset_speed,
            "sample_dt": self.gate.sample_dt,
        }
        self.samples_per_step = round(task.control_dt / self.gate.sample_dt)
        self.pace = Pace(task.control_dt)
        self.counters: Counter[str] = Counter()
        self.note = self.fault = ""
        self.model = task.spec().compile()  # for viewers
        self.hold_ms: float | None = None  # from the last freeze of the target by a doubt to the stop
        self.seed(0)
        self._rows: list[Sample] = []
        self._observation = np.zeros((1, len(task.observation_names)))
        self._object, self._qshown = np.zeros(3), None
        self._check_start()

    def open(self) -> None:
        """Connect, and stand ready.

        Raises:
            BackendError: Why not, and what to check.
        """
        self.rig.open()

    def seed(self, seed: int) -> None:
        self.rng = np.random.default_rng((seed, 0))

    def reset(self, sims: NDArray[np.int_]) -> Array:
        """Recover, go to the safe posture, have the object placed, go down to a drawn start; the first observation.

        Raises:
            BackendError: If the arm cannot get there, or the object is not seen; the arm is at rest.
        """
        if not len(sims):
            return np.zeros((0, self._observation.shape[1]))
        if self.fault:
            self.rig.recover(self.fault)
            self.fault = ""
        self.open()
        start = self.task.start(self.rng)
        place = self.task.place_of(start.qpos)[0]
        try:
            self._go_to(start.qpos[0, :7], place)
            seen = self._see(place)
        except (NotSafe, BackendError) as error:
            self.rig.end()
            raise BackendError(f"the episode cannot begin: {error}. The arm is at rest.") from error
        self.told, self.target = start.qpos[:, :7].copy(), start.target.copy()
        self.steps, self.note, self._rows = 0, "", []
        self._zero = self.rig.clock.now()
        self.pace.start(self._zero)
        self.rig.stream.take_samples()
        self._observation = self._observe(seen)
        return self._observation.copy()

    def send(self, action: Array) -> Outcome:
        """One control period; it returns at the end of the period, or as soon as the arm must not go on.

        Raises:
            FloatingPointError: If the action is not finite; the arm holds.
        """
        if not np.isfinite(action).all():
            self.rig.stream.hold()
            raise FloatingPointError(f"action is not finite: {action[0]}")
        if self.fault:
            return self._outcome(np.zeros_like(action), invalid=True)
        sent, self.note = np.clip(action, -1.0, 1.0), ""
        if self.pace.begin(self.rig.clock.now()):
            log.warning("planning took longer than the period; the arm held meanwhile (overrun %d)", self.pace.overruns)
        try:
            sent = self._move(sent)
            self.rig.clock.wait(self.pace.due, self.rig.stream.stopped)
            waits = self.rig.waits
            seen = self.rig.sight()
        except (NotSafe, BackendError) as error:
            return self._stop(str(error), sent)
        if self.rig.waits == waits:
            self.pace.end()
        else:
            self.pace.start(self.rig.clock.now())  # what the object took is no jitter, and no planning
        self._observation = self._observe(seen)
        self.steps += 1
        if self.steps == self.task.episode_steps:
            self._collect()
            self.rig.end()  # at rest while the agent learns
            self.rig.retries.succeeded()
        return self._outcome(sent, invalid=False)

    def positions(self) -> Array | None:
        """Joint angles and the object's place, as the task's scene has them, [nq]."""
        return None if self._qshown is None else self._qshown[0].copy()

    def samples(self) -> dict[str, Array] | None:
        """As `Backend.samples`: the arm's seven joints at 125 Hz; `ctrl` is the target streamed."""
        self._collect()
        rows, self._rows = self._rows, []
        if not rows:
            return None
        return {
            "time": np.array([row.time - self._zero for row in rows]),
            "qpos": np.array([row.q for row in rows]),
            "qvel": np.array([row.dq for row in rows]),
            "ctrl": np.array([row.told for row in rows]),
            "force": np.array([row.torque for row in rows]),
        }

    def describe(self) -> dict[str, object]:
        joints = [f"joint{i}" for i in range(1, 8)]
        return {"joint_names": joints, "actuator_names": [f"position{i}" for i in range(1, 8)], "backend": "franka"}

    def report(self) -> dict[str, object]:
        """Timing and counters since the beginning, for the summary."""
        counts = {"limited": self.counters["limited"], "waits": self.rig.waits, "faults": self.counters["faults"]}
        return {**self.pace.report(), **counts, "robot_rate": round(self.rig.rate, 3)}

    def obey(self, asked: Callable[[], str]) -> None:
        """From now on a person can stop the arm: `asked` says why, or nothing; the stream asks before each target."""
        self.rig.asked = asked

    def guided(self) -> dict[str, Array]:
        """Watch for one period while a person moves the arm: nothing is sent, no controller runs.

        Returns:
            time [S] s since the episode's start, qpos, qvel, force [S, 7], object [S, 3] m in the base frame (nan
            while it is not seen).

        Raises:
            BackendError: If the robot is not heard.
        """
        rows, unseen = [], np.full(3, np.nan)
        end = time.monotonic() + self.task.control_dt
        while time.monotonic() < end:
            state, seen = self.rig.look_on()
            place = unseen if seen is None else seen.position
            rows.append((self.rig.clock.now() - self._zero, state.q, state.dq, state.torque, place))
            time.sleep(self.gate.sample_dt / 2)
        names = ("time", "qpos", "qvel", "force", "object")
        return {name: np.array(column, float) for name, column in zip(names, zip(*rows, strict=True), strict=True)}

    def status(self) -> dict[str, str]:
        """What a person wants to see of the robot now, in words; asks nothing of it, so any thread may call."""
        running, seen = self.rig.running, self.rig.seen
        found = {"robot": "at rest", "tool": "-", "gripper": self.rig.gripper.words, "object": "not seen yet"}
        if running is not None:
            state = running.state
            stopped = f", stopped: {running.doubt}" if running.doubt else ""
            found["robot"] = f"{state.mode}{stopped}"
            found["tool"] = "x {:.3f}  y {:.3f}  z {:.3f} m".format(*self.gate.tip(state.q))
        if seen is not None:
            age = time.monotonic() - seen.time
            found["object"] = "x {:.3f}  y {:.3f} m, seen {:.1f} s ago".format(*seen.position[:2], age)
        return found

    def close(self) -> None:
        """Stop the arm and disconnect."""
        self.rig.close()

    def _go_to(self, q: Array, place: Array) -> None:
        """By way of the safe posture to a start q [7], the object put at a place [3]."""
        rig = self.rig
        rig.arm.posture = q  # else what the elbow is off by adds up from one reset to the next
        rig.begin()
        rig.follow(reset_route(rig.stream.told, q, **self.way)[0])
        rig.place(place)
        for path in reset_route(rig.stream.told, q, **self.way):  # from where it is now: it may have been pushed
            rig.follow(path)
        if not rig.dry_run:
            rig.clock.wait(rig.clock.now() + SETTLE, rig.stream.stopped)
            far = float(np.abs(rig.stream.state.q - q).max())
            if far > ARRIVED:
                raise NotSafe(f"the arm stands {far:.2f} rad from the start it was sent to")

    def _see(self, place: Array) -> Detection:
        """The object at its place [3]; while it is hidden the arm rests where it is, and it is asked for again.

        Raises:
            NotSafe: If the arm was stopped, or it was hidden more often than faults may follow each other.
        """
        while True:
            try:
                return self.rig.sight()
            except Unseen as error:
                self.rig.retries.failed(str(error))
                self.counters["faults"] += 1
                log.warning("%s; once more", error)
                self.rig.place(place)

    def _move(self, asked: Array) -> Array:
        """Aim at what an action means, as far as the gate lets it; the share of the action [1, A] that was sent."""
        start = self.rig.stream.hold()
        self.target = self.task.move(self.target, asked)
        self.told = self.task.ctrl(self.target, self.told)
        step = self.gate.step(start[None], self.told, self.samples_per_step)
        self.rig.stream.play(step.path[0])
        if not step.note[0]:
            return asked
        self.note = f"limited: {step.note[0]}"
        self.counters["limited"] += 1
        self.told = step.path[:, -1].copy()
        self.target = self.task.hold(self.told)
        return asked * step.share[0]

    def _stop(self, why: str, sent: Array) -> Outcome:
        """The end of an episode by a doubt: hold (done already, or now), then stop."""
        stream = self.rig.stream
        stream.hold()
        self.hold_ms = 1e3 * (time.monotonic() - stream.doubt_time) if stream.stopped.is_set() else 0.0
        self._collect()
        said = self.rig.end()
        self.fault = self.note = f"{why} ({said})" if said and said not in why else why
        self.counters["by_person" if self.rig.by_person else "faults"] += 1
        log.warning("the arm was stopped: %s", self.note)
        return self._outcome(sent, invalid=True)

    def _collect(self) -> None:
        """Keep what the stream has recorded."""
        if self.rig.running is not None:
            self._rows += self.rig.running.take_samples()

    def _observe(self, seen: Detection) -> Array:
        self._object = np.asarray(seen.position, float)
        self._qshown = self._qpos(self.rig.stream.state.q)
        return self.task.observe(self._qshown, np.zeros((1, self.model.nv)))

    def _qpos(self, q: Array) -> Array:
        """The task's qpos [1, nq] for joint angles [7] and the object last seen."""
        return self.task.qpos_of(q[None], self._object[None])

    def _outcome(self, sent: Array, *, invalid: bool) -> Outcome:
        seen = self._observation
        return Outcome(
            observation=seen.copy(),
            reward=self.task.reward(seen, sent),
            success=self.task.success(seen),
            terminated=self.task.terminated(seen),
            action_sent=np.asarray(sent, float),
            invalid=np.array([invalid]),
        )

    def _check_start(self) -> None:
        """The task's own start must be allowed, or no episode could ever begin."""
        q = self.task.start(np.random.default_rng(0)).qpos[0, :7]
        try:
            _, down = reset_route(q, q, **self.way)
            self.gate.route(down)
        except NotSafe as error:
            raise ValueError(f"the task's start, or the way down to it, is outside the limits: {error}") from error
