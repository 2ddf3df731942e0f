"""report.html: the answer, how much of the error it takes away, where the law shows, and what to do next."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.page.charts import BOTTOM, TOP, Chart, span, thinned
from mpc_sgft.diagnose.page.laws import Laws
from mpc_sgft.diagnose.page.style import CSS, SCRIPT
from mpc_sgft.diagnose.page.words import changes, headline, sentence

POINTS = 36_000  # of all lines of all signals: more make the page heavy, and no screen shows them
DOTS = 1500  # of a law
SIGNALS, CANDIDATES, REGIMES = 6, 12, 10  # at most
TRIM = 0.005  # of a law's points, the outermost: accelerations are noisy where a joint sticks
ROW = 30  # pixels of a bar
NAMES, TOLD = 250, 130  # pixels beside the bars
SERIES = ("measured", "nominal", "repaired")


class Lines(NamedTuple):
    """Signals over time, of all windows.

    Attributes:
        names: Of the signals.
        time: Of every predicted sample, episodes one after the other, [W, n] s.
        measured, nominal, repaired: [W, n, S].
    """

    names: Sequence[str]
    time: Array
    measured: Array
    nominal: Array
    repaired: Array


def page(d: Mapping[str, Any], lines: Lines, laws: Laws, diff: str) -> str:
    """One self-contained HTML page of a report.json, signals, what is missing, and the scene's change."""
    sections = [
        _head(d),
        _waterfall(d),
        _laws(laws),
        _signals(d, lines),
        _candidates(d),
        _traces(d),
        _diff(diff, d),
        _rest(d),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>diagnose: {_e(d['verdict'].replace('_', ' '))}</title><style>{CSS}</style></head>"
        f"<body><main>{''.join(sections)}</main><script>{SCRIPT}</script></body></html>"
    )


def _head(d: Mapping[str, Any]) -> str:
    h = d["held_out"]
    fell = f"{h['reduction']:.0%} less [{h['low']:.0%}, {h['high']:.0%}]"
    lines = [f"<p class='soft'>Held out, never fitted: {_e(h['signal'])} {h['nominal']:.3g} → {h['repaired']:.3g} "]
    lines[0] += f"{_e(h['unit'])}, {fell}. {_e(_capital(d['reason']))}.</p>"
    named = "".join(
        f"<tr><td>{_e(_capital(sentence(e)))}<td>{_parameters(e)}<td>{e['share']['value']:.1%}<td>{_moves(e)}</tr>"
        for e in d["effects"]
    )
    if named:
        lines.append(
            "<div class='wide'><table><tr><th>What<th>Parameters, 90 % interval<th>Share of the squared error"
            f"<th>Moves predictions of</tr>{named}</table></div>"
        )
    if d["next_experiment"]:
        lines.append(f"<div class='next'><b>Next experiment.</b> {_e(_capital(d['next_experiment']))}</div>")
    kind = d["verdict"].replace("_", " ")
    return f"<span class='tag'>{_e(kind)}</span><h1>{_e(headline(d))}</h1>{''.join(lines)}"


def _waterfall(d: Mapping[str, Any]) -> str:
    steps = [s for s in d["waterfall"] if s["rms"] > 0]
    if not steps:
        return ""
    values = [s["rms"] for s in steps]
    unit, signal = steps[0]["unit"], steps[0]["signal"]
    low, high = min(values) / 2, max(values) * 1.3
    chart = Chart(
        760,
        TOP + BOTTOM + ROW * len(steps),
        (low, high),
        (0, 1),
        (f"error of {signal} [{unit}]", ""),
        log_x=True,
        left=NAMES,
        right=TOLD,
    )
    kinds = {"nominal": "nominal", "noise": "", "traces": "trace"}
    for i, (s, v) in enumerate(zip(steps, values, strict=True)):
        chart.bar(i, len(steps), v, kinds.get(s["what"], "best"), _short(s["what"], 36), f"{v:.3g}")
    return (
        "<h2>From the nominal model to the noise</h2><p>Root mean square error on windows that were never fitted, as "
        "effects join the model one after the other. Each step is fitted anew. Noise is the sensor's and what the "
        "simulator cannot tell.</p>"
        f"<figure>{chart.svg('error by effects in the model', y_ticks=False)}</figure>"
    )


def _laws(laws: Laws) -> str:
    rows = []
    for law in laws.laws:
        charts, pick = [], list(thinned(len(law.before), DOTS))
        shown = [law.before] if law.after is None else [law.before, law.after]
        for label, x in law.along:
            chart = Chart(380, 250, span(x), span(*shown, trim=TRIM), (label, law.missing))
            for kind, y in zip(("nominal", "repaired"), shown, strict=False):
                chart.dots(x[pick], y[pick], kind)
            charts.append(chart.svg(f"{law.missing} of {law.where} against {label}"))
        rows.append(
            f"<figure><figcaption>{_e(law.where)}</figcaption><div class='pair'>{''.join(charts)}</div></figure>"
        )
    keys = _keys(("nominal", "repaired") if any(law.after is not None for law in laws.laws) else ("nominal",))
    return f"<h2>{_e(laws.title)}</h2><p>{_e(laws.reading)}</p><p>{keys}</p>{''.join(rows)}" if rows else ""


def _signals(d: Mapping[str, Any], lines: Lines) -> str:
    t, units = lines.time, {s["signal"]: s["unit"] for s in d["signals"]}
    worst = [name for name in units if name in lines.names]  # first
    names = [*worst, *(name for name in lines.names if name not in units)][:SIGNALS]
    W, n = t.shape
    pick = list(thinned(n, max(2, POINTS // (len(SERIES) * max(1, len(names)) * W))))
    gap = np.full((W, 1), np.nan)  # windows start anew at the measured state
    x = np.concatenate([t[:, pick], t[:, -1:]], 1).ravel()
    figures = []
    for name in names:
        values = [getattr(lines, kind)[..., lines.names.index(name)][:, pick] for kind in SERIES]
        label = f"{name} [{units.get(name, '')}]"
        chart = Chart(900, 230, span(t), span(values[0], values[2]), ("time [s]", label), zoom=True)
        for kind, y in zip(SERIES, values, strict=True):
            if n > 1:
                chart.line(x, np.concatenate([y, gap], 1).ravel(), kind)
            else:
                chart.dots(t.ravel(), y.ravel(), kind)
        figures.append(f"<figure>{chart.svg(f'{name}: measured, nominal and repaired')}</figure>")
    which = f" The {SIGNALS} with the largest error in units of their noise." if len(lines.names) > SIGNALS else ""
    return (
        f"<h2>Measured, nominal, repaired</h2><p>Short windows, each from its measured start.{which} Drag across a "
        f"chart to look closer, double-click for all of it.</p><p>{_keys(SERIES)}</p>{''.join(figures)}"
        "<p class='soft'>The same in the viewer, with all signals in step: <a href='report.rrd'>report.rrd</a>, or "
        "<code id='view'>rerun report.rrd</code> <button data-copy='view'>copy</button></p>"
    )


def _candidates(d: Mapping[str, Any]) -> str:
    rows = d["candidates"][:CANDIDATES]
    named = [sorted(f"{e['name']}@{','.join(e['at'])}".removesuffix("@") for e in d["effects"])]
    named += [sorted(t["effects"]) for t in d["ties"]]
    low = max(0.0, min(r["low"] for r in rows) - 0.2)
    high = max(r["high"] for r in rows) + 0.2
    chart = Chart(
        760,
        TOP + BOTTOM + ROW * len(rows),
        (low, high),
        (0, 1),
        ("mean of log(1 + squared error in units of noise) on windows that were not fitted", ""),
        left=NAMES,
        right=TOLD,
    )
    for i, r in enumerate(rows):
        kind = "nominal" if not r["effects"] else "best" if sorted(r["effects"]) in named else ""
        told = f"{r['held_out_error']:.2f}, wins {r['probability']:.0%}"
        chart.bar(i, len(rows), r["held_out_error"], kind, _short(" + ".join(r["effects"]) or "nominal", 36), told)
        chart.whisker(i, len(rows), r["low"], r["high"])
    return (
        "<h2>What else was tried</h2><p>Shorter is better; the thin line is the 90 % interval. Noise alone leaves "
        "0.69. What a tolerance allows counts as noise. Green is the answer and what ties with it.</p>"
        f"<figure>{chart.svg('candidates by error', y_ticks=False)}</figure>"
    )


def _traces(d: Mapping[str, Any]) -> str:
    if not d["traces"]:
        return ""
    rows = "".join(
        f"<tr><td>{_e(_capital(sentence(e)))}<td>{e['share']['value']:.2%}<td>{_moves(e)}</tr>" for e in d["traces"]
    )
    return (
        "<h2>There, but too small to matter</h2><div class='wide'><table><tr><th>Trace<th>Share of the squared error"
        f"<th>Moves predictions of</tr>{rows}</table></div>"
    )


def _diff(diff: str, d: Mapping[str, Any]) -> str:
    if not d["repaired_model"]:
        return ""
    kinds = {"+": "add", "-": "cut"}
    lines = "".join(f"<span class='{kinds.get(line[:1], '')}'>{_e(line)}</span>\n" for line in diff.splitlines())
    body = f"<pre id='diff'>{lines}</pre>" if diff else "<p>MJCF has no field for what was found: use effects.yaml.</p>"
    return (
        f"<h2>What to change in the model</h2>{body}<p><button data-copy='diff'>copy</button> "
        "<span class='soft'>The whole scene is repaired.xml; effects.yaml is a gap for pretrain and deploy.</span></p>"
    )


def _rest(d: Mapping[str, Any]) -> str:
    signals = "".join(
        f"<tr><td>{_e(s['signal'])}<td>{s['nominal']:.4g}<td>{s['repaired']:.4g}<td>{_e(s['unit'])}"
        f"<td>{s['reduction']:.0%} [{s['low']:.0%}, {s['high']:.0%}]"
        f"<td>{d['noise_floor'][s['signal']]['noise']:.2g}<td>{d['noise_floor'][s['signal']]['simulator']:.2g}</tr>"
        for s in d["signals"]
    )
    where = "".join(
        f"<tr><td>{_e(w['signal'])}<td>{_e(w['regime'])}<td>{w['share_of_error']:.0%}<td>{w['share_of_time']:.0%}</tr>"
        for w in d["where"][:REGIMES]
    )
    notes = "".join(f"<li>{_e(n)}</li>" for n in d["notes"])
    return (
        "<h2>Signals</h2><div class='wide'><table><tr><th>Signal<th>nominal<th>repaired<th>unit<th>less, 90 % interval"
        f"<th>noise<th>simulator's floor</tr>{signals}</table></div>"
        "<h2>Where the error is</h2><div class='wide'><table><tr><th>Signal<th>Regime<th>Share of the error"
        f"<th>Share of the time</tr>{where}</table></div>"
        + (f"<h2>Notes</h2><ul>{notes}</ul>" if notes else "")
        + f"<p class='soft'>Made in {d['seconds']:.0f} s by python -m mpc_sgft.diagnose. All numbers: report.json.</p>"
    )


def _parameters(effect: Mapping[str, Any]) -> str:
    return "<br>".join(
        f"{_e(name)} {p['value']:.4g} {_e(p['unit'] if p['unit'] != '1' else '')} [{p['low']:.4g}, {p['high']:.4g}]"
        for name, p in effect["parameters"].items()
    )


def _moves(effect: Mapping[str, Any]) -> str:
    return "<br>".join(_e(c) for c in changes(effect))


def _keys(kinds: Sequence[str]) -> str:
    return "".join(f"<span class='key {k}'>{k}</span>" for k in kinds)


def _short(words: str, most: int) -> str:
    return words if len(words) <= most else words[: most - 1] + "…"


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def _e(words: str) -> str:
    return html.escape(words)
