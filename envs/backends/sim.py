"""MuJoCo as the world: N copies on threads, each its own model, with the effects of a gap."""

import logging
import os
from collections import Counter
from importlib.util import find_spec

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from envs.backends.base import Outcome
from envs.backends.friction import LoadFriction
from envs.effects.base import Effect
from envs.effects.rotor import place_rotors
from envs.randomize import Draw, Randomizer
from envs.task import AbstractTask, Array, whole_steps

log = logging.getLogger(__name__)
MAX_SAMPLE_DT = 0.01  # [s] recorded at least this often
MAX_PAST = 2.0  # [s] of true states kept for delayed sensors; the bound of sensor_delay
CTRL = int(mujoco.mjtState.mjSTATE_CTRL)


class SimBackend:
    """N simulations of a task.

    Within a control period the actuator signal moves linearly to its new value. A simulation that MuJoCo stops with a
    warning, or whose state is not finite, is unstable: its periods are marked invalid until it is reset, and it is
    counted in `counters` and logged once.

    Effects may add joints and actuators without an input behind those of the task's scene; nobody is told of them:
    `qpos`, `qvel`, controls and forces are those of the nominal scene.

    Args:
        task: What is simulated.
        num_envs: N.
        effects: What this reality has and the nominal simulator lacks.
        draws: Domain randomisation, drawn anew for each episode.
        noise_sd: Standard deviation of the observation noise [m or rad] of noisy episodes.
        noise_probability: Share of episodes that are noisy.
        threads: Simulation threads; 0 takes all cores that this process may use. They do not change the results.
        physics: `mujoco` on threads, or `warp`: MuJoCo Warp, on a GPU where there is one.
        reward: Of the `truth`, or of what is `observed`, as on a robot. Success is always that of the truth.

    Raises:
        ValueError: For an effect or a draw that does not fit the task, or for other physics or another reward.
    """

    def __init__(
        self,
        task: AbstractTask,
        num_envs: int,
        *,
        effects: list[Effect] | None = None,
        draws: list[Draw] | None = None,
        noise_sd: float = 0.0,
        noise_probability: float = 0.0,
        threads: int = 0,
        physics: str = "mujoco",
        reward: str = "truth",
    ):
        if reward not in ("truth", "observed"):
            raise ValueError(f"backend.reward={reward!r}; allowed: truth, observed")
        self.task, self.num_envs, self.effects = task, num_envs, effects or []
        spec = task.spec()
        self.nominal = nominal = spec.copy().compile()
        for effect in self.effects:
            effect.edit_spec(spec)
        self.model = spec.compile()
        self.batch = _batch(self.model, num_envs, min(threads or cores(), num_envs), physics)
        self.state = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.qpos, self.qvel = self.state[0][:, : nominal.nq], self.state[1][:, : nominal.nv]
        self.signal, self.act = self.batch.bind("ctrl"), self.batch.bind("act")
        self.clock, self.delayed = self.batch.bind("time"), self.batch.bind("history")
        self.applied = self.batch.bind("qfrc_applied")[:, : nominal.nv]
        self.told = np.zeros((num_envs, nominal.nu))  # control signals before the effects that change them
        self.hides_commands = any(type(e).command is not Effect.command for e in self.effects)
        self.randomizer = Randomizer(self.batch, self.model, draws or [], num_envs)
        self.noise_sd, self.noise_probability, self.believes = noise_sd, noise_probability, reward == "observed"
        self.steps = whole_steps(task.control_dt, task.sim_dt)
        self.has_force = any(type(e).force is not Effect.force for e in self.effects)
        self.dry = LoadFriction(self.batch, nominal, self.model, self.effects)
        self.actuators = [nominal.actuator(i).name for i in range(nominal.nactuator)]
        self.counters: Counter[str] = Counter()
        self.note = ""
        self.filters = [i for i in range(nominal.nactuator) if self.model.actuator_actadr[i] >= 0]  # lags
        self.slots = [_history_values(self.model, i) for i in range(self.model.nu)]
        self.record = ("qpos", "qvel", "actuator_force")
        self.target = np.zeros((num_envs, task.start(np.random.default_rng(0)).target.shape[1]))
        self.meant = self.target[:1], self.told[:1]  # command and signal of the first one if no effect changed them
        self.noisy, self.unstable = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self.remembers = any(type(e).sense is not Effect.sense for e in self.effects)
        self.past: list[tuple[Array, Array]] = []
        self._last: dict[str, Array] = {}
        self.seed(0)
        for effect in self.effects:  # a parameter that does not fit the task stops here, not in the first episode
            nothing = np.zeros((1, len(task.observation_names)))
            effect.command(np.zeros((1, task.action_dim)), task, nothing)
            self._change(np.zeros((1, nominal.nu)))
            effect.sense(nothing, lambda _, same=nothing: same, lambda k: np.zeros((1, k)), task)

    def seed(self, seed: int) -> None:
        """One generator each environment, so that an episode does not depend on its neighbours."""
        self.rngs = [np.random.default_rng((seed, i)) for i in range(self.num_envs)]
        self.sensor_rngs = [np.random.default_rng((seed, i, 1)) for i in range(self.num_envs)]

    def reset(self, sims: NDArray[np.int_]) -> Array:
        rngs = [self.rngs[i] for i in sims]
        self.batch.reset(np.asarray(sims, np.int32), stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.dry.take_off(sims)
        self.randomizer.draw([int(i) for i in sims], rngs)
        self.dry.take_over(sims)
        for i, rng in zip(sims, rngs, strict=True):
            start = self.task.start(rng)
            self.qpos[i], self.qvel[i], self.target[i] = start.qpos[0], start.qvel[0], start.target[0]
            self.noisy[i] = rng.uniform() < self.noise_probability
        whole = self.state[0][sims], self.state[1][sims]
        place_rotors(self.model, *whole)
        self.state[0][sims], self.state[1][sims] = whole
        self.told[sims] = told = self.task.ctrl(self.target[sims], self.qpos[sims, : self.model.nu])
        self.signal[sims] = ctrl = self._change(told)
        if 0 in sims:
            self.meant = self.target[:1].copy(), self.told[:1].copy()
        self.unstable[sims] = False
        if self.filters:
            self.act[np.ix_(sims, self.model.actuator_actadr[self.filters])] = ctrl[:, self.filters]
        for actuator, slots in enumerate(self.slots):
            if slots is not None:
                self.delayed[np.ix_(sims, slots)] = ctrl[:, actuator, None]
        if self.remembers:
            still = [np.repeat(x[:, None], self.steps, 1) for x in (self.qpos, self.qvel)]
            for qpos, qvel in self.past:
                qpos[sims], qvel[sims] = still[0][sims], still[1][sims]
            self.past = self.past or [(still[0], still[1])]
        return self._sense(self.task.observe(self.qpos[sims], self.qvel[sims]), sims)

    def send(self, action: Array) -> Outcome:
        sent = np.clip(action, -1.0, 1.0)
        realised = sent
        if self.hides_commands:
            before = self.task.observe(self.qpos, self.qvel)
            for effect in self.effects:
                realised = effect.command(realised, self.task, before)
        self.target = self.task.move(self.target, realised)
        before = self.told
        ramp = np.linspace(0, 1, self.steps + 1)[1:, None]
        ctrl = before[:, None] + ramp * (self.task.ctrl(self.target, before) - before)[:, None]  # [N, S, nu]
        self.told = ctrl[:, -1].copy()
        start = float(self.clock[0])
        moved = self._advance(self._change(ctrl.reshape(-1, ctrl.shape[2])).reshape(ctrl.shape))
        time = start + np.linspace(self.task.sim_dt, self.task.control_dt, self.steps)
        streamed = self._streamed(sent[:1], ramp) if self.hides_commands else ctrl[:1]
        self._last = {"time": time, "ctrl": streamed, **moved}
        if self.remembers:
            self.past.insert(0, (moved["qpos"].copy(), moved["qvel"].copy()))
            del self.past[int(MAX_PAST / self.task.control_dt) + 1 :]
        truth = self.task.observe(self.qpos, self.qvel)
        seen = self._sense(truth, np.arange(self.num_envs))
        return Outcome(
            observation=seen,
            reward=self.task.reward(seen if self.believes else truth, sent),
            success=self.task.success(truth),
            terminated=self.task.terminated(truth),
            action_sent=sent,
            invalid=self._check_physics(),
        )

    def privileged(self) -> Array:
        """What no sensor says: the observation without noise or effects, and where each draw lies in its range, 0 to 1.

        Returns:
            [N, O + D]; zeros where the physics failed.
        """
        known = np.concatenate([self.task.observe(self.qpos, self.qvel), self.randomizer.places], 1)
        return np.where(self.unstable[:, None], 0.0, known)

    def positions(self) -> Array:
        """Joint positions of the first simulation, as `model` has them: with the rotors of a gear that has play."""
        return self.state[0][0].copy()

    def samples(self) -> dict[str, Array]:
        """As `Backend.samples`, thinned to 125 Hz at 4 ms; `ctrl` is what the interface meant, before any effect."""
        every = max(1, int(MAX_SAMPLE_DT / self.task.sim_dt))
        pick = slice(every - 1, None, every)
        last = self._last
        return {"time": last["time"][pick]} | {k: last[k][0, pick] for k in ("qpos", "qvel", "ctrl", "force")}

    def describe(self) -> dict[str, object]:
        joints = [self.nominal.joint(i).name for i in range(self.nominal.njnt)]
        return {"joint_names": joints, "actuator_names": self.actuators}

    def close(self) -> None:
        """Nothing moves by itself here."""

    def _streamed(self, sent: Array, ramp: Array) -> Array:
        """Control signals of the first environment as the interface means them, [1, S, nu].

        The recording must not show what a hidden effect made of the command.
        """
        target, before = self.meant
        target = self.task.move(target, sent)
        after = self.task.ctrl(target, before)
        self.meant = target, after
        return before[:, None] + ramp * (after - before)[:, None]

    def _change(self, told: Array) -> Array:
        """What effects at named actuators make of control signals [T, nu]; the others act on the action."""
        for effect in self.effects:
            if effect.place == "actuator" and getattr(effect, "at", ()):
                told = effect.ctrl(told, self.actuators)
        return told

    def _advance(self, ctrl: Array) -> dict[str, Array]:
        """Simulate one period; a force that depends on the state is renewed at each physics step."""
        if not self.has_force and not self.dry.effects:
            out = self.batch.rollout(self.steps, control=ctrl, control_spec=CTRL, record=self.record)
        else:
            parts = []
            for k in range(self.steps):
                forces = (e.force(self.qpos, self.qvel) for e in self.effects)
                self.applied[:] = sum(f for f in forces if f is not None)
                self.dry.update()
                parts.append(self.batch.rollout(1, control=ctrl[:, k : k + 1], control_spec=CTRL, record=self.record))
            out = {name: np.concatenate([p[name] for p in parts], 1) for name in self.record}
        sizes = {"qpos": self.nominal.nq, "qvel": self.nominal.nv, "actuator_force": self.nominal.nactuator}
        qpos, qvel, force = (out[name][..., :size] for name, size in sizes.items())
        return {"qpos": qpos, "qvel": qvel, "force": force}

    def _sense(self, truth: Array, sims: NDArray[np.int_]) -> Array:
        """What the sensors of some environments read, [n, O]; each has its own noise."""

        def noise(k: int) -> Array:
            return np.stack([self.sensor_rngs[i].standard_normal(k) for i in sims])

        read = truth
        for effect in self.effects:
            read = effect.sense(read, lambda delay: self._past(delay, sims), noise, self.task)
        if self.noise_sd:
            read = read + self.noise_sd * self.noisy[sims, None] * noise(read.shape[1])
        return read

    def _past(self, delay: float, sims: NDArray[np.int_]) -> Array:
        """The true observation `delay` seconds ago, [n, O]; before the start, the first one."""
        period, back = divmod(round(delay / self.task.sim_dt), self.steps)
        qpos, qvel = self.past[min(period, len(self.past) - 1)]
        return self.task.observe(qpos[sims, self.steps - 1 - back], qvel[sims, self.steps - 1 - back])

    def _check_physics(self) -> NDArray[np.bool_]:
        """Which simulations are unstable, [N]; those that became so are counted and logged with MuJoCo's reason."""
        raised = self.batch.warning[:, :, 1] > 0  # [N, kinds of warning]
        finite = np.isfinite(self.qpos).all(1) & np.isfinite(self.qvel).all(1)
        unstable = raised.any(1) | ~finite
        for i in np.flatnonzero(unstable & ~self.unstable):
            kinds = [mujoco.mjtWarning(int(k)).name.removeprefix("mjWARN_") for k in np.flatnonzero(raised[i])]
            reason = ", ".join(kinds) or "the state is not finite"
            self.counters["unstable"] += 1
            log.warning("environment %d: physics unstable (%s); the episode ends and the step is dropped", i, reason)
        self.unstable = unstable
        self.note = "physics unstable" if unstable[0] else ""
        return unstable.copy()


def _batch(model: mujoco.MjModel, num_envs: int, threads: int, physics: str) -> Batch:
    if physics == "mujoco":
        return Batch(model, num_envs, threads)
    if physics != "warp":
        raise ValueError(f"physics={physics!r}; allowed: mujoco, warp")
    if find_spec("mujoco_warp") is None:
        raise ValueError("physics=warp needs MuJoCo Warp: pip install 'mpc_sgft[warp]', or leave physics out.")
    from envs.backends.warp_batch import WarpBatch  # Warp takes seconds to import

    return WarpBatch(model, num_envs)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _history_values(model: mujoco.MjModel, actuator: int) -> NDArray[np.int_] | None:
    """Where mjData.history keeps the past signals of an actuator, found by writing two values; None without any."""
    if not model.actuator_history[actuator, 0]:
        return None
    data, count = mujoco.MjData(model), int(model.actuator_history[actuator, 0])
    written = []
    for value in (1.0, 2.0):
        mujoco.mj_initCtrlHistory(model, data, actuator, None, np.full(count, value))
        written.append(data.history.copy())
    return np.flatnonzero(written[0] != written[1])
