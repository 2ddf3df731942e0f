"""What was found and how sure it is: report.json, report.html, and report.rrd with all signals side by side."""

from __future__ import annotations

import base64
import html
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.simulation.replay import Replayer
from mpc_sgft.diagnose.words import headline, place


@dataclass
class Report:
    """The answer. `as_dict()` is report.json.

    Attributes:
        data: The keys of report.json.
        measured, nominal, repaired: Signals of all windows for plots, [W, n, S].
        replayer: Windows and signal names.
    """

    data: dict[str, Any]
    measured: Array = field(repr=False)
    nominal: Array = field(repr=False)
    repaired: Array = field(repr=False)
    replayer: Replayer = field(repr=False)

    @property
    def verdict(self) -> str:
        return self.data["verdict"]

    def as_dict(self) -> dict[str, Any]:
        return self.data

    def write(self, out: Path) -> None:
        """Write report.json, report.html and report.rrd into a folder."""
        (out / "report.json").write_text(json.dumps(self.data, indent=2))
        (out / "report.html").write_text(page(self))
        write_rrd(self, out / "report.rrd")

    def summary(self) -> str:
        """A few lines for the terminal."""
        d = self.data
        lines = [headline(d), f"verdict: {d['verdict']} ({d['reason']})"]
        for e in d["effects"]:
            numbers = ", ".join(
                f"{k} = {v['value']:.4g}{_unit(v)} [{v['low']:.4g}, {v['high']:.4g}]"
                for k, v in e["parameters"].items()
            )
            lines.append(f"  {e['name']} at {place(e)}: {numbers}; {_share(e)}")
        for tie in d["ties"]:
            lines.append(f"  ties with: {' + '.join(tie['effects'])} {tie['reason']}")
        for e in d["traces"]:
            numbers = ", ".join(f"{k} = {v['value']:.4g}{_unit(v)}" for k, v in e["parameters"].items())
            lines.append(f"  trace: {e['name']} at {place(e)}: {numbers}; {_share(e)}")
        h = d["held_out"]
        lines.append(
            f"held-out {h['signal']}: {h['nominal']:.4g} -> {h['repaired']:.4g} {h['unit']}, {h['reduction']:.0%} less "
            f"[{h['low']:.0%}, {h['high']:.0%}]"
        )
        if d["next_experiment"]:
            lines.append(f"next experiment: {d['next_experiment']}")
        return "\n".join([*lines, *(f"note: {n}" for n in d["notes"])])


def _unit(parameter: dict[str, Any]) -> str:
    return "" if parameter["unit"] == "1" else f" {parameter['unit']}"


def _share(effect: dict[str, Any]) -> str:
    """What an effect does, in words."""
    changes = ", ".join(f"{c['signal']} by {c['rms']:.2g} {c['unit']}" for c in effect["changes"][:3])
    return f"{effect['share']['value']:.2%} of the squared error" + (f", moves {changes}" if changes else "")


def page(report: Report) -> str:
    """One self-contained HTML page."""
    d = report.data
    rows = "".join(
        f"<tr><td>{html.escape(' + '.join(c['effects']) or 'nominal')}</td><td>{c['held_out_error']:.4g}</td>"
        f"<td>{c['low']:.4g} to {c['high']:.4g}</td><td>{c['probability']:.0%}</td></tr>"
        for c in d["candidates"]
    )
    signals = "".join(
        f"<tr><td>{html.escape(s['signal'])}</td><td>{s['nominal']:.4g}</td><td>{s['repaired']:.4g} {s['unit']}</td>"
        f"<td>{s['reduction']:.0%} [{s['low']:.0%}, {s['high']:.0%}]</td></tr>"
        for s in d["signals"]
    )
    where = "".join(
        f"<tr><td>{html.escape(w['signal'])}</td><td>{w['regime']}</td><td>{w['share_of_error']:.0%}</td>"
        f"<td>{w['share_of_time']:.0%}</td></tr>"
        for w in d["where"][:12]
    )
    style = "body{font:15px sans-serif;max-width:60em;margin:2em auto}td,th{padding:2px 12px;text-align:left}"
    return (
        f"<!doctype html><meta charset='utf-8'><title>diagnose: {d['verdict']}</title><style>{style}</style>"
        f"<h1>{d['verdict'].replace('_', ' ')}</h1><pre>{html.escape(report.summary())}</pre>"
        f"<img alt='measured, nominal and repaired' src='{figure(report)}'>"
        "<h2>Candidates</h2><p>Error of windows that were not fitted, in units of noise and simulator floor.</p>"
        f"<table><tr><th>effects<th>error<th>90 % interval<th>wins</tr>{rows}</table>"
        "<h2>Signals</h2><p>Root mean square error on windows that were never fitted; 90 % interval of the drop.</p>"
        f"<table><tr><th>signal<th>nominal<th>repaired<th>less</tr>{signals}</table>"
        f"<h2>Where</h2><table><tr><th>signal<th>regime<th>share of error<th>share of time</tr>{where}</table>"
        f"<h2>report.json</h2><details><pre>{html.escape(json.dumps(d, indent=2))}</pre></details>"
    )


def figure(report: Report) -> str:
    """Trajectories and errors of each signal as a data URL."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    signals = report.replayer.signals[:6]
    fig = Figure(figsize=(10, 2.6 * len(signals)), layout="constrained")
    FigureCanvasSVG(fig)
    axes = fig.subplots(len(signals), 2, squeeze=False)
    t = times(report.replayer)
    every = max(1, t.size // 3000)
    for i, name in enumerate(signals):
        left, right = axes[i]
        for values, style, label in (
            (report.measured, "k-", "measured"),
            (report.nominal, "C3--", "nominal"),
            (report.repaired, "C0-", "repaired"),
        ):
            left.plot(t.ravel()[::every], values[..., i].ravel()[::every], style, lw=0.8, label=label)
        for values, style in ((report.nominal, "C3-"), (report.repaired, "C0-")):
            error = np.sqrt(np.mean((values[..., i] - report.measured[..., i]) ** 2, 1))
            right.semilogy(t[:, 0], np.maximum(error, 1e-12), style, drawstyle="steps-post", lw=0.9)
        left.set_title(name, fontsize=9)
        right.set_title("RMSE of each window", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    buffer = io.BytesIO()
    fig.savefig(buffer, format="svg")
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()


def times(replayer: Replayer) -> Array:
    """Time of every predicted sample, episodes one after the other, [W, n] s."""
    w = replayer.windows
    before = np.concatenate([[0.0], np.cumsum([e.seconds for e in replayer.episodes])])
    return np.asarray(
        before[w.episode][:, None] + replayer.dt * (w.start[:, None] + np.arange(1, w.samples + 1)), float
    )


def write_rrd(report: Report, path: Path) -> None:
    """Measured, nominal and repaired signals over time."""
    import rerun as rr

    rec = rr.RecordingStream("mpc_sgft_diagnose")
    rec.save(str(path))
    t = times(report.replayer)
    order = np.argsort(t.ravel())
    index = [rr.TimeColumn("time", duration=t.ravel()[order])]
    for i, name in enumerate(report.replayer.signals):
        for kind in ("measured", "nominal", "repaired"):
            values = getattr(report, kind)[..., i].ravel()[order]
            rec.send_columns(f"{name}/{kind}", indexes=index, columns=rr.Scalars.columns(scalars=values))
    rec.flush()
    rec.disconnect()
