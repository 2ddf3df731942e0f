"""The whole way from a deployment's run folder to a report."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import yaml

from envs.effects.base import Effect
from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.candidates.suspects import gap_of, suspects
from mpc_sgft.diagnose.data.check import check_settings
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.deployments.chain import Chain, Prediction, effects_of
from mpc_sgft.diagnose.deployments.missing import missing
from mpc_sgft.diagnose.deployments.motion_link import JOINT_SAMPLES
from mpc_sgft.diagnose.deployments.next_recording import next_experiment
from mpc_sgft.diagnose.deployments.recordings import Deployment, read_deployment
from mpc_sgft.diagnose.deployments.residual_model import fit_residual_model
from mpc_sgft.diagnose.fitting.fit import Fit, fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup, leave_out_blocks, split
from mpc_sgft.diagnose.fitting.screening import Effort
from mpc_sgft.diagnose.fitting.search import search
from mpc_sgft.diagnose.report import Report
from mpc_sgft.diagnose.rows import (
    Shown,
    candidate_rows,
    effect_rows,
    notes_of_split,
    reduction,
    trace_rows,
    unit_of,
    waterfall,
)
from mpc_sgft.diagnose.verdict import repair
from mpc_sgft.diagnose.verdict.naming import choose as choose_set
from mpc_sgft.diagnose.verdict.naming import settled
from mpc_sgft.diagnose.verdict.relevance import repairs
from mpc_sgft.diagnose.verdict.tolerance import Predict, Tolerance, limits_of, spread_of
from mpc_sgft.diagnose.verdict.verdict import Verdict, reach_verdict
from mpc_sgft.storage.metrics import progress as bar_of

LENGTH = 6  # control steps in a window
MOST = 64  # windows
ASTRAY = 4.0  # mean square of a joint's error, in units of what noise and contacts make: that joint is suspected alone
UNITS = {"observation": "of the observation", "drive": "of the control"}  # of a signal; of joints by their kinds
FAINT = float(np.log1p(1 / 3))  # log(1 + e) of a window: no link of three errs more than noise and contacts make
EFFORT = Effort(
    beam=(2,),
    full=(5, 4, 3),
    starts=2,
    screen_windows=16,
    quick_windows=16,
    enough=0.1,  # in log(1 + e), where 0.7 is all that windows could be told apart by; most of them show nothing
    alone=3,
    pairs=0,
    exchange=0,
    most=1000,
)


def diagnose_run(
    run: Path,
    *,
    out: Path | None = None,
    effects: Sequence[str] | None = None,
    window: float | None = None,
    held_out: float | Sequence[str] | None = None,
    seed: int = 0,
    max_effects: int = 3,
    tolerance: float | Mapping[str, float | str] | None = None,
    traces: bool = False,
    progress: bool = False,
) -> Report:
    """Say what the task's simulation lacks, from what a deployment recorded; its gap is not read.

    Args:
        run: Run folder of `deploy`.
        out: Folder for the report's files; nothing is written if None.
        effects: Names of the only effects to consider; all that can act on the task if None.
        window: Length of a simulated window [s]; six control steps if None.
        held_out: Share of the episodes that is never fitted, or their names; a quarter if None.
        seed: Of the bootstrap.
        max_effects: Largest set of effects.
        tolerance: What prediction error does not matter, as for `diagnose`.
        traces: Whether effects.yaml and repaired.xml hold traces too.
        progress: Show a progress bar on stderr.

    Raises:
        UserError: For a folder that cannot be used.
    """
    check_settings(window, seed, max_effects)
    began, rng = time.perf_counter(), np.random.default_rng(seed)
    deployment = read_deployment(run)
    setup = prepare(deployment, window, held_out)
    tolerated = tolerance_of(setup, tolerance)
    lost = astray(setup.problem)
    terms = [s.term() for s in suspects(deployment.task, effects, lost)]
    with bar_of(100, desc="diagnose", unit="%", disable=not progress) as bar:

        def show(what: str, share: float) -> None:
            bar.set_postfix_str(what)
            bar.update(round(95 * share) - bar.n)

        setup, hypotheses = search(setup, terms, max_effects, rng, show, EFFORT)
        best = choose_set(setup, hypotheses, rng)
        residual_model = None if settled(best) else fit_residual_model(setup, best, rng)
        verdict = reach_verdict(setup, hypotheses, residual_model, rng, tolerated)
        if (
            verdict.kind in ("none", "unknown")
            and lost
            and not (verdict.there.effects or tolerated.allows(setup.baseline))
        ):
            reason = (
                f"{', '.join(lost)}: the measured forces move it otherwise than foretold, and no name explains that"
            )
            verdict = verdict._replace(kind="unknown", reason=reason)
        bar.update(100 - bar.n)
    notes = [*deployment.notes, *notes_of_split(len(deployment.episodes), setup.held)]
    held = verdict.whole if traces else verdict.best
    report = assemble(setup, hypotheses, verdict, held, notes, rng, residual_model and residual_model.error)
    if out is not None:
        lowers = repairs(setup, held, verdict.there, hypotheses[0], rng)
        repair.into(out, report.data, held, lowers, lambda: write(deployment, held, out))
        if report.data["repaired_model"]:
            report.diff = repair.diff(deployment.task.spec(), out / report.data["repaired_model"])
    report.data["seconds"] = round(time.perf_counter() - began, 2)
    if out is not None:
        report.write(out)
    return report


def prepare(deployment: Deployment, window: float | None, held_out: float | Sequence[str] | None) -> Setup[Chain]:
    """Cut windows, measure noise and floor, and split episodes.

    Sets are compared by the logarithm of windows' errors: objects are hit in few windows, and those differ by orders of
    magnitude in how much they tell. An error is in units of what noise and contacts make.
    """
    dt = deployment.task.control_dt
    length = LENGTH if window is None else max(1, round(window / dt))
    chain = Chain(deployment, length, MOST)
    fitted, held = split(replayer_view(chain), held_out)
    blocks = leave_out_blocks(len(fitted))
    floor = np.concatenate(
        [chain.observation_floor, np.full(chain.drive.shape[2], chain.drive_scale), chain.joint_floor]
    )
    noise = np.concatenate([chain.noise, np.zeros(len(floor) - len(chain.noise))])
    return Setup(chain, fitted, held, blocks, fit(chain, [], [], fitted), noise, floor, np.log1p, faint=FAINT)


def astray(chain: Chain) -> list[str]:
    """Joints that the measured drives move otherwise than foretold, by more than noise and contacts can tell."""
    everything = np.arange(len(chain.windows.start))
    misses = (chain.predict([()], everything).joints[0] / chain.joint_scale) ** 2  # [W, n J, nj]
    worse = misses.mean((0, 1)) > ASTRAY
    return [name.removeprefix("qpos/") for name, x in zip(chain.groups["qpos"], worse, strict=True) if x]


def tolerance_of(setup: Setup[Chain], tolerance: float | Mapping[str, float | str] | None) -> Tolerance:
    """Prediction errors of the observations and of the control that reaches the servos that may not matter."""
    chain, names = setup.problem, signal_names(setup.problem)
    measured = seen(chain.observed, chain.drive)
    predict, units = _predict(chain), [UNITS[n.split("/")[0]] for n in names]
    limits = limits_of(tolerance, names, units, spread_of(measured, predict([setup.baseline])[0], units))
    return Tolerance(limits, predict, measured, setup.noise[: len(names)], tolerance is not None)


def _predict(chain: Chain) -> Predict:
    everything = np.arange(len(chain.windows.start))

    def predict(fits: Sequence[Fit]) -> Array:
        y = chain.predict([effects_of(f.terms, f.values) for f in fits], everything)
        return seen(y.observation, y.drive)

    return predict


def signal_names(chain: Chain) -> list[str]:
    """Observations and the control that reaches the servos."""
    return chain.groups["observation"] + chain.groups["drive"]


def seen(observation: Array, drive: Array) -> Array:
    """Both at the end of each control step, [..., n, O + nu]."""
    return np.concatenate([observation, drive[..., JOINT_SAMPLES - 1 :: JOINT_SAMPLES, :]], -1)


def assemble(
    setup: Setup[Chain],
    hypotheses: list[Hypothesis],
    verdict: Verdict,
    held: Hypothesis,
    notes: list[str],
    rng: np.random.Generator,
    residual_model_error: float | None,
) -> Report:
    """Everything that the report says, `held` in the repaired model; keys as for `--model --data`."""
    chain, best = setup.problem, verdict.best
    everything = np.arange(len(chain.windows.start))
    sets = [(), effects_of(held.terms, held.values)]
    both = chain.predict(sets, everything)
    shown = verdict.kind in ("effect", "not_identifiable")
    tied = [best, *(e for e, _ in verdict.ties)]
    names = [n for group in chain.groups.values() for n in group]
    signals = held_out_rows(chain, both, setup, rng)
    units = {n: UNITS[n.split("/")[0]] for n in signal_names(chain)}
    rows = Shown(_predict(chain), units, partial(unit_at, chain.motion.model))
    data: dict[str, Any] = {
        "verdict": verdict.kind,
        "reason": verdict.reason,
        "effects": effect_rows(setup, verdict, hypotheses, rows) if shown else [],
        "traces": trace_rows(setup, verdict, hypotheses, rows),
        "candidates": candidate_rows(hypotheses, best, verdict, rng),
        "waterfall": waterfall(setup, verdict, hypotheses, rows, seen(chain.observed, chain.drive), signals),
        "ties": [
            {"effects": e.names, "probability": verdict.probability[e.key], "held_out_error": e.error, "reason": reason}
            for e, reason in verdict.ties
        ],
        "next_experiment": next_experiment(chain, tied) if len(tied) > 1 else "",
        "nominal_refit": {},
        "where": where(chain, both),
        "held_out": signals[0],
        "signals": signals,
        "noise_floor": {
            n: {"noise": float(a), "simulator": float(b)}
            for n, a, b in zip(names, setup.noise, setup.floor, strict=True)
        },
        "residual_model_error": residual_model_error,
        "seconds": 0.0,
        "repaired_model": None,
        "effects_file": None,
        "notes": notes,
    }
    measured = seen(chain.observed, chain.drive)
    nominal, repaired = seen(both.observation, both.drive)
    return Report(data, measured, nominal, repaired, replayer_view(chain), missing(chain, both, bool(held.effects)))


def unit_at(model: mujoco.MjModel, term: Term, unit: str) -> str:
    """Of "N m or N", the one that belongs to the joints at which an effect is; both where they differ."""
    action, _, control = unit.partition(", or ")
    if control:
        return "of the control" if term.at else action
    named = [model.joint(name).id for name in term.at if name in {model.joint(i).name for i in range(model.njnt)}]
    kinds = model.jnt_type[named or model.actuator_trnid[:, 0]]
    return unit_of(unit, (kinds == int(mujoco.mjtJoint.mjJNT_SLIDE)).tolist())


def unit_of_signal(model: mujoco.MjModel, name: str) -> str:
    """Of a compared signal; joints turn or slide."""
    kind, _, part = name.partition("/")
    if kind != "qpos":
        return UNITS[kind]
    return "m" if model.joint(part).type == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"


def errors_of(chain: Chain, y: Prediction) -> Array:
    """Mean square error of every signal in every window, [K, W, S], in the signals' own units."""
    observation = ((y.observation - chain.observed) ** 2).mean(2)
    return np.concatenate([observation, ((y.drive - chain.drive) ** 2).mean(2), (y.joints**2).mean(2)], 2)


def where(chain: Chain, both: Prediction) -> list[dict[str, Any]]:
    """Shares of the nominal error by signal, and by whether an object moved in the window, largest first."""
    everything = np.arange(len(chain.windows.start))
    parts = [p[0] for p in chain.whitened(Prediction(*(x[:1] for x in both)), everything)]
    rows, total = [], sum(float((p**2).mean()) for p in parts)
    for part, names in zip(parts, chain.groups.values(), strict=True):
        square = (part.reshape(len(part), -1, len(names)) ** 2).mean(1) / len(names)  # [W, S]
        for regime, mask in (
            ("all", np.ones(len(part), bool)),
            ("object moves", chain.moving),
            ("object rests", ~chain.moving),
        ):
            share = square[mask].sum(0) / len(part) / max(total, 1e-30)
            rows += [
                {"signal": n, "regime": regime, "share_of_error": float(s), "share_of_time": float(mask.mean())}
                for n, s in zip(names, share, strict=True)
            ]
    return sorted(rows, key=lambda row: -row["share_of_error"])


def held_out_rows(
    chain: Chain, both: Prediction, setup: Setup[Chain], rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Errors of every signal on windows that were never fitted, the worst in units of its scale first."""
    nominal, repaired = errors_of(chain, both)[:, setup.held]
    names = [n for group in chain.groups.values() for n in group]
    seen, joints = ((s**2).mean((0, 1)) for s in (chain.observation_scale, chain.joint_scale))
    scale = np.concatenate([seen, np.full(len(chain.groups["drive"]), chain.drive_scale**2), joints])
    units = [unit_of_signal(chain.motion.model, n) for n in names]
    return [
        reduction(names[i], units[i], nominal[:, i], repaired[:, i], rng) for i in np.argsort(-nominal.mean(0) / scale)
    ]


def write(deployment: Deployment, best: Hypothesis, out: Path) -> list[str]:
    """Write effects.yaml and repaired.xml, the task's scene with the effects that MJCF carries; returns notes."""
    mapping, notes = gap_of(deployment.task, best.terms, best.values), []
    text = yaml.safe_dump({"effects": mapping}, sort_keys=False)
    (out / "effects.yaml").write_text("# Written by mpc_sgft.diagnose.\n" + text)
    spec = deployment.task.spec()
    for term, value in zip(best.terms, best.values, strict=True):
        for effect in term.build(value):
            effect.edit_spec(spec)
            if type(effect).command is not Effect.command or not type(effect).native:
                notes.append(
                    f"{term.label}: it acts on commands or observations, MJCF cannot carry it; use effects.yaml"
                )
    path = out / "repaired.xml"
    spec.compile()
    path.write_text(spec.to_xml())
    mujoco.MjModel.from_xml_path(str(path))
    return notes


def replayer_view(chain: Chain) -> Any:
    """What Report needs to draw: signals, windows, and the clock."""
    return SimpleNamespace(
        signals=signal_names(chain),
        windows=chain.windows,
        dt=chain.task.control_dt,
        episodes=[SimpleNamespace(name=e.name, seconds=len(e.action) * chain.task.control_dt) for e in chain.episodes],
    )
