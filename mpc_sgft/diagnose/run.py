"""The whole way from files to a report."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.candidates.library import candidates, effect_parameters, sums_of
from mpc_sgft.diagnose.candidates.nominal import nominal_terms, refit_table
from mpc_sgft.diagnose.data.check import check_settings, episodes
from mpc_sgft.diagnose.data.measured import Array, Episode, files, read_table
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.fit import Fit, Problem, change_of
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup, near_fit, prepare, typical_sizes
from mpc_sgft.diagnose.fitting.residual_model import fit_residual_model
from mpc_sgft.diagnose.fitting.screening import key_of
from mpc_sgft.diagnose.fitting.search import nearest, refit, search
from mpc_sgft.diagnose.report import MAX_CANDIDATES, Report
from mpc_sgft.diagnose.simulation.plant import SHARP, Change, Plant
from mpc_sgft.diagnose.simulation.replay import Replayer
from mpc_sgft.diagnose.verdict import repair
from mpc_sgft.diagnose.verdict.locate import locate
from mpc_sgft.diagnose.verdict.naming import Verdict, caution, effect_probability, intervals, reach_verdict, settled
from mpc_sgft.diagnose.verdict.naming import choose as choose_set
from mpc_sgft.diagnose.verdict.next_experiment import next_experiment
from mpc_sgft.storage.metrics import progress as bar_of

STEPS = (4 * SHARP, 2 * SHARP, SHARP)  # [s] to simulate with: the longest whose error noise hides
UNSEEN, NOTHING = 0.2, 0.1  # share of the expected squared error that noise hides in a search, and in a judgement


def read(plant: Plant, data: Sequence[str | Path]) -> list[Episode]:
    """All episodes of the files, on one clock.

    Raises:
        UserError: If they are not usable or do not share a sample time.
    """
    axes, servos = plant.axes(), plant.servos()
    found = [e for path in files(data) for e in episodes(read_table(path), plant.actuators, axes, servos)]
    steps = [e.dt for e in found]
    if max(steps) > 1.05 * min(steps):
        raise UserError(
            f"episodes have different sample times ({min(steps):g} to {max(steps):g} s); diagnose them apart."
        )
    return found


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
    progress: bool,
) -> Report:
    """As `mpc_sgft.diagnose.diagnose`, on episodes in memory."""
    check_settings(window, seed, max_effects)
    began, rng = time.perf_counter(), np.random.default_rng(seed)
    nominal = nominal_terms(plant, uncertain)
    steps = sorted({min(step, recorded[0].dt) for step in STEPS}, reverse=True)
    setup = _coarsest(
        (
            prepare(plant.sharper(step), recorded, nominal, window=window, signals=signals, held_out=held_out)
            for step in steps
        ),
        UNSEEN,
    )

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
        verdict = reach_verdict(setup, hypotheses, residual_model, rng)
        bar.update(100 - bar.n)
    notes = [n for e in recorded for n in e.notes]
    if len(recorded) == 1:
        notes.append("one episode only: its end is held out, so that both sides come from the same run")
    notes += caution(verdict)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        notes += repair.write(plant, verdict.best, out)
    report = assemble(plant, setup, hypotheses, verdict, notes, rng, residual_model and residual_model.error)
    report.data["seconds"] = round(time.perf_counter() - began, 2)
    if out is not None:
        report.write(out)
    return report


def _coarsest(setups: Iterable[Setup[Problem]], hidden: float) -> Setup[Problem]:
    """The first of setups in ever shorter steps whose error makes less than this share, or the last."""
    for setup in setups:
        if setup.stepping < hidden:
            break
    return setup


def _sees(setup: Setup[Problem], e: Hypothesis) -> bool:
    """Whether the problem is right near this set, in steps that are short enough."""
    return setup.near is not None and key_of(setup, setup.near.terms) == e.key and setup.stepping < NOTHING


def assemble(
    plant: Plant,
    setup: Setup,
    hypotheses: list[Hypothesis],
    verdict: Verdict,
    notes: list[str],
    rng: np.random.Generator,
    residual_model_error: float | None,
) -> Report:
    """Everything that the report says; errors are those of the scene in its own steps."""
    best, base, sharp = verdict.best, setup.baseline, setup.problem.replayer
    replayer = Replayer(plant, sharp.episodes, sharp.windows.samples * sharp.dt, sharp.signals)
    nominal, repaired = replayer.simulate([Change(), change_of(best.fit.terms, best.fit.values)])
    measured = replayer.windows.measured
    signals = _signals(setup, nominal, repaired, measured, rng)
    shown = verdict.kind in ("effect", "not_identifiable")
    ties = [
        {"effects": e.names, "probability": verdict.probability[e.key], "held_out_error": e.error, "reason": reason}
        for e, reason in verdict.ties
    ]
    tied = [best, *(e for e, _ in verdict.ties)]
    data: dict[str, Any] = {
        "verdict": verdict.kind,
        "reason": verdict.reason,
        "effects": effect_rows(best, hypotheses, verdict) if shown else [],
        "candidates": candidate_rows(hypotheses, best, verdict, rng),
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
        "repaired_model": "repaired.xml",
        "effects_file": "effects.yaml",
        "notes": notes,
    }
    return Report(data, measured, nominal, repaired, replayer)


def effect_rows(best: Hypothesis, hypotheses: list[Hypothesis], verdict: Verdict) -> list[dict[str, Any]]:
    """What the report says of each named effect."""
    out = []
    bounds = intervals(best)
    shares = effect_probability(best, hypotheses, verdict.probability)
    for term, value, (low, high), share in zip(best.terms, best.values, bounds, shares, strict=True):
        columns = [effect_parameters(term.effect, term.names, x) for x in (value, low, high)]
        units = dict(zip(term.names, term.units, strict=True))
        sums = sums_of(term.effect)
        out.append(
            {
                "name": term.effect,
                "at": list(term.at),
                "parameters": {
                    name: {
                        "value": columns[0][name],
                        "unit": units.get(name) or units[sums[name][0]],
                        "low": columns[1][name],
                        "high": columns[2][name],
                    }
                    for name in columns[0]
                },
                "probability": share,
            }
        )
    return out


def candidate_rows(
    hypotheses: list[Hypothesis], best: Hypothesis, verdict: Verdict, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Ranked: what is named, what ties, then by error and size, first what has no more effects than what is named."""
    front = [best.key, *(e.key for e, _ in verdict.ties)]
    size = len(best.errors)

    def order(e: Hypothesis) -> tuple[int, bool, float]:
        place = front.index(e.key) if e.key in front else len(front)
        return place, e.effects > best.effects, e.error * (1 + e.complexity / size)

    out = []
    for e in sorted(hypotheses, key=order)[:MAX_CANDIDATES]:
        interval = judge.gain(e.errors, np.zeros(size), 0.90, rng)
        out.append(
            {
                "effects": e.names,
                "held_out_error": e.error,
                "low": interval.low,
                "high": interval.high,
                "probability": verdict.probability[e.key],
            }
        )
    return out


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


def _unit(plant: Plant, signal: str) -> str:
    kind, part = signal.split("/", 1)
    if kind == "force":
        return "N or N m"
    if kind not in ("qpos", "qvel"):
        return "1"
    slide = plant.model.joint(part).type[0] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return ("m" if slide else "rad") + ("/s" if kind == "qvel" else "")


def reduction(signal: str, unit: str, before: Array, after: Array, rng: np.random.Generator) -> dict[str, Any]:
    """Root mean square error of one signal before and after, and by how much it fell, with its 90 % interval.

    Args:
        signal, unit: Of the signal.
        before, after: Mean square error of each held-out window, [W].
        rng: For the bootstrap.
    """
    picks = rng.integers(0, len(before), (judge.RESAMPLES, len(before)))
    drops = 1 - np.sqrt(after[picks].mean(1) / np.maximum(before[picks].mean(1), 1e-300))
    low, high = np.quantile(drops, [0.05, 0.95])
    rms = [float(np.sqrt(x.mean())) for x in (before, after)]
    return {
        "signal": signal,
        "unit": unit,
        "nominal": rms[0],
        "repaired": rms[1],
        "reduction": 1 - rms[1] / max(rms[0], 1e-300),
        "low": float(low),
        "high": float(high),
    }
