"""Inverse dynamics of the nominal model along measured data, and what each effect would add to it.

The missing force r = inverse dynamics - drive, [N, n], of smoothed positions is what the baselines explain. Each effect
at each place is a few columns [N * n, k] that r would be proportional to; effects with a time or a width have several
variants. Play in a gear and a delayed sensor have no such column and are left out.
"""

import csv
import json
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from tools.studies.blind.plants import Array

SMOOTH = 0.06  # [s] window of the Savitzky-Golay filter
MOST = 1500  # samples of a case
TIMES = (0.003, 0.01, 0.03)  # [s] delays and lags that are tried
SHARES = (0.1, 0.3, 0.6)  # widths and limits that are tried, of the largest command


class Motion(NamedTuple):
    """Smoothed data of a case: q, v, a [N, n], command [N, nu], its past [N, nu, 2 * len(TIMES)], train [N] of bool.

    `past` holds the command delayed and low-passed by each of TIMES.
    """

    q: Array
    v: Array
    a: Array
    command: Array
    past: Array
    train: Array


def read(case: Path) -> tuple[mujoco.MjModel, Motion]:
    """The model and the data of a case folder; the last episode, or the last third of a single one, is held out."""
    model = mujoco.MjModel.from_xml_path(str(case / "model.xml"))
    files = sorted(case.glob("episode_*.csv"))
    joints = [model.joint(i).name for i in range(model.njnt)]
    actuators = [model.actuator(i).name for i in range(model.nu)]
    parts = []
    for path in files:
        with path.open() as file:
            names = next(csv.reader(file))
        table = dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))
        time = np.arange(table["time"][0], table["time"][-1], np.median(np.diff(table["time"])))
        dt = float(time[1] - time[0])
        q = np.stack([np.interp(time, table["time"], table[f"qpos/{j}"]) for j in joints], 1)
        u = np.stack([table[f"ctrl/{a}"] for a in actuators], 1)
        u = u[np.searchsorted(table["time"], time, side="right") - 1]
        width = 2 * round(SMOOTH / dt / 2) + 1
        q, v, a = (savgol_filter(q, width, 3, k, dt, axis=0) for k in range(3))
        past = np.stack([_delayed(u, tau, dt) for tau in TIMES] + [_lagged(u, tau, dt) for tau in TIMES], 2)
        inside = slice(width, len(time) - width)
        last = len(files) > 1 and path == files[-1]
        train = np.full(len(time), not last) if len(files) > 1 else np.arange(len(time)) < 2 * len(time) / 3
        parts.append([x[inside] for x in (q, v, a, u, past, train)])
    motion = Motion(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    every = max(1, len(motion.q) // MOST)
    return model, Motion(*(x[::every] for x in motion))


def uncertain(case: Path) -> list[str]:
    """Nominal quantities that may be wrong."""
    return sorted(json.loads((case / "known.json").read_text())["uncertain"])


def _delayed(u: Array, tau: float, dt: float) -> Array:
    t = np.arange(len(u)) * dt
    return np.stack([np.interp(t - tau, t, x) for x in u.T], 1)


def _lagged(u: Array, tau: float, dt: float) -> Array:
    out, keep = u.copy(), np.exp(-dt / tau)
    for k in range(1, len(u)):
        out[k] = keep * out[k - 1] + (1 - keep) * u[k]
    return out


def missing(model: mujoco.MjModel, q: Array, v: Array, a: Array, command: Array) -> tuple[Array, Array]:
    """r and the drive's force, [N, n] each."""
    data = mujoco.MjData(model)
    r, drive = np.empty_like(q), np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q[k], v[k], command[k]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        drive[k] = data.qfrc_actuator
        data.qacc[:] = a[k]
        mujoco.mj_inverse(model, data)
        r[k] = data.qfrc_inverse - drive[k]
    return r, drive


def columns(model: mujoco.MjModel, m: Motion) -> tuple[Array, dict[str, list[Array]]]:
    """r [N * n], and "effect@place" -> variants, each [N * n, k]."""
    count, n = m.q.shape
    base, drive = missing(model, m.q, m.v, m.a, m.command)
    found: dict[str, list[Array]] = {}
    sign = np.sign(m.v)
    for j in range(n):
        at, v, speed = model.joint(j).name, m.v[:, j], np.sqrt(np.mean(m.v[:, j] ** 2))
        slow = np.exp(-((v / (0.2 * speed)) ** 2))

        def one(*forces: Array, j: int = j) -> list[Array]:
            made = np.zeros((count, n, len(forces)))
            made[:, j] = np.stack(forces, 1)
            return [made.reshape(count * n, -1)]

        s = sign[:, j]
        found[f"viscous_friction@{at}"] = one(-v)
        found[f"coulomb_friction@{at}"] = one(-s)
        found[f"asymmetric_friction@{at}"] = one(-np.maximum(v, 0), -np.minimum(v, 0))
        found[f"stribeck_friction@{at}"] = one(-s, -s * slow)
        found[f"quadratic_drag@{at}"] = one(-v * np.abs(v))
        found[f"load_dependent_friction@{at}"] = one(-s * np.abs(drive[:, j]))
        found[f"joint_stiffness@{at}"] = one(-m.q[:, j], np.ones(count))
        found[f"armature@{at}"] = one(-m.a[:, j])
        found[f"sensor_offset@qpos/{at}"] = [_moved(model, m, base, j, np.full(count, 1e-4)) / 1e-4]
        found[f"sensor_gain@qpos/{at}"] = [_moved(model, m, base, j, 1e-4 * m.q[:, j]) / 1e-4]
    for i in range(model.nu):
        at, u = model.actuator(i).name, m.command[:, i]
        top = float(np.abs(u).max()) or 1.0

        def sent(*commands: Array, i: int = i) -> list[Array]:
            made = np.zeros((count, n, len(commands)))
            joint = int(model.actuator_trnid[i, 0])
            made[:, joint] = model.actuator_gainprm[i, 0] * model.actuator_gear[i, 0] * np.stack(commands, 1)
            return [made.reshape(count * n, -1)]

        found[f"actuator_gain@{at}"] = sent(u)
        found[f"actuator_offset@{at}"] = sent(np.ones(count))
        late = [m.past[:, i, k] - u for k in range(2 * len(TIMES))]
        found[f"actuator_delay@{at}"] = [c for d in late[: len(TIMES)] for c in sent(d)]
        found[f"actuator_lag@{at}"] = [c for d in late[len(TIMES) :] for c in sent(d)]
        found[f"deadband@{at}"] = [c for w in SHARES for c in sent(-np.clip(u, -w * top, w * top))]
        joint = int(model.actuator_trnid[i, 0])
        force, peak = drive[:, joint], float(np.abs(drive[:, joint]).max()) or 1.0
        cut = [np.clip(force, -(1 - w) * peak, (1 - w) * peak) - force for w in SHARES]
        found[f"torque_saturation@{at}"] = [c for x in cut for c in one(x, j=joint)]
    for b in range(1, model.nbody):
        heavier = _copy(model)
        heavier.body_mass[b] *= 1.001
        mujoco.mj_setConst(heavier, mujoco.MjData(heavier))
        found[f"payload@{model.body(b).name}"] = [_against(heavier, m, base) / (0.001 * model.body_mass[b])]
    tilted = _copy(model)
    tilted.opt.gravity[0] += 9.81e-3
    found["gravity_tilt"] = [_against(tilted, m, base) / 1e-3]
    used = {k: [c for c in v if np.abs(c).max() > 1e-9] for k, v in found.items()}
    return base.reshape(-1), {k: v for k, v in used.items() if v}


def _copy(model: mujoco.MjModel) -> mujoco.MjModel:
    return model.__copy__()


def _against(other: mujoco.MjModel, m: Motion, base: Array) -> Array:
    """What would be missing if `other` were true, [N * n, 1]."""
    return (base - missing(other, m.q, m.v, m.a, m.command)[0]).reshape(-1, 1)


def _moved(model: mujoco.MjModel, m: Motion, base: Array, joint: int, by: Array) -> Array:
    """What would be missing if joint's sensor read too much by `by`, [N * n, 1]."""
    q = m.q.copy()
    q[:, joint] += by
    return (missing(model, q, m.v, m.a, m.command)[0] - base).reshape(-1, 1)
