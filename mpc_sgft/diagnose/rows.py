"""Rows of report.json: effects, traces, candidates, and errors before and after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose.candidates.library import Term, effect_parameters, sums_of
from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.fitting import judge
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, without_effect
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.verdict.naming import effect_probability
from mpc_sgft.diagnose.verdict.relevance import Relevance, by_window, foretold, mean_error
from mpc_sgft.diagnose.verdict.tolerance import Predict
from mpc_sgft.diagnose.verdict.verdict import Verdict

AT_REST = 0.1  # of the nominal error over all windows: where less is held out, that says little
MAX_CANDIDATES = 20


class Shown(NamedTuple):
    """How effects are shown.

    Attributes:
        predict: Fits -> predictions.
        signals: That are predicted -> their unit.
        unit: An effect and the unit of its parameter, such as "N m or N" -> the one of the two that it is there.
    """

    predict: Predict
    signals: Mapping[str, str]
    unit: Callable[[Term, str], str] = lambda term, unit: unit


def unit_of(unit: str, slides: Sequence[bool]) -> str:
    """Of "N m or N", the one of joints that all turn or all slide; both where they differ or there are none."""
    turning, _, sliding = unit.partition(" or ")
    return unit if not sliding or len(set(slides)) != 1 else sliding if slides[0] else turning


def effect_rows(
    setup: Setup[Any], verdict: Verdict, hypotheses: list[Hypothesis], shown: Shown
) -> list[dict[str, Any]]:
    """What the report says of each named effect, those that would be missed most first."""
    best, out = verdict.best, []
    wins = effect_probability(best, hypotheses, verdict.probability)
    changes = changes_of(setup, best, hypotheses, shown.predict)
    for term, value, (low, high), win, s, change in zip(
        best.terms, best.values, verdict.intervals, wins, verdict.shares, changes, strict=True
    ):
        row = _row(s, value, change, shown)
        lows, highs = (effect_parameters(term.effect, term.names, x) for x in (low, high))
        for name, parameter in row["parameters"].items():
            parameter |= {"low": lows[name], "high": highs[name]}
        out.append(row | {"probability": win})
    return sorted(out, key=lambda row: -row["share"]["value"])


def trace_rows(setup: Setup[Any], verdict: Verdict, hypotheses: list[Hypothesis], shown: Shown) -> list[dict[str, Any]]:
    """What the report says of each effect that is there and does not matter."""
    there = verdict.there
    changes = dict(zip(there.names, changes_of(setup, there, hypotheses, shown.predict), strict=True))
    none = np.full(len(shown.signals), np.nan)  # where a simpler effect took its place before it was left out
    return [_row(s, s.value, changes.get(s.term.label, none), shown) for s in verdict.traces]


def _row(s: Relevance, value: Array, change: Array, shown: Shown) -> dict[str, Any]:
    units, sums = dict(zip(s.term.names, s.term.units, strict=True)), sums_of(s.term.effect)
    return {
        "name": s.term.effect,
        "at": list(s.term.at),
        "parameters": {
            name: {"value": x, "unit": shown.unit(s.term, units.get(name) or units[sums[name][0]])}
            for name, x in effect_parameters(s.term.effect, s.term.names, value).items()
        },
        "share": {"value": s.share, "low": s.low, "high": s.high},
        "changes": [
            {"signal": n, "unit": u, "rms": float(x)}
            for (n, u), x in zip(shown.signals.items(), change, strict=True)
            if np.isfinite(x)
        ],
    }


def waterfall(
    setup: Setup[Any],
    verdict: Verdict,
    hypotheses: list[Hypothesis],
    shown: Shown,
    measured: Array,
    worst: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Error of a signal on windows that were never fitted, as effects join the model, up to the noise.

    Those that would be missed most join first.

    Args:
        setup: Problem and baseline.
        verdict: The answer.
        hypotheses: All that were fitted.
        shown: Predictions and signals.
        measured: [W, n, S].
        worst: Rows of `reduction`, the worst signal first: the first of those shown is drawn.
    """
    sets, e, told = [], verdict.best, foretold(setup, verdict.there)
    while e.effects:
        sets.append(e)
        less = [without_effect(setup, e, i, hypotheses) for i in range(e.effects)]
        e = min(less, key=lambda h: mean_error(setup, h, told))
    sets = [hypotheses[0], *sets[::-1]]
    names = ["nominal", *(_added(a, b) for a, b in zip(sets, sets[1:], strict=False))]
    if verdict.traces:
        sets.append(verdict.there)
        names.append("traces")
    signal = next(row["signal"] for row in worst if row["signal"] in shown.signals)
    i = list(shown.signals).index(signal)
    y = shown.predict([e.fit for e in sets])[..., i]
    errors = np.sqrt(((y - measured[..., i]) ** 2)[:, setup.held].mean((1, 2)))  # [K]
    steps = zip([*names, "noise"], [*errors, np.hypot(setup.noise[i], setup.floor[i])], strict=True)
    return [{"what": what, "signal": signal, "unit": shown.signals[signal], "rms": float(x)} for what, x in steps]


def _added(small: Hypothesis, large: Hypothesis) -> str:
    """What joins, in words."""
    return "+ " + ", ".join(n for n in large.names if n not in small.names)


def changes_of(setup: Setup[Any], e: Hypothesis, hypotheses: list[Hypothesis], predict: Predict) -> Array:
    """How far predictions of a set move when one of its effects is left out and the others fitted anew, [effects, S].

    Root mean square over windows that the set foretells, in the signals' units.
    """
    y = predict([e.fit, *(without_effect(setup, e, i, hypotheses).fit for i in range(e.effects))])
    told = by_window(foretold(setup, e), setup)
    return np.sqrt(np.einsum("w,kwns->ks", told, (y[1:] - y[:1]) ** 2) / y[0, ..., 0].size)


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


def fallen(before: Array, after: Array) -> Array:
    """By which share roots of mean squares fell; 0 where there was nothing before and after."""
    return np.where((before == 0) & (after == 0), 0.0, 1 - np.sqrt(after / np.maximum(before, 1e-300)))


def notes_of_split(episodes: int, held: Sequence[int] | Index) -> list[str]:
    """What must be said of few episodes, or of few windows that are held out."""
    notes = []
    if episodes == 1:
        notes.append("one episode only: its end is held out, so that both sides come from the same run")
    if len(held) == 1:
        notes.append("one window only is held out: intervals of what is held out have no width; record longer")
    return notes


def notes_of_short(names: Sequence[str], used: Sequence[int] | Index, window: float) -> list[str]:
    """What must be said of episodes that fill no window.

    Args:
        names: Of all episodes.
        used: Episode of each window.
        window: Length of a window [s].
    """
    short = [name for i, name in enumerate(names) if i not in used]
    if not short:
        return []
    return [f"not used, too short for a window of {window:.3g} s: {', '.join(short)}; a shorter --window uses more"]


def notes_of_rest(signal: str, unit: str, errors: Array, held: Sequence[int] | Index) -> list[str]:
    """What must be said where what is held out hardly shows what the nominal model misses: at the end of a motion, say.

    Args:
        signal, unit: Of the signal.
        errors: Mean square error of the nominal model in each window, fitted ones too, [W].
        held: Windows that are held out.
    """
    here, everywhere = (float(np.sqrt(e.mean())) for e in (errors[held], errors))
    if here >= AT_REST * everywhere:
        return []
    return [
        f"what is held out hardly shows what is missing: the nominal error of {signal} is {here:.3g} {unit} there and "
        f"{everywhere:.3g} {unit} over all windows; hold out what moves (--held-out EPISODES) or end recordings earlier"
    ]


def reduction(signal: str, unit: str, before: Array, after: Array, rng: np.random.Generator) -> dict[str, Any]:
    """Root mean square error of one signal before and after, and by how much it fell, with its 90 % interval.

    Args:
        signal, unit: Of the signal.
        before, after: Mean square error of each held-out window, [W].
        rng: For the bootstrap.
    """
    picks = rng.integers(0, len(before), (judge.RESAMPLES, len(before)))
    drops = fallen(before[picks].mean(1), after[picks].mean(1))
    low, high = np.quantile(drops, [0.05, 0.95])
    rms = [float(np.sqrt(x.mean())) for x in (before, after)]
    return {
        "signal": signal,
        "unit": unit,
        "windows": len(before),
        "nominal": rms[0],
        "repaired": rms[1],
        "reduction": float(fallen(before.mean(), after.mean())),
        "low": float(low),
        "high": float(high),
    }
