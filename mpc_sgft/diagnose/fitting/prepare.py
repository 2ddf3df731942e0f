"""Everything that is known before any candidate: windows, noise, the simulator's floor, typical sizes, the split."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import mujoco
import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.candidates.effect_table import TypicalSizes
from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.data.measured import Array, Episode, Index
from mpc_sgft.diagnose.data.smooth import noise_of, quantum, smooth
from mpc_sgft.diagnose.data.windows import AFTER, BEFORE, EITHER
from mpc_sgft.diagnose.fitting.fit import Discrepancy, Fit, Problem, Residuals, by_parts, change_of, fit
from mpc_sgft.diagnose.simulation.plant import Plant, joint_of
from mpc_sgft.diagnose.simulation.replay import Replayer

WINDOW = 1.0  # [s] where the data allow it
LEAST = 10  # samples of a window
SPARE = 0.1  # share of the data that may be lost in pieces too short for a window
MIN_WINDOWS = 4  # shorter windows rather than fewer
UNITS = 24  # parts of windows to compare sets on, at least
FEW_WINDOWS = 12  # fewer: one may hold all that shows an effect
BLOCKS = 8  # into which the fitted windows are split for leaving out
NOISE = float(np.log(2.0))  # log(1 + e) of a window whose error is noise alone, e = 1
QUIET = 0.05  # in log(1 + e): below this above the noise's, no further effect is searched for
ABOVE_NOISE = 0.25  # in log(1 + e): an error that is no more above the noise's needs no further name
KICK = 1e-4  # of the typical size, to differentiate by the start, at least


P = TypeVar("P", bound=Residuals)


@dataclass(frozen=True)
class Setup(Generic[P]):
    """A problem with its baseline.

    Attributes:
        problem: Residuals of structures.
        fitted, held: Windows to fit to, and windows never fitted.
        blocks: Contiguous block of each fitted window, [W].
        baseline: The nominal model with uncertain quantities refitted.
        noise, floor: Of each signal, of the sensor and of the simulator (its median), [S].
        quiet: An error below which nothing is left to explain.
        parts: Into which each window is cut when sets are compared; a few long windows say more than many short ones.
        stepping: Share of the expected squared error that the simulator's time step makes.
        near: The fit near which it is right; None where nothing depends on that.
        squared: What was judged -> that of which shares are taken: the squared error, in units of noise and tolerance.
        judged: What of a window's error counts when sets are compared; the error itself by default.
        faint: A nominal error that shows nothing if no window has a larger one; -inf where one in the mean decides.
        tolerated: What the user said does not matter of each signal, beside its noise, [S]; 0 if nothing.
    """

    problem: P
    fitted: Index
    held: Index
    blocks: Index
    baseline: Fit
    noise: Array
    floor: Array
    judged: Callable[[Array], Array] = field(default=np.asarray)
    quiet: float = -np.inf
    parts: int = 1
    stepping: float = 0.0
    near: Fit | None = None
    squared: Callable[[Array], Array] = field(default=np.asarray)
    faint: float = -np.inf
    tolerated: Array = field(default_factory=lambda: np.zeros(1))

    def one_window(self, errors: Array) -> bool:
        """Whether several parts of one window may show an effect: where windows are few, and noise alone is left.

        Args:
            errors: With the effect, of every part of every window.
        """
        return len(errors) < FEW_WINDOWS * self.parts and float(errors.mean()) < NOISE + ABOVE_NOISE


def default_window(episodes: Sequence[Episode], joints: Sequence[str]) -> float:
    """At most WINDOW, so that windows fill the shortest episode and there are enough of them; LEAST samples.

    The shortest pieces between pauses count for nothing as long as they hold little of the data together.
    """
    spare, counting = SPARE * sum(e.seconds for e in episodes), []
    for e in sorted(episodes, key=lambda e: (not e.piece, e.seconds)):
        spare -= e.seconds
        if not e.piece or spare < 0:
            counting.append(e)
    dt, shortest = episodes[0].dt, min(len(e.ctrl) - 1 - smooth(e, joints).half for e in counting)
    longest = min(WINDOW, sum(e.seconds for e in episodes) / MIN_WINDOWS)
    pieces = int(np.ceil(shortest * dt / longest - 0.01))
    return max(LEAST, shortest // pieces) * dt


def _fits(window: float, episodes: Sequence[Episode], joints: Sequence[str]) -> None:
    dt, longest = episodes[0].dt, max(len(e.ctrl) - 1 - smooth(e, joints).half for e in episodes)
    least, most = LEAST * dt, longest * dt
    if not least <= window <= most:
        raise UserError(
            f"--window {window:g} does not fit these episodes: from {least:g} s ({LEAST} samples) to {most:g} s (the "
            "longest of them) are possible. Leave it out, and it is chosen from the data."
        )


def default_signals(episodes: Sequence[Episode], plant: Plant) -> list[str]:
    """Positions, measured actuator forces, and sensors that the scene has too: independent witnesses.

    Velocities only start the windows.
    """
    has = [n for n in episodes[0].signals if all(n in e.signals for e in episodes)]
    sensors = [f"sensor/{name}" for name in plant.sensors()]
    positions, forces = ([n for n in has if n.startswith(kind)] for kind in ("qpos/", "force/"))
    return positions + forces + [n for n in has if n in sensors]


def prepare(
    plant: Plant,
    episodes: Sequence[Episode],
    nominal: Sequence[Term],
    *,
    window: float | None,
    signals: Sequence[str] | None,
    held_out: float | Sequence[str] | None,
    limits: Callable[[Sequence[str], Array, Array], Array] | None = None,
) -> Setup[Problem]:
    """Cut windows, measure noise and floor, and refit the nominal quantities.

    Args:
        plant: The scene, in the steps to simulate with.
        episodes: Measured ones.
        nominal: Uncertain quantities of the model.
        window: Length [s]; from the data if None.
        signals: To compare; positions, forces and known sensors if None.
        held_out: Share of the data, or names of episodes, that is never fitted; a quarter if None.
        limits: Signals, measured and predicted [W, n, S] -> error of each that the user said does not matter [S], which
            is taken for noise that stays off. None if nothing was said.
    """
    chosen = list(signals or default_signals(episodes, plant))
    missing = [s for s in chosen if any(s not in e.signals for e in episodes)]
    if missing:
        raise UserError(f"signal {missing[0]!r} is not in every episode. There are: {', '.join(episodes[0].signals)}.")
    for name in chosen:
        if name.startswith("sensor/") and name[7:] not in plant.sensors():
            there = ", ".join(plant.sensors()) or "(none)"
            raise UserError(f"signal {name!r}: the scene has no sensor of that name with one number. It has: {there}.")
    if window is not None:
        _fits(window, episodes, plant.joints)
    replayer = Replayer(plant, episodes, window or default_window(episodes, plant.joints), chosen)
    if len(replayer.windows.start) < 4:
        raise UserError(f"only {len(replayer.windows.start)} windows: give more data or a shorter --window.")
    fitted, held = split(replayer, held_out)
    noise = typical(noise_of, episodes, chosen)
    shape = replayer.windows.measured.shape
    nothing = np.zeros(shape)
    tolerated = np.zeros(len(chosen))
    first = _problem(replayer, noise, Discrepancy(nothing, np.zeros((0, *shape)), nothing), tolerated, [], [])
    base = fit(first, nominal, [t.neutral for t in nominal], fitted)
    missed = replayer.windows.measured - replayer.simulate([change_of(nominal, base.values)])[0]
    noise = np.minimum(noise, [np.median([noise_of(x) for x in missed[..., i]]) for i in range(len(chosen))])
    encoder = typical(quantum, episodes, chosen) / np.sqrt(12.0)  # hides in what is missed: it rests between two steps
    noise = np.where([s.startswith("qpos/") for s in chosen], np.maximum(noise, encoder), noise)  # a force may jump
    if limits is not None:
        measured = replayer.windows.measured
        tolerated = limits(chosen, measured, measured - missed)
        tolerated = np.where(np.isfinite(tolerated), tolerated, 0.0)  # of signals not named, nothing was said
    return _setup(replayer, noise, fitted, held, base, nominal, tolerated)


def typical(measure: Callable[[Array], float], episodes: Sequence[Episode], signals: Sequence[str]) -> Array:
    """The median over the episodes in which a signal changes, [S]; where it never does, the least of its kind."""
    told = {s: [measure(e.signals[s]) for e in episodes if np.ptp(e.signals[s]) > 0] for s in signals}
    kinds = {
        s: [float(np.median(x)) for t, x in told.items() if x and t.split("/")[0] == s.split("/")[0]] for s in told
    }
    still = [measure(episodes[0].signals[s]) for s in signals]
    return np.array(
        [np.median(told[s]) if told[s] else min(kinds[s], default=x) for s, x in zip(signals, still, strict=True)]
    )


def near_fit(setup: Setup[Problem], f: Fit, plant: Plant) -> Setup[Problem]:
    """The same windows, with what errors of a start and of the simulator's steps do to a fit, not to the nominal model.

    Where a joint sticks, for one, it no longer matters how fast it was taken to be.

    Args:
        setup: Of the nominal model.
        f: The fit.
        plant: The scene in other steps.
    """
    replayer = setup.problem.replayer.with_plant(plant)
    return _setup(replayer, setup.noise, setup.fitted, setup.held, f, setup.baseline.terms, setup.tolerated)


def _setup(
    replayer: Replayer,
    noise: Array,
    fitted: Index,
    held: Index,
    near: Fit,
    nominal: Sequence[Term],
    tolerated: Array,
) -> Setup[Problem]:
    """A problem that is right near a fit, whose first terms are the nominal ones, and its baseline."""
    own = discrepancy(replayer, near.terms, near.values)
    problem = _problem(replayer, noise, own, tolerated, near.terms, near.values)
    base = fit(problem, nominal, near.values[: len(nominal)], fitted)
    parts = max(1, -(-UNITS // len(replayer.windows.start)))
    blocks = leave_out_blocks(len(fitted))
    share = problem.floor_shares.sum(0)[np.concatenate([fitted, held])]
    least = by_parts(share, parts)  # less says nothing of the machine

    def judged(errors: Array) -> Array:
        return np.log1p(np.maximum(errors, least))

    floor, stepping = np.median(own.floor[0], (0, 1)), float(problem.floor_shares[0].mean())
    return Setup(
        problem,
        fitted,
        held,
        blocks,
        base,
        noise,
        floor,
        judged=judged,
        quiet=NOISE + QUIET,
        parts=parts,
        stepping=stepping,
        near=near,
        squared=np.expm1,
        tolerated=tolerated,
    )


def leave_out_blocks(fitted: int) -> Index:
    """Block of each fitted window, [W]: of neighbouring windows."""
    return np.minimum(np.arange(fitted) * BLOCKS // fitted, BLOCKS - 1)


def split(replayer: Any, held_out: float | Sequence[str] | None) -> tuple[Index, Index]:
    """Windows to fit and windows to hold out: whole episodes, or the end of the only one.

    Args:
        replayer: Has `windows` with the episode of each, and `episodes` with names.
        held_out: Share of the data, or names of episodes; a quarter if None.

    Raises:
        UserError: If a named episode does not exist or fills no window, or one side would be empty.
    """
    w, names = replayer.windows, [e.name for e in replayer.episodes]
    filled = np.unique(w.episode)  # episodes that are too short have no window
    everything = np.arange(len(w.start))
    if held_out is not None and not isinstance(held_out, int | float):
        wrong = [n for n in held_out if n not in names]
        if wrong:
            raise UserError(f"held-out episode {wrong[0]!r} is not in the data. There are: {', '.join(names)}.")
        long = [names[i] for i in filled]
        short = [n for n in held_out if n not in long]
        if short:
            raise UserError(
                f"held-out episode {short[0]!r} is too short for a window. Long enough are: {', '.join(long)}. Hold "
                "one of them out, or give a shorter --window."
            )
        apart = np.isin(np.array(names)[w.episode], list(held_out))
    else:
        share = 0.25 if held_out is None else float(held_out)
        if not 0 < share < 1:
            raise UserError(f"held-out share {share}: allowed are numbers between 0 and 1, or episode names.")
        if len(filled) >= 4:
            apart = np.isin(w.episode, filled[-max(1, round(share * len(filled))) :])
        else:
            apart = np.zeros(len(everything), bool)
            for i in filled:  # the end of each, so that every motion is on both sides
                mine = np.flatnonzero(w.episode == i)
                apart[mine[len(mine) - max(1, round(share * len(mine))) :]] = len(mine) > 1
    if apart.all() or not apart.any():
        raise UserError("the split leaves nothing to fit or nothing to hold out; change --held-out.")
    return everything[~apart], everything[apart]


def discrepancy(replayer: Replayer, terms: Sequence[Term], values: Sequence[Array]) -> Discrepancy:
    """How far predictions are off although the model is right.

    By the simulator's time step: what steps a quarter as long change is taken off; what is left of a second-order error
    is less than the last halving changed, and as much of a first-order one, which dry friction makes where a motion
    reverses. What is off once in a window is taken to stay off. By the clock: a force follows its command at once, and
    may always have been read before that changed, not after; where nobody knows, now the one and now the other.
    """
    plant, w, change = replayer.plant, replayer.windows, change_of(terms, values)

    def simulate(share: int) -> Array:
        """In steps of this share."""
        spec = plant.spec.copy()
        spec.option.timestep = plant.model.opt.timestep / share
        return replayer.with_plant(Plant(spec)).simulate([change])[0]

    predicted, half, quarter = replayer.simulate([change])[0], simulate(2), simulate(4)
    step = np.maximum.accumulate(np.abs(quarter - half), 1)
    clock = (
        replayer.with_forces_read(AFTER).simulate([change])[0] - replayer.with_forces_read(BEFORE).simulate([change])[0]
    )
    unsure = (w.acting == EITHER).all(-1)[..., None]
    floor = np.stack([step, np.where(unsure, 0.0, clock)])
    return Discrepancy(quarter - predicted, floor, np.where(unsure, np.abs(clock) / 2, 0.0))


def _problem(
    replayer: Replayer,
    noise: Array,
    own: Discrepancy,
    tolerated: Array,
    terms: Sequence[Term],
    values: Sequence[Array],
) -> Problem:
    w = replayer.windows
    starts = [(replayer.smooth[i], k) for i, k in zip(w.episode, w.start, strict=True)]
    sd = np.array([np.concatenate([s.q_sd[k], s.v_sd[k]]) for s, k in starts])
    speed = np.sqrt(np.mean(w.v0**2, 0)) + 1e-6
    travel = np.ptp(w.q0, axis=0) + 1e-6
    kick = np.maximum(KICK * np.concatenate([travel, speed]), np.median(sd, 0))
    change = change_of(terms, values)
    shifts = np.concatenate([np.diag(kick), -np.diag(kick)])
    y = replayer.simulate([change] * len(shifts), shift=shifts)
    half = len(kick)
    sensitivity = np.moveaxis((y[:half] - y[half:]) / (2 * kick[:, None, None, None]), 0, -1)
    return Problem(replayer, noise, own, tolerated, sd, sensitivity)


def typical_sizes(plant: Plant, replayer: Replayer) -> dict[tuple[str, str], TypicalSizes]:
    """Typical sizes by (kind, name), from the measured motion: of every joint, actuator, signal and body, and of geoms
    that touch others along it."""
    m = plant.model
    data = mujoco.MjData(m)
    q = np.concatenate([s.q for s in replayer.smooth])
    v = np.concatenate([s.v for s in replayer.smooth])
    a = np.concatenate([s.a for s in replayer.smooth])
    u = np.concatenate([e.ctrl for e in replayer.episodes])
    pick = np.linspace(0, len(q) - 1, min(200, len(q))).astype(int)
    forces, inertias, peak, needed, touching = [], [], np.zeros(m.nu), np.zeros(m.nv), {}
    filters, late = (np.flatnonzero(x[: m.nu] > y) for x, y in ((m.actuator_actadr, -1), (m.actuator_history[:, 0], 0)))
    for k in pick:
        data.qpos[:], data.qvel[:], data.ctrl[:] = q[k], v[k], u[k]
        data.act[m.actuator_actadr[filters]] = u[k][filters]
        for i in late.tolist():
            mujoco.mj_initCtrlHistory(m, data, i, None, np.full(m.actuator_history[i, 0], u[k][i]))
        mujoco.mj_forward(m, data)
        full = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, full)
        inertias.append(np.diag(full))
        forces.append(np.abs(full @ a[k]) + np.abs(data.qfrc_bias) + np.abs(data.qfrc_actuator))
        peak = np.maximum(peak, np.abs(data.actuator_force))
        needed = np.maximum(needed, np.abs(full @ a[k] + data.qfrc_bias - data.qfrc_passive))
        for contact in data.contact:
            moves = [g for g in contact.geom if g >= 0 and m.body_weldid[m.geom_bodyid[g]]]
            for g in moves[:1]:  # none where a listed pair touches without moving
                touching[m.geom(g).name] = float(contact.friction[0])
    force = np.sqrt(np.mean(np.square(forces), 0)) + 1e-9
    inertia = np.mean(inertias, 0)
    speed, travel = np.sqrt(np.mean(v**2, 0)) + 1e-6, np.std(q, 0) + 1e-6
    dt, out = replayer.dt, {}
    for i, joint in enumerate(plant.joints):
        middle = float(np.median(q[:, i]))
        at = TypicalSizes(float(force[i]), float(speed[i]), float(travel[i]), middle, float(inertia[i]), dt=dt)
        out["joint", joint] = out["signal", f"qpos/{joint}"] = at
    for i, name in enumerate(plant.actuators):
        joint = joint_of(plant, name)
        at = out["joint", joint] if joint else TypicalSizes(dt=dt)
        command = float(np.sqrt(np.mean(u[:, i] ** 2))) + 1e-9
        most = float(peak[i]) + 1e-9
        ask = float(needed[m.joint(joint).dofadr[0]] / abs(m.actuator(name).gear[0])) if joint else most
        at = at._replace(command=command, peak=most, needed=ask)
        out["actuator", name] = at._replace(command=ask) if at.idle else at
    for name in plant.bodies:
        out["body", name] = TypicalSizes(mass=float(m.body_mass[m.body(name).id]), dt=dt)
    for name, friction in touching.items():
        out["geom", name] = TypicalSizes(friction=friction, dt=dt)
    return out
