"""The whole way from files to a report."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.candidates.library import Term, candidates
from mpc_sgft.diagnose.candidates.nominal import nominal_terms, refit_table
from mpc_sgft.diagnose.data.check import check_settings, episodes
from mpc_sgft.diagnose.data.mapping import Source
from mpc_sgft.diagnose.data.measured import Array, Episode
from mpc_sgft.diagnose.data.sources import named, opened, sources, tables
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import Fit, Problem, change_of
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup, near_fit, prepare, typical_sizes
from mpc_sgft.diagnose.fitting.residual_model import fit_residual_model
from mpc_sgft.diagnose.fitting.screening import key_of
from mpc_sgft.diagnose.fitting.search import nearest, refit, search
from mpc_sgft.diagnose.page.laws import missing_forces
from mpc_sgft.diagnose.report import Report
from mpc_sgft.diagnose.rows import (
    Shown,
    candidate_rows,
    effect_rows,
    notes_of_rest,
    notes_of_short,
    notes_of_split,
    reduction,
    trace_rows,
    unit_of,
    waterfall,
)
from mpc_sgft.diagnose.simulation.plant import SHARP, Change, Plant, driven, joint_of
from mpc_sgft.diagnose.simulation.replay import Replayer
from mpc_sgft.diagnose.verdict import repair
from mpc_sgft.diagnose.verdict.locate import locate
from mpc_sgft.diagnose.verdict.naming import choose as choose_set
from mpc_sgft.diagnose.verdict.naming import settled
from mpc_sgft.diagnose.verdict.next_experiment import next_experiment
from mpc_sgft.diagnose.verdict.relevance import repairs
from mpc_sgft.diagnose.verdict.tolerance import Predict, Tolerance, limits_of, spread_of
from mpc_sgft.diagnose.verdict.verdict import Verdict, reach_verdict
from mpc_sgft.storage.metrics import progress as bar_of

AWAY = 10.0  # times the range of what was measured: no window of a motion leads there
STEPS = (4 * SHARP, 2 * SHARP, SHARP)  # [s] to simulate with: the longest whose error noise hides
APART = 0.05  # of a sample, by which two clocks may differ at the end of an episode
UNSEEN, NOTHING = 0.2, 0.1  # share of the expected squared error that noise hides in a search, and in a judgement


def read(
    plant: Plant, data: Sequence[str | Path], mapping: Mapping[str, Source] | None = None
) -> tuple[Plant, list[Episode]]:
    """All episodes of the files, on one clock, and the model with the motors that they need.

    Args:
        plant: The model.
        data: Files and folders.
        mapping: Columns of other names, units and signs.

    Raises:
        UserError: If they are not usable or do not share a sample time.
    """
    machine = plant.machine()
    recorded = [
        named(table, machine) for path in sources(data) for table in tables(opened(path), mapping or {}, machine)
    ]
    plant = driven(plant, recorded)
    axes, servos = plant.axes(), plant.servos()
    each = [episodes(table, plant.actuators, axes, servos) for table in recorded]
    steps = [e.dt for own in each for e in own]
    if max(steps) > 1.05 * min(steps):
        raise UserError(
            f"episodes have different sample times ({min(steps):g} to {max(steps):g} s); diagnose them apart."
        )
    clock = each[0][0].dt
    for i, (table, own) in enumerate(zip(recorded, each, strict=True)):
        if max(abs(e.dt - clock) * len(e.ctrl) for e in own) > APART * clock:
            each[i] = episodes(table, plant.actuators, axes, servos, clock)
    return plant, [e for own in each for e in own]


def run(
    plant: Plant,
    recorded: Sequence[Episode],
    *,
    out: Path | None,
    effects: Sequence[str] | None,
    signals: Sequence[str] | None,
    window: float | None,
    held_out: float | Sequence[str] | None,
    uncertain: Mapping[str, float],
    seed: int,
    max_effects: int,
    tolerance: float | Mapping[str, float | str] | None,
    traces: bool,
    progress: bool,
) -> Report:
    """As `mpc_sgft.diagnose.diagnose`, on episodes in memory."""
    check_settings(window, seed, max_effects)
    began, rng = time.perf_counter(), np.random.default_rng(seed)
    nominal = nominal_terms(plant, uncertain)
    steps = sorted({min(step, recorded[0].dt) for step in STEPS}, reverse=True)
    limits = None if tolerance is None else partial(_limits, plant, tolerance)

    def prepared(step: float) -> Setup[Problem]:
        scene = plant.sharper(step)
        return prepare(scene, recorded, nominal, window=window, signals=signals, held_out=held_out, limits=limits)

    setup = _coarsest(map(prepared, steps), UNSEEN)

    def nearer(f: Fit, hidden: float = UNSEEN) -> Setup[Problem]:
        return _coarsest((near_fit(setup, f, plant.sharper(step)) for step in steps), hidden)

    sharp = plant.sharper()
    sizes = typical_sizes(sharp, setup.problem.replayer)
    with bar_of(100, desc="diagnose", unit="%", disable=not progress) as bar:

        def show(what: str, share: float) -> None:
            bar.set_postfix_str(what)
            bar.update(max(0, round(90 * share) - bar.n))

        terms = candidates(sharp, sizes, effects)
        first = setup
        setup, hypotheses = search(first, terms, max_effects, rng, show, nearer=nearer)
        best = choose_set(setup, hypotheses, rng)
        near = best if best.effects else nearest(hypotheses)
        if near.effects and not _sees(setup, near):  # windows began as another set sees it: look again as this one does
            was, unmoved, setup = near.error, setup is first, nearer(near.fit, NOTHING)
            hypotheses = refit(setup, hypotheses, near)
            best = choose_set(setup, hypotheses, rng)
            if unmoved and not settled(best) and was - best.error > judge.least_gain(was):
                setup, hypotheses = search(setup, terms, max_effects, rng, show)
                best = choose_set(setup, hypotheses, rng)
        residual_model = None if settled(best) else fit_residual_model(setup, best, sizes, rng)
        verdict = reach_verdict(setup, hypotheses, residual_model, rng, tolerance_of(setup, tolerance))
        bar.update(100 - bar.n)
    notes = [*plant.notes, *plant.notes_of_delays(), *(n for e in recorded for n in e.notes)]
    held = verdict.whole if traces else verdict.best
    left = residual_model and residual_model.error
    fitted = setup.problem.replayer
    used, length = fitted.windows.episode, fitted.windows.samples * fitted.dt
    notes += [*notes_of_short([e.name for e in recorded], used, length), *notes_of_split(len(set(used)), setup.held)]
    own = Replayer(plant, fitted.episodes, length, fitted.signals)
    unstable = runs_away(own, fitted, held)
    if unstable:
        notes.append(f"errors are those in steps of {1e3 * fitted.h:g} ms, not in the scene's own")
    report = assemble(setup, hypotheses, verdict, held, notes, rng, left, fitted if unstable else own)
    if out is not None:
        lowers = repairs(setup, held, verdict.there, hypotheses[0], rng)
        repair.into(out, report.data, held, lowers, lambda: repair.write(plant, held, out), unstable)
        if report.data["repaired_model"]:
            report.diff = repair.diff(repair.nominal_spec(plant), out / report.data["repaired_model"])
    report.data["seconds"] = round(time.perf_counter() - began, 2)
    if out is not None:
        report.write(out)
    return report


def tolerance_of(setup: Setup[Problem], tolerance: float | Mapping[str, float | str] | None) -> Tolerance:
    """Prediction errors of the compared signals that may not matter."""
    replayer = setup.problem.replayer
    measured, predict = replayer.windows.measured, _predict(replayer)
    limits = _limits(replayer.plant, tolerance, replayer.signals, measured, predict([setup.baseline])[0])
    return Tolerance(limits, predict, measured - setup.problem.known, setup.noise, tolerance is not None)


def _limits(
    plant: Plant,
    tolerance: float | Mapping[str, float | str] | None,
    signals: Sequence[str],
    measured: Array,
    predicted: Array,
) -> Array:
    """Tolerated error of each signal of a scene, [S]; measured and predicted are [W, n, S]."""
    units = [_unit(plant, name) for name in signals]
    return limits_of(tolerance, signals, units, spread_of(measured, predicted, units))


def _predict(replayer: Replayer) -> Predict:
    return lambda fits: replayer.simulate([change_of(f.terms, f.values) for f in fits])


def _coarsest(setups: Iterable[Setup[Problem]], hidden: float) -> Setup[Problem]:
    """The first of setups in ever shorter steps whose error makes less than this share, or the last."""
    for setup in setups:
        if setup.stepping < hidden:
            break
    return setup


def _sees(setup: Setup[Problem], e: Hypothesis) -> bool:
    """Whether the problem is right near this set, in steps that are short enough."""
    return setup.near is not None and key_of(setup, setup.near.terms) == e.key and setup.stepping < NOTHING


def runs_away(own: Replayer, sharp: Replayer, held: Hypothesis) -> str:
    """That the scene's own time step is too long for what is in the repaired model, in words; else none.

    In shorter steps, with which it was fitted, it stays near what was measured.
    """
    span = np.ptp(sharp.windows.measured, axis=(0, 1))
    far = np.where(span > 0, AWAY * span, np.inf)  # a signal that stood still says nothing
    change = change_of(held.fit.terms, held.fit.values)
    left, too = (bool((np.abs(r.simulate([change])[0] - r.windows.measured) > far).any()) for r in (own, sharp))
    if too or not left:
        return ""
    what = " + ".join(held.names) or "refitted quantities"
    return (
        f"with {what} the scene runs away in its own timestep of {1e3 * own.h:g} ms. In one of {1e3 * sharp.h:g} ms it "
        "does not: set that in the scene, and diagnose again"
    )


def assemble(
    setup: Setup,
    hypotheses: list[Hypothesis],
    verdict: Verdict,
    held: Hypothesis,
    notes: list[str],
    rng: np.random.Generator,
    residual_model_error: float | None,
    replayer: Replayer,
) -> Report:
    """Everything that the report says, `held` in the repaired model; errors are those of `replayer`."""
    best, base, plant = verdict.best, setup.baseline, replayer.plant
    rows = Shown(_predict(replayer), {n: _unit(plant, n) for n in replayer.signals}, partial(unit_at, plant))
    nominal, repaired = replayer.simulate([Change(), change_of(held.fit.terms, held.fit.values)])
    measured = replayer.windows.measured
    signals = _signals(setup, nominal, repaired, measured, rng)
    shown = verdict.kind in ("effect", "not_identifiable")
    if shown:
        which, unit = signals[0]["signal"], signals[0]["unit"]
        off = ((nominal - measured) ** 2).mean(1)[:, replayer.signals.index(which)]
        notes = [*notes, *notes_of_rest(which, unit, off, setup.held)]
    ties = [
        {"effects": e.names, "probability": verdict.probability[e.key], "held_out_error": e.error, "reason": reason}
        for e, reason in verdict.ties
    ]
    tied = [best, *(e for e, _ in verdict.ties)]
    data: dict[str, Any] = {
        "verdict": verdict.kind,
        "reason": verdict.reason,
        "effects": effect_rows(setup, verdict, hypotheses, rows) if shown else [],
        "traces": trace_rows(setup, verdict, hypotheses, rows),
        "candidates": candidate_rows(hypotheses, best, verdict, rng),
        "waterfall": waterfall(setup, verdict, hypotheses, rows, measured, signals),
        "ties": ties,
        "next_experiment": next_experiment(setup, tied) if len(tied) > 1 else "",
        "nominal_refit": refit_table(list(base.terms), list(best.fit.values[: len(base.terms)])),
        "where": locate(setup),
        "held_out": signals[0],
        "signals": signals,
        "noise_floor": {
            name: {"noise": float(setup.noise[i]), "simulator": float(setup.floor[i])}
            for i, name in enumerate(replayer.signals)
        },
        "residual_model_error": residual_model_error,
        "seconds": 0.0,
        "repaired_model": None,
        "effects_file": None,
        "notes": notes,
    }
    return Report(data, measured, nominal, repaired, replayer, missing_forces(setup, held.fit))


def _signals(
    setup: Setup, nominal: Array, repaired: Array, measured: Array, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Errors of every signal on windows that were never fitted, the worst in units of its noise first."""
    held, problem = setup.held, setup.problem
    before, after = (((p - measured)[held] ** 2).mean(1) for p in (nominal, repaired))  # [W, S]
    worst = np.argsort(-before.mean(0) / (problem.scale[held] ** 2).mean((0, 1)))
    names = problem.replayer.signals
    units = [_unit(problem.replayer.plant, name) for name in names]
    return [reduction(names[i], units[i], before[:, i], after[:, i], rng) for i in worst]


def unit_at(plant: Plant, term: Term, unit: str) -> str:
    """Of "N m or N", the one that belongs to the joint at which an effect is; both where it is at no joint."""
    where = term.at[0] if term.at else ""
    if ", or of the control" in unit:  # else of an action, and a bare scene has none
        return "of the control"
    if unit == "of the observation" and where.startswith("qpos/"):
        return _unit(plant, where)
    joint = where.removeprefix("qpos/")
    joint = joint_of(plant, joint) if joint in plant.actuators else joint
    return unit_of(unit, [plant.axes()[joint].slide] if joint in plant.joints else [])


def _unit(plant: Plant, signal: str) -> str:
    kind, part = signal.split("/", 1)
    if kind == "force":
        return "N or N m"
    if kind not in ("qpos", "qvel"):
        return "1"
    slide = plant.model.joint(part).type[0] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return ("m" if slide else "rad") + ("/s" if kind == "qvel" else "")
