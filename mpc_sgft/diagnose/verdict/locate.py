"""Where the error lives: which joint, and in which regime; the missing force by inverse dynamics."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.data.smooth import averaged
from mpc_sgft.diagnose.fitting.fit import Fit, change_of
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.simulation.plant import Plant, joint_of

POINTS = 3000  # at most, for inverse dynamics
FAST, SLOW = 0.75, 0.25  # quantiles of the speed
STILL = 0.02  # of the largest speed


def locate(setup: Setup) -> list[dict[str, Any]]:
    """Shares of the baseline's error by signal, and within a joint's signal by regime, largest first.

    Regimes overlap (fast motion is also motion in some direction). `share_of_error` is the signal's share of the
    whitened error times the regime's share of the missing force's square; `share_of_time` says how common it is.
    """
    problem, f = setup.problem, setup.baseline
    S = len(problem.replayer.signals)
    r = f.r.reshape(len(f.r), -1, S)
    by_signal = (r**2).sum((0, 1)) / max(float((r**2).sum()), 1e-30)
    missing, q, v, u = missing_force(setup)
    out = []
    for i, signal in enumerate(problem.replayer.signals):
        kind, joint = signal.split("/", 1)
        out.append({"signal": signal, "regime": "all", "share_of_error": float(by_signal[i]), "share_of_time": 1.0})
        if kind not in ("qpos", "qvel"):
            continue
        j = problem.replayer.plant.joints.index(joint)
        square = missing[:, j] ** 2
        for regime, mask in regimes(problem.replayer.plant, joint, v[:, j], u).items():
            share = float(square[mask].sum() / max(float(square.sum()), 1e-30))
            out.append(
                {
                    "signal": signal,
                    "regime": regime,
                    "share_of_error": float(by_signal[i]) * share,
                    "share_of_time": float(mask.mean()),
                }
            )
    return sorted(out, key=lambda row: -row["share_of_error"])


def regimes(plant: Plant, joint: str, v: Array, u: Array) -> dict[str, NDArray[np.bool_]]:
    """Which samples belong to which regime of one joint."""
    speed = np.abs(v)
    still = speed < STILL * speed.max()
    drive = [plant.actuators.index(a) for a in plant.actuators if joint_of(plant, a) == joint]
    masks = {
        "moving forward": (v > 0) & ~still,
        "moving backward": (v < 0) & ~still,
        "standing": still,
        "fast": speed > np.quantile(speed, FAST),
        "slow": speed < np.quantile(speed, SLOW),
    }
    if drive:
        command = np.abs(u[:, drive[0]])
        change = np.abs(np.gradient(u[:, drive[0]]))
        masks["large command"] = command > np.quantile(command, FAST)
        masks["after a command change"] = change > np.quantile(change, 0.9)
    return {name: mask for name, mask in masks.items() if mask.any()}


def missing_force(setup: Setup, f: Fit | None = None) -> tuple[Array, Array, Array, Array]:
    """Force that a fit lacks along the recorded motion [M, nj] N or N m, with position, speed, command.

    Args:
        setup: With the recorded motion.
        f: Of forces and of gains and offsets of commands; the baseline if None.
    """
    replayer, f = setup.problem.replayer, f or setup.baseline
    change = change_of(f.terms, f.values)
    model = replayer.plant.compile(change)
    data = mujoco.MjData(model)
    q, v, a = (np.concatenate([getattr(s, k)[2:-2] for s in replayer.smooth]) for k in "qva")
    sent = [e.ctrl for e in replayer.episodes]
    u = np.concatenate([x[2:-2] for x in sent])
    for command in change.commands:
        sent = [command(x, replayer.dt) for x in sent]
    wide = {j: i for i, j in enumerate(replayer.plant.joints)}
    at = [wide.get(joint_of(replayer.plant, a) or "", 0) for a in replayer.plant.actuators]
    acting = np.concatenate(
        [_as_accelerations(x, sm.spread[at])[2:-2] for x, sm in zip(sent, replayer.smooth, strict=True)]
    )
    pick = np.unique(np.linspace(0, len(q) - 1, POINTS).astype(int))
    out = np.empty((len(pick), model.nv))
    for row, k in enumerate(pick):
        data.qpos[:], data.qvel[:], data.qacc[:], data.ctrl[:] = q[k], v[k], a[k], acting[k]
        mujoco.mj_inverse(model, data)
        needed = data.qfrc_inverse.copy()
        mujoco.mj_fwdActuation(model, data)
        out[row] = needed - data.qfrc_actuator
    return out, q[pick], v[pick], u[pick]


def _as_accelerations(ctrl: Array, spread: Index) -> Array:
    """Commands [T, nu] as far as smoothed accelerations show them: a command is held, before a sample and after it."""
    around = (np.concatenate([ctrl[:1], ctrl[:-1]]) + ctrl) / 2
    return np.stack([averaged(x, int(w)) for x, w in zip(around.T, spread, strict=True)], 1) if ctrl.size else ctrl
