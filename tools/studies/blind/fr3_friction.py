"""Dry friction of MuJoCo's joints by events, in place of its `frictionloss`: stiction that holds exactly."""

import mujoco
import numpy as np

from tools.studies.blind.plants import Array, Rows


class DryFriction:
    """Joints that slide, stop, hold and break loose; `force` is what friction does to each of them [N m], [7]."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, p: Rows) -> None:
        self.model, self.data, self.p, self.waves = model, data, p, bool(p["wave"].any())
        self.mode = np.sign(data.qvel)  # direction of sliding, 0: holds
        self.force = np.zeros(model.nv)
        self.mass = np.zeros((model.nv, model.nv))

    def step(self) -> None:
        """One step of the simulation."""
        data, h = self.data, self.model.opt.timestep
        self.force[:] = -self.mode * self._level(self.mode)
        holds = self._hold() if not self.mode.all() else None
        before = data.qvel.copy()
        if holds is not None:
            still = data.qpos[holds]
        mujoco.mj_step(self.model, data)
        if holds is not None:
            data.qpos[holds], data.qvel[holds] = still, 0.0
        turned = data.qvel * self.mode < 0
        if turned.any():  # back to where it stopped: speed is linear within a step
            v = data.qvel[turned]
            fresh = before[turned] * v < 0
            since = np.where(fresh, h * v / np.where(fresh, v - before[turned], 1.0), 0.0)
            data.qpos[turned] -= 0.5 * v * since
            data.qvel[turned], self.mode[turned] = 0.0, 0.0

    def _hold(self) -> Array:
        """Joints that stay where they are, and in `force` what holds them; those that cannot be held slide from now."""
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_fullM(self.model, self.data, self.mass)
        give = np.linalg.inv(self.mass)  # acceleration per force
        free = self.data.qacc_smooth.copy()
        while len(holds := np.flatnonzero(self.mode == 0)):
            needed = np.linalg.solve(give[np.ix_(holds, holds)], -free[holds])
            onset = np.zeros(len(free))
            onset[holds] = -np.sign(needed)
            level = self._level(onset)
            excess = np.abs(needed) - level[holds]
            worst = int(np.argmax(excess))
            if excess[worst] <= 0:
                self.force[holds] = needed
                break
            j = holds[worst]
            self.mode[j], self.force[j] = onset[j], -onset[j] * level[j]
            free += give[:, j] * self.force[j]
        return holds

    def _level(self, direction: Array) -> Array:
        """Size of the friction against motion in these directions, [7]."""
        level = np.where(direction > 0, self.p["c_pos"], self.p["c_neg"])
        if self.waves:
            level = level * (1 + self.p["wave"] * np.sin(2 * np.pi * self.data.qpos / self.p["wave_period"]))
        return level
